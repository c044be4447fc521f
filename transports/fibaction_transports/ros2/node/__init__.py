"""A node of ROS: its thread, clock, parameters, mailbox, and what both ends of an action share."""
