"""ROS 2 without ROS: nodes over the RTPS and the CDR of this project, for any middleware of DDS."""
