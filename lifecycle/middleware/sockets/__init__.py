"""The sockets under participants: network flow endpoints, DSCP, what URLs opened."""
