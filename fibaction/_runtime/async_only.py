"""`AsyncBlock`, `AsyncItems`: bases whose errors tell `with` and `for` from their async forms."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, NoReturn

_WHERE = "in an `async def`; without async code, use fibaction.blocking"


class AsyncBlock:
    """A base of what `async with` opens."""

    __slots__ = ()

    opened_by: ClassVar[str] = ""
    """The line that opens it."""

    # For type checkers, `with` would be allowed.
    if not TYPE_CHECKING:  # pragma: no branch  # it is always true at run time

        def __enter__(self) -> NoReturn:
            raise TypeError(f"`with` cannot open it: write `{self.opened_by}`, {_WHERE}")

        __exit__ = __enter__  # Python looks for both first


class AsyncItems:
    """A base of what `async for` reads."""

    __slots__ = ()

    read_by: ClassVar[str] = ""
    """The line that reads it."""

    # For type checkers, `for` would be allowed.
    if not TYPE_CHECKING:  # pragma: no branch  # it is always true at run time

        def __iter__(self) -> NoReturn:
            raise TypeError(f"`for` cannot read it: write `{self.read_by}`, {_WHERE}")
