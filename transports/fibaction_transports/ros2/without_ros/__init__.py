"""The base of nodes without ROS, on any middleware: types, arguments, parameters and the clock."""
