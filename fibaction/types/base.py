"""`Encoding`: what an action needs of a way to make bytes of the values of one type."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any


class Encoding(ABC):
    """The encoding of one message type."""

    may_hold_messages = False
    """True if ROS messages may be within its values; a message may always stand for one."""

    encode: Callable[[Any], bytes]
    """Turns a value into bytes; see `Codec.encode` for its errors."""
    decode: Callable[[bytes], Any]
    """Turns bytes into a value, or raises an error of msgspec, or one of the type's own code."""

    classes: tuple[type, ...]
    """The classes that a value of this type is an instance of; `object` for any."""

    @abstractmethod
    def schema(self) -> dict[str, Any]:
        """Return the type's JSON Schema; empty, which allows any value, if there is none."""
