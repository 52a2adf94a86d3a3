"""Small whole systems to start from."""
