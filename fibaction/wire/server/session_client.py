"""`SessionClient`: the client of one session: its handshake, its name and its permissions."""

from __future__ import annotations

import os
from collections.abc import Mapping
from hmac import compare_digest

from fibaction._runtime.text import LENGTH, excerpt, shortened
from fibaction.border.abc import Endpoint
from fibaction.wire.auth import Peer, Permission
from fibaction.wire.frames import LEAST_FRAME, MAX_FRAME
from fibaction.wire.messages import VERSION, FromClient, Hello
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import AuthenticationFailed, ProtocolError, ServerNotFound
from fibaction.words.goals import GoalID, Sender, digest_of
from fibaction.words.intake import IntakeChange, IntakeMode

SESSION_LENGTHS = (0, 16, 32)
"""Lengths of the secret of a client, in bytes; 0 for none."""


class SessionClient:
    """The client of one session, unknown until it has said hello."""

    def __init__(
        self, address: str, endpoints: Mapping[str, Endpoint], settings: WireSettings
    ) -> None:
        self._address = address
        self._endpoints = endpoints
        self._settings = settings
        self._peer: Peer | None = None
        self.is_known = False
        """True if the client has said hello, and was let in."""
        self.is_trusted = settings.access.is_open
        """True if its requests need no permission."""
        self.session = b""
        """The digest of the client's secret and of the name of its token, the same on each of its
        connections; empty if it has no secret."""
        self.sender = Sender(address=address)
        """The client as the sender of its goals."""
        self.max_frame = MAX_FRAME
        """Bytes of the largest message that the client accepts."""
        self.takes_batches = False
        """True if the client accepts several feedback messages in one."""
        self.actions: set[str] = set()
        """The actions that the client has named."""

    @property
    def name(self) -> str:
        """The client's address, with the name of its token if it has one, for people to read."""
        return str(self.sender)

    def greet(self, message: FromClient) -> Hello:
        """Take the first message of the client, and let it in.

        Raises:
            ProtocolError: The message is not a `Hello`, of another version, or wrong in a field.
            AuthenticationFailed: Its token is not accepted.
        """
        if not isinstance(message, Hello):
            raise ProtocolError(f"its first message was a {type(message).__name__}, not a Hello")
        if message.version != VERSION:
            raise ProtocolError(
                f"it speaks version {message.version} of the protocol, and this is {VERSION}"
            )
        if len(message.session) not in SESSION_LENGTHS:
            raise ProtocolError(
                f"its session has {len(message.session)} bytes, and not 0, 16 or 32"
            )
        if message.max_frame < LEAST_FRAME:
            raise ProtocolError(
                f"it accepts messages of {message.max_frame} bytes, and not {LEAST_FRAME} or more"
            )
        self._peer = self._settings.access.admit(self._address, message.token)
        if self._peer is None:
            # The text is for the log and for the client, so it says whose token it is about.
            raise AuthenticationFailed(
                "the server rejected the client's token"
                if message.token
                else "the server asks for a token, and the client gave none"
            )
        if message.session:
            # Another token with the same secret is another client.
            self.session = digest_of(digest_of(self._peer.name.encode()) + message.session)
        # A client without a secret is told from all others, and is another on each connection.
        owner = self.session or os.urandom(len(digest_of(b"")))
        self.sender = Sender(self._peer.name, owner, self._address)
        self.max_frame = message.max_frame
        self.takes_batches = message.batches
        self.is_known = True
        return message

    async def endpoint(self, action: str, permission: Permission) -> Endpoint:
        """Return the endpoint of an action, if the client has that permission for it.

        Raises:
            AuthenticationFailed: It does not have it.
            ServerNotFound: The action is not served here.
        """
        assert self._peer is not None
        if not await self._settings.access.permits(self._peer, action, permission):
            raise AuthenticationFailed(
                f"this client may not {permission.value} at the action {excerpt(action)!r}"
            )
        return self.find(action)

    async def may_observe(self, action: str) -> bool:
        """Return whether the client may observe an action."""
        assert self._peer is not None
        return await self._settings.access.permits(self._peer, action, Permission.OBSERVE)

    def change_of(
        self, mode: IntakeMode, reason: str, by: str = "", worker: str = ""
    ) -> IntakeChange:
        """Return a change of how an action takes goals, by this client."""
        name = f"{self.name}, for {excerpt(by)}" if by and self.name else self.name or excerpt(by)
        return IntakeChange(mode, shortened(reason, LENGTH), name, worker=worker)

    def is_owner(self, action: str, goal_id: GoalID) -> bool:
        """Return whether the endpoint of an action knows this client as the owner of a goal."""
        endpoint = self._endpoints.get(action)
        owner = b"" if endpoint is None else endpoint.owner_of(goal_id)
        return bool(owner) and compare_digest(owner, self.sender.owner)

    def find(self, action: str) -> Endpoint:
        """Return the endpoint of an action.

        Raises:
            ServerNotFound: The action is not served here.
        """
        try:
            endpoint = self._endpoints[action]
        except KeyError:
            known = ", ".join(map(repr, sorted(self._endpoints))) or "nothing"
            raise ServerNotFound(
                f"the action {excerpt(action)!r} is not served here: there is {known}"
            ) from None
        self.actions.add(action)
        return endpoint
