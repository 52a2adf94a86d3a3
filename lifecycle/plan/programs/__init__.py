"""What nodes run, found and read without running it."""
