"""The arguments of ROS on a command line, for a node: its names, and the values of parameters."""
