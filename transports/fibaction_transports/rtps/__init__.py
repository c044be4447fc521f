"""RTPS 2.3, the protocol of DDS, for nodes of ROS 2 without ROS.

`participant` is the library, which does no I/O, and `network` runs it with sockets.
"""
