"""The smallest start, a talker and a listener: manifests/first_node.lifecycle.yaml."""
