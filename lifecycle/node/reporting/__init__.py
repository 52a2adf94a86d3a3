"""What a node tells of itself: configuration, liveliness."""
