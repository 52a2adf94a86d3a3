"""Declared endpoints: their rclpy entities, and the connections that these are on."""
