"""ROS 2 by rclpy: the only part of fibaction that imports it."""
