"""Type guards for plain data, such as the data of a peer that was read from JSON.

A map is one with any keys and values; a list is one, or another collection that JSON writes as one.
"""

from fibaction._runtime.plain_data import is_list, is_map

__all__ = ["is_list", "is_map"]
