"""Descriptions of types between nodes: the service `get_type_description`, at both ends."""
