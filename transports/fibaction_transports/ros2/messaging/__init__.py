"""What an executor needs of its robot beside actions: topics and services of one node.

`open_node` is the way in. Everything here goes through `RosNode`, so it is the same over rclpy, DDS
and Zenoh.
"""
