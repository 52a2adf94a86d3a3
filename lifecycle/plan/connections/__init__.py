"""How participants are connected and find each other, and whether that is possible."""
