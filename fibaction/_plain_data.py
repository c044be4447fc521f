"""Type guards for plain data: what JSON, YAML and msgpack have in common."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeGuard


def is_map(value: object) -> TypeGuard[dict[Any, Any]]:
    """Return whether the value is a map, with any keys and values."""
    return isinstance(value, dict)


def is_list(value: object) -> TypeGuard[Collection[Any]]:
    """Return whether the value is a list, or another collection that JSON writes as one."""
    return isinstance(value, list | tuple | set | frozenset)
