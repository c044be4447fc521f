"""ROS 2 over Zenoh, without ROS: nodes by the library of Zenoh, for peers on `rmw_zenoh_cpp`."""
