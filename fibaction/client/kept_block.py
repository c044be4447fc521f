"""`KeptBlock`: an async block that is open until it is closed, in any task.

Theory of operation
-------------------

Connections and servers have tasks, so their blocks must be entered and left in one task, and
`await connect(...)` has none to offer. A background task enters the block, and leaves it when it is
told to. It does not reference what the caller has, so that is garbage collected if it is forgotten,
and can then close the block, as a file does.
"""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager, suppress
from typing import Generic, TypeVar

from anyio import CancelScope, Event, get_cancelled_exc_class
from anyio.lowlevel import current_token

from fibaction.border.detached import start_outside

T = TypeVar("T")


class KeptBlock(Generic[T]):
    """The background task of one block."""

    def __init__(self, block: AbstractAsyncContextManager[T]) -> None:
        self.value: T
        """The value of the block, once it is open."""
        self.error: BaseException | None = None
        """The error with which the block has ended; None if it has none."""
        self.ended = Event()
        self.is_closing = False
        """True if the block was told to end, or has ended by itself."""
        self._block = block
        self._opened, self._closing = Event(), Event()
        self._scope = CancelScope()
        self._token = current_token()

    async def open(self, name: str) -> None:
        """Enter the block in a task of that name.

        Raises:
            Exception: As the block does.
        """
        start_outside(self._run, name)
        try:
            await self._opened.wait()
        except BaseException:
            self._scope.cancel()
            with CancelScope(shield=True):
                await self.ended.wait()
            raise
        if self.error is not None:
            try:
                raise self.error
            finally:
                del self  # the traceback of its error references this frame

    async def _run(self) -> None:
        try:
            with self._scope:
                async with self._block as self.value:
                    self._opened.set()
                    await self._closing.wait()
        except get_cancelled_exc_class():
            raise  # the event loop itself ends
        except BaseException as exc:
            self.error = exc
        finally:
            self.is_closing = True
            self.ended.set()
            self._opened.set()

    def close(self) -> None:
        """Let the block end."""
        self.is_closing = True
        self._closing.set()

    def close_soon(self) -> None:
        """Let the block end, from any thread."""
        with suppress(RuntimeError):  # the event loop has ended
            self._token.backend_class.run_sync_soon(self.close, (), self._token.native_token)
