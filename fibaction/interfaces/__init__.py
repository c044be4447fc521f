"""ROS 2 interface files: what is in them, where they lie, and what is made of them.

Needs no ROS and no build step. `fibaction.action_files` is the way in.
"""
