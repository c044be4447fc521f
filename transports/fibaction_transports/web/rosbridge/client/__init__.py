"""The client's half: the actions of a rosbridge server as endpoints."""
