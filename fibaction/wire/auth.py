"""Authentication of clients, and authorization of their requests.

A client is authenticated once for each connection, by the token of its first message, and
authorized for each request, by a function of the user's. Without tokens every client is let in,
and without such a function it may do everything.

`fibaction` itself imports this module, so it imports nothing that costs time.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from enum import Enum
from typing import TypeAlias

import msgspec


class Permission(Enum):
    """A kind of request that a client may be permitted to make for an action."""

    SEND = "send"
    CANCEL = "cancel"
    OBSERVE = "observe"


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
            ValueError: A token is empty or is not valid text, or the mapping is empty.
        """
        if tokens is not None and not all(tokens or [""]):
            raise ValueError("a server that asks for tokens needs at least one, and none empty")
        for token in tokens or ():
            check_token(token)
        self._tokens = tokens
        self._authorize = authorize

    def admit(self, address: str, token: str) -> Peer | None:
        """Return the client if its token is valid, else None.

        An invalid token takes as long as a valid one.
        """
        if self._tokens is None:
            return Peer(address)
        from hmac import compare_digest  # needed by servers with tokens only, and slow to import

        found = None
        for known, name in self._tokens.items():
            if compare_digest(known.encode(), token.encode()):
                found = Peer(address, name)
        return found

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
    """Check that a token is valid text: what an operating system hands over may not be.

    Raises:
        ValueError: It is not. The token itself is not shown.
    """
    try:
        token.encode()
    except UnicodeEncodeError:
        raise ValueError("token is not valid text") from None
