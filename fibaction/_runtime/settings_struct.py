"""`SettingsStruct`: a base for settings that users make, with an error that names a typo."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import msgspec

from fibaction._runtime.text import nearest


def unknown_setting(where: str, name: str, known: Iterable[str]) -> str:
    """Return the sentence about a setting that there is not."""
    names = tuple(known)
    near = nearest(name, names)
    hint = f": did you mean {near!r}?" if near else ";"
    has = f"its settings are {', '.join(names)}" if names else "it has no settings"
    return f"{where} has no setting {name!r}{hint} {has[0].upper() + has[1:] if near else has}"


class _Checked(msgspec.StructMeta):
    # For type checkers, a call would have other parameters than the fields of the struct.
    if not TYPE_CHECKING:  # pragma: no branch  # it is always true at run time

        def __call__(cls, *args: Any, **kwargs: Any) -> Any:
            for name in kwargs:
                if name not in cls.__struct_fields__:
                    raise TypeError(unknown_setting(cls.__name__, name, cls.__struct_fields__))
            return super().__call__(*args, **kwargs)


class SettingsStruct(msgspec.Struct, metaclass=_Checked, frozen=True):
    """A struct that a user makes by keywords: for one that it does not have, it says what it has.

    For example: `Schedule has no setting 'concurency': did you mean 'concurrency'?`
    """
