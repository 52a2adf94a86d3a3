"""The authority over connections: desired state and reconciling; networks; discovery server."""
