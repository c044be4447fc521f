"""`pathlib` in types: a path is text in a message, and has the format `path` in a schema."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

import msgspec

from fibaction.types.schemas import schema_of


def is_path_class(kind: Any) -> bool:
    """Return whether a class is one of `pathlib`."""
    return isinstance(kind, type) and issubclass(kind, PurePath)


def made(kind: Any, data: Any) -> Any:
    """Make a path of its text; data of the type `object` stay as they are.

    Raises:
        ValueError: The data are not text; msgspec adds where they are.
    """
    if not is_path_class(kind):
        return data
    if not isinstance(data, str):
        raise ValueError(f"Expected `str`, got `{type(data).__name__}`")
    return kind(data)


def described(kind: Any) -> dict[str, Any]:
    """Return the JSON Schema of a path; of another class, none."""
    if not is_path_class(kind):
        raise NotImplementedError
    return {"type": "string", "format": "path"}


def decoder(kind: Any) -> Any:
    """Return what decodes a type that has paths in it."""
    return msgspec.msgpack.Decoder(kind, dec_hook=made).decode


def schema(kind: Any) -> dict[str, Any]:
    """Return the JSON Schema of a type that has paths in it.

    Raises:
        TypeError: There is none for it.
    """
    return schema_of(kind, described)
