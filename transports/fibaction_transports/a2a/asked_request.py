"""The request that is being answered, for what depends on how a client calls this server."""

from __future__ import annotations

from contextvars import ContextVar
from typing import NamedTuple


class AskedRequest(NamedTuple):
    """The request that is being answered."""

    url: str
    """The URL of this server, as its client calls it."""
    is_known: bool
    """True if the client has a token."""


_ASKED: ContextVar[AskedRequest] = ContextVar("_ASKED")


def asked_request() -> AskedRequest:
    """Return the request that the calling task answers."""
    return _ASKED.get()


def note_request(url: str, *, is_known: bool) -> None:
    """Note the request that the calling task answers from now on."""
    _ASKED.set(AskedRequest(url, is_known))
