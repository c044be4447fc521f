"""Who may come in, and what he may do there."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from enum import Enum
from hmac import compare_digest
from typing import TypeAlias

import msgspec

from fibaction.wire.messages import check_can_be_sent


class Permission(Enum):
    """What a client may want to do with an action."""

    SEND = "send"
    CANCEL = "cancel"
    OBSERVE = "observe"


class Peer(msgspec.Struct, frozen=True):
    """A client, as far as the server knows it."""

    address: str
    """Where it is, for instance `127.0.0.1:51234`."""
    name: str = ""
    """Whom its token belongs to; empty if the server asks for no tokens."""


Authorize: TypeAlias = Callable[[Peer, str, Permission], bool | Awaitable[bool]]
"""Given the client, the action's name and the verb, says whether that is allowed."""


class AccessPolicy:
    """The rules of one server. Without any, everybody may do everything."""

    def __init__(
        self, tokens: Mapping[str, str] | None = None, authorize: Authorize | None = None
    ) -> None:
        """`tokens` maps each token to the name of whom it belongs to; None asks for no token.

        Raises:
            ValueError: A token is empty or no text, or there are none in the mapping.
        """
        if tokens is not None and not all(tokens or [""]):
            raise ValueError("a server that asks for tokens needs at least one, and none empty")
        for token in tokens or ():
            check_can_be_sent(token)
        self._tokens = tokens
        self._authorize = authorize

    def admit(self, address: str, token: str) -> Peer | None:
        """The client, if its token is good. Takes as long for a good one as for a bad one."""
        if self._tokens is None:
            return Peer(address)
        found = None
        for known, name in self._tokens.items():
            if compare_digest(known.encode(), token.encode()):
                found = Peer(address, name)
        return found

    @property
    def is_open(self) -> bool:
        """Whether everybody who is in may do everything."""
        return self._authorize is None

    async def allows(self, peer: Peer, action: str, verb: Permission) -> bool:
        """Whether the client may do that."""
        if self._authorize is None:
            return True
        answer = self._authorize(peer, action, verb)
        return (await answer if isinstance(answer, Awaitable) else answer) is True

    def __repr__(self) -> str:
        return "<Access>"  # tokens have no place in a log
