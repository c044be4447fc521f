"""The server's half: an endpoint as an action server of ROS."""
