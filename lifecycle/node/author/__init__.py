"""The API for node authors: LifecycleNode, handlers, declarations in code, parameters."""
