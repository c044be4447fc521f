"""Objects of async code and of one thread: errors for other uses, and calls into their event loop.

The errors of `AsyncBlock`, `AsyncItems` and `HasResult` say what to write in place of a form that
they do not have.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from threading import current_thread, get_ident
from threading import enumerate as enumerate_threads
from typing import TYPE_CHECKING, ClassVar, NoReturn, TypeVar

import anyio
from anyio import RunFinishedError, from_thread
from anyio.lowlevel import current_token

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


T = TypeVar("T")


class OwnThread:
    """The thread whose event loop an object belongs to.

    It is the one that makes the object in a task, or else the one that uses it first.
    """

    __slots__ = ("ident",)

    def __init__(self) -> None:
        self.ident = 0
        """The number of the thread; 0 before it is known."""
        try:
            anyio.get_current_task()
        except RuntimeError:
            return  # the object is made before the event loop runs
        self.ident = get_ident()

    def check(self) -> None:
        """Raise an error in another thread.

        Raises:
            RuntimeError: This is another thread; the text says what to do.
        """
        if get_ident() != self.ident:
            if self.ident:
                raise RuntimeError(
                    f"this client belongs to the event loop of thread {self._name()!r}, and was"
                    f" used in thread {current_thread().name!r}: call it in its own thread, for"
                    f" example with anyio.from_thread.run(client.call, goal)"
                )
            self.ident = get_ident()

    def _name(self) -> str:
        names = [thread.name for thread in enumerate_threads() if thread.ident == self.ident]
        return names[0] if names else "one that has ended"


class HomeLoop:
    """The event loop that runs in the thread which makes this object."""

    __slots__ = ("_thread", "_token")

    def __init__(self) -> None:
        self._thread = get_ident()
        self._token = current_token()

    @property
    def is_here(self) -> bool:
        """True in the thread of the event loop."""
        return get_ident() == self._thread

    def run(self, function: Callable[[], Awaitable[T]]) -> T:
        """Run an async function in the event loop, as a task of its own; wait for it in this
        thread, which is another one.

        Raises:
            RuntimeError: The event loop has ended.
        """

        async def call() -> T:
            return await function()

        try:
            return from_thread.run(call, token=self._token)
        except RunFinishedError:
            raise RuntimeError("the event loop of the action server has ended") from None
