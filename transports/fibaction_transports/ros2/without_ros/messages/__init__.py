"""The messages of a node without ROS: their types, and how values become bytes."""
