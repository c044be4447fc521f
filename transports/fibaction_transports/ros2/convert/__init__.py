"""Values between payloads and the messages of ROS."""
