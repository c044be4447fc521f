"""`TransportSettings`: the settings of a transport, each of them once.

A transport has one struct of settings. Its fields are the keyword arguments of the constructor, of
`serve` and of `connect`, and the parameters of a URL; their docstrings are the table in the docs.
The values are checked by the struct. `python -m tests.tools.setting_keywords` makes the types of
the keyword arguments from it, for type checkers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from inspect import formatannotation, get_annotations
from typing import Any, ClassVar, TypeAlias, TypeVar

from fibaction._runtime.settings_struct import SettingsStruct, unknown_setting
from fibaction.border.urls import check_settings, without_settings
from fibaction.words.errors import InvalidURL
from fibaction.words.plain_data import check_is_number

__all__ = ["FromText", "TransportSettings", "check_range", "read_settings"]

S = TypeVar("S", bound="TransportSettings")

FromText: TypeAlias = Callable[[str], Any]
"""A function that makes the value of a setting of the text in a URL; it raises ValueError or
KeyError."""


def _words(text: str) -> tuple[str, ...]:
    words = tuple(filter(None, (word.strip() for word in text.split(","))))
    if not words:
        raise ValueError("it has no items")
    return words


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(map(int, _words(text)))


_FROM_TEXT: dict[str, FromText] = {
    "str": str,
    "float": float,
    "int": int,
    "bool": {"true": True, "false": False}.__getitem__,
    "Sequence[str]": _words,
    "Sequence[int]": _numbers,
}
"""Readers of settings in a URL, by their types. Settings of other types are given in code."""


def _written(kind: object) -> str:
    """Return a type as it is written, also in a module without deferred annotations."""
    text = kind if isinstance(kind, str) else formatannotation(kind)
    return text.replace("collections.abc.", "")


class TransportSettings(SettingsStruct, frozen=True, kw_only=True, dict=True):
    """The settings of a transport. A subclass has the fields, and checks their values."""

    for_clients: ClassVar[bool] = True
    """False for a transport that only serves."""
    for_servers: ClassVar[bool] = True
    """False for a transport that only connects."""
    only_in_code: ClassVar[tuple[str, ...]] = ()
    """Settings that a URL cannot have, although they are text: it ends up in logs."""
    only_for_clients: ClassVar[tuple[str, ...]] = ()
    """Settings that a server does not read."""
    only_for_servers: ClassVar[tuple[str, ...]] = ()
    """Settings that a client does not read."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}>"  # a token or a password has no place in a log

    @classmethod
    def types(cls) -> dict[str, str]:
        """Return the type of each setting, as it is written."""
        found: dict[str, Any] = {}
        for base in reversed(cls.__mro__):
            found.update(get_annotations(base))
        return {name: _written(found[name]) for name in cls.__struct_fields__}

    @classmethod
    def in_urls(cls) -> dict[str, FromText]:
        """Return the settings that a URL can have, and what reads each of them."""
        found: dict[str, FromText] = {}
        for name, written in cls.types().items():
            kind = "str" if written.startswith("Literal[") else written.removesuffix(" | None")
            if kind in _FROM_TEXT and name not in cls.only_in_code:
                found[name] = _FROM_TEXT[kind]
        return found

    @classmethod
    def of(cls: type[S], owner: object, given: Mapping[str, Any]) -> S:
        """Make the settings of a transport from its keyword arguments.

        Raises:
            TypeError: There is no such setting.
            ValueError: A value is out of range.
        """
        check_settings(type(owner).__name__, given, cls.__struct_fields__)
        return cls(**given)


def read_settings(
    url: str, query: Mapping[str, str], kind: type[TransportSettings], more: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the settings in a URL, read from their texts; `more` are text as well.

    Raises:
        InvalidURL: There is no such setting, or it has another type.
    """
    where = without_settings(url)
    readers: dict[str, FromText] = {**kind.in_urls(), **dict.fromkeys(more, str)}
    settings: dict[str, Any] = {}
    for name, text in query.items():
        if name not in readers:
            if name != "tls" and name in kind.__struct_fields__:
                raise InvalidURL(
                    f"{where} cannot have the setting {name!r}: it is given in code, as in"
                    f" serve(..., {name}=...), and not in a URL, which ends up in logs"
                )
            raise InvalidURL(unknown_setting(where, name, readers))
        try:
            settings[name] = readers[name](text)
        except (ValueError, KeyError):
            raise InvalidURL(f"{where}: the setting {name!r} cannot be {text!r}") from None
    return settings


def check_range(name: str, value: float, least: float, most: float) -> None:
    """Check a setting that is a number.

    Raises:
        TypeError: It is not a number.
        ValueError: It is out of range.
    """
    check_is_number(name, value)
    if not least <= value <= most:
        raise ValueError(f"{name} must be between {least} and {most}, not {value}")
