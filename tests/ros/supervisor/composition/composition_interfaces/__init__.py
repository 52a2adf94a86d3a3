"""Stands in for ROS 2's package, which the wheels do not have: see srv."""
