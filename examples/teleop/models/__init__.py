"""The robot and its world as plain Python; nothing in here may import ROS."""
