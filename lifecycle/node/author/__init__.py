"""What people subclass and write: LifecycleNode, handlers, declarations in code."""
