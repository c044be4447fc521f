"""`AgentApplication`: the requests that a server for agents lets in.

They are let in by the rules of this project's web servers: the `Host` must be this machine or an
address, the `Origin` none or the same, and the token must be right, before anything is read. So no
page of a browser and no other user of the machine can move a robot.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import ClassVar

from fibaction.border.byte_budgets import ByteBudget
from fibaction.border.http_access import HttpRules, Refused, bearer_in
from fibaction.wire.auth import AccessPolicy
from fibaction.wire.frames import FrameMemory
from fibaction.wire.settings import Limits
from fibaction_transports._http.application import HttpApplication
from fibaction_transports._http.exchange import App, Exchange


class AgentApplication(HttpApplication):
    """An application of others, which gets only the requests that are permitted."""

    page_headers: ClassVar[str] = (
        f"{HttpApplication.page_headers}, a2a-version, mcp-protocol-version, mcp-session-id"
    )
    shown_headers: ClassVar[str] = "mcp-session-id"

    def __init__(
        self,
        app: App,
        rules: HttpRules,
        access: AccessPolicy,
        limits: Limits,
        public: Collection[str] = (),
    ) -> None:
        """Guard an application; anyone may read its `public` paths.

        In its scope, `state["client"]` is the client with a valid token, or None.
        """
        self._bodies = ByteBudget(limits.total_memory)
        super().__init__(rules, limits, FrameMemory(self._bodies))
        self._app = app
        self._access = access
        self._public = public

    async def answer(self, exchange: Exchange) -> None:
        token = bearer_in(exchange.headers)
        peer = self._access.admit(exchange.peer, token) if token else None
        is_read = exchange.method in ("GET", "HEAD")
        if peer is None and not (is_read and exchange.path in self._public):
            reason = "the header Authorization must be: Bearer, and the token of the bridge"
            raise Refused(401, reason, ("WWW-Authenticate", "Bearer"))
        await exchange.hand_to(self._app, {"client": peer}, self.limits.frame, self._bodies)
