"""The client's half: an action server of ROS as an endpoint."""
