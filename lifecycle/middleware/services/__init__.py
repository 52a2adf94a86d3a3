"""Services, actions and parameters of other nodes, and our own servers and clients of actions."""
