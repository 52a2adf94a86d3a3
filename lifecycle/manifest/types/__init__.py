"""Interfaces that are installed: found, read and hashed without ROS."""
