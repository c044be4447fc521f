"""Event loops that drive a participant, and the order in which datagrams are taken."""
