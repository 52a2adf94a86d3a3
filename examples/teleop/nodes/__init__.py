"""The robot's nodes, one class per module, so that a process imports only what it runs."""
