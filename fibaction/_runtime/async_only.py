"""`AsyncBlock`, `AsyncItems`, `HasResult`: bases whose errors say what to write in place of a form
that they do not have.
"""

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


class HasResult:
    """A base of goals, which are not their results."""

    __slots__ = ()

    result_by: ClassVar[str] = ""
    """The code that waits for the result."""

    # For type checkers, these would be allowed.
    if not TYPE_CHECKING:  # pragma: no branch  # it is always true at run time

        def _is_not_its_result(self, *_: object) -> NoReturn:
            raise TypeError(f"a goal is not its result: write `{self.result_by}`")

        __await__ = __getitem__ = __lt__ = __gt__ = _is_not_its_result
        __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _is_not_its_result
