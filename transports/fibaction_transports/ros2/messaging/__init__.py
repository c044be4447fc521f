"""Topics, services, parameters and transforms, which executors and clients need beside actions.

`open_node` is the way in. Everything here goes through `RosNode`, so it is the same over rclpy, DDS
and Zenoh.
"""
