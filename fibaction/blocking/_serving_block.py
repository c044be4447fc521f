"""`serve`: the block of servers, with their thread."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from threading import Event
from typing import TYPE_CHECKING, Unpack

import fibaction._api
from fibaction._api import Served
from fibaction.blocking._loop_thread import LoopBlock
from fibaction.border.abc import Transport
from fibaction.border.urls import transport_for
from fibaction.border.watchers import Watcher
from fibaction.words.errors import TransportError

if TYPE_CHECKING:
    from fibaction_transports.keywords import ServeKeywords


class BlockingServing(LoopBlock[tuple[str, ...], tuple[str, ...]]):
    """Servers at their addresses, to be run by `with`, or until Ctrl-C: see `serve`."""

    def forever(self) -> None:
        """Serve until Ctrl-C, and then stop the servers: their goals end, and clients are told.

        In another thread than the main one, this does not end.

        Raises:
            ActionError, TypeError, RuntimeError: As for the block of `serve`.
        """
        with suppress(KeyboardInterrupt), self:
            Event().wait()


def serve(
    endpoints: Served | Iterable[Served],
    *where: str | Transport,
    watchers: Iterable[Watcher] = (),
    **settings: Unpack[ServeKeywords],
) -> BlockingServing:
    """Serve functions and other endpoints for as long as a block lasts, or until Ctrl-C.

        with serve(drive, "tcp://127.0.0.1:7400"):
            ...

        serve(drive, "tcp://127.0.0.1:7400").forever()

    The servers run in an event loop of their own, in a thread that ends with the block; plain
    functions run in further threads. The block gets the URLs. The arguments are those of
    `fibaction.serve`.

    Raises:
        TransportError: An address cannot be used.
        TypeError: A transport does not have such a setting; or, at the beginning of the block, as
            for `fibaction.serve`.
        RuntimeError: At the beginning of the block: an event loop runs in this thread, which the
            block would block, or a server has been stopped.
    """
    transports = [transport_for(one, **settings) for one in where]
    if any(transport.shares_event_loop for transport in transports):
        raise TransportError(
            "fibaction.blocking cannot serve at inproc://, whose clients share the server's event"
            " loop: use an address such as tcp://127.0.0.1:7400"
        )
    # Only URLs take settings, and these have got them.
    return BlockingServing(
        lambda: fibaction._api.serve(endpoints, *transports, watchers=watchers),
        lambda _loop, urls: urls,
    )
