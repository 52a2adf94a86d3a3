"""The node interface and the connections it makes."""
