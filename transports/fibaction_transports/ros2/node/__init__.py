"""A node of ROS as both halves of the transport use it, and the rules that both share."""
