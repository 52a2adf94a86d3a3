"""rcl and rmw as rclpy does not offer them: the C ABI, the graph, QoS, types, hidden nodes."""
