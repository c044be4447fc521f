"""Authentication of clients, and authorization of their requests.

A client is authenticated once for each connection, by the token of its first message, and
authorized for each request, by a function of the user's. Without tokens every client is let in,
and without such a function it may do everything. Over HTTP, `/healthz`, `/readyz` and the
files of the console need no token.

A permission is for an action, and not for a goal. A client with `CANCEL` may cancel every goal of
the action, those of other clients too; without it, not even its own. Only `on_cancel` of the server
can reject the cancel of one goal.

`fibaction` itself imports this module, so it imports nothing that costs time.
"""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Mapping
from enum import Enum
from typing import TypeAlias

import msgspec

TOKEN = 2048
"""Bytes of the longest token."""


class Permission(Enum):
    """A kind of request that a client may be permitted to make for an action."""

    SEND = "send"
    CANCEL = "cancel"
    OBSERVE = "observe"
    OPERATE = "operate"


class Peer(msgspec.Struct, frozen=True):
    """A client, as its server knows it."""

    address: str
    """The address of the client, for example `127.0.0.1:51234`."""
    name: str = ""
    """The name that belongs to the client's token; empty if the server asks for no tokens."""


Authorize: TypeAlias = Callable[[Peer, str, Permission], bool | Awaitable[bool]]
"""A function that gets the client, the name of the action and the permission that the request
needs, and returns whether the client has it; it may be async. Only `True` permits."""


class AccessPolicy:
    """The tokens and permissions of one server. Without any, every client may do everything."""

    def __init__(
        self, tokens: Mapping[str, str] | None = None, authorize: Authorize | None = None
    ) -> None:
        """Map each token to the name of its owner; None asks for no token.

        Raises:
            ValueError: A token is empty, too long or not valid text, or the mapping is empty.
        """
        if tokens is not None and not all(tokens or [""]):
            raise ValueError("a server that asks for tokens needs at least one, and none empty")
        for token in tokens or ():
            check_token(token)
        self._key = os.urandom(16)
        self._names: dict[bytes, str] | None = None
        if tokens is not None:
            self._names = {self._digest(token): name for token, name in tokens.items()}
        self._authorize = authorize

    def admit(self, address: str, token: str) -> Peer | None:
        """Return the client if its token is valid, else None.

        Every token costs one digest and one look-up. The time of the look-up tells a client
        nothing: it depends on the digest, whose key is random and never leaves this process.
        """
        if self._names is None:
            return Peer(address)
        name = self._names.get(self._digest(token))
        return None if name is None else Peer(address, name)

    def _digest(self, token: str) -> bytes:
        from hashlib import blake2b  # needed by servers with tokens only, and slow to import

        return blake2b(token.encode(), key=self._key).digest()

    @property
    def asks_for_tokens(self) -> bool:
        """True if only clients with a token are let in."""
        return self._names is not None

    @property
    def is_open(self) -> bool:
        """True if every client that was let in may do everything."""
        return self._authorize is None

    async def permits(self, peer: Peer, action: str, permission: Permission) -> bool:
        """Return whether the client has that permission for the action."""
        if self._authorize is None:
            return True
        answer = self._authorize(peer, action, permission)
        return (await answer if isinstance(answer, Awaitable) else answer) is True

    def __repr__(self) -> str:
        return "<AccessPolicy>"  # tokens have no place in a log


def check_token(token: str) -> None:
    """Check that a token is valid text, which what an operating system hands over may not be, and
    that it fits into a message.

    Raises:
        ValueError: It is not. The token itself is not shown.
    """
    try:
        size = len(token.encode())
    except UnicodeEncodeError:
        raise ValueError("token is not valid text") from None
    if size > TOKEN:
        raise ValueError(f"token has {size} bytes, but at most {TOKEN} are allowed")
