"""`Guarded`: the requests that a server for agents lets in.

They are let in by the rules of this project's web servers: the `Host` must be this machine or an
address, the `Origin` none or the same, and the token must be right, before anything is read. So no
page of a browser and no other user of the machine can move a robot.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, MutableMapping
from typing import Any

from fibaction.border.http_access import HttpRules, Refused, bearer_in, headers_in
from fibaction.border.peer_text import clean_logger
from fibaction.wire.auth import AccessPolicy, Peer

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Scope]]
Send = Callable[[Scope], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

logger = clean_logger("fibaction.agents")


class Guarded:
    """An ASGI application that lets in only the requests that are permitted."""

    def __init__(
        self, app: App, admitted: HttpRules, access: AccessPolicy, public: Collection[str] = ()
    ) -> None:
        """Guard an application, of which anyone may read the `public` paths.

        In its scope, `state["client"]` is the client with a valid token, or None.
        """
        self._app = app
        self._rules = admitted
        self._access = access
        self._public = public

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            try:
                peer = self._client_of(scope)
            except Refused as exc:
                await _refuse(exc, send)
                return
            scope["state"] = {**scope.get("state", {}), "client": peer}
        await self._app(scope, receive, send)

    def _client_of(self, scope: Scope) -> Peer | None:
        """Check the host, the page and the token of a request, and return its client.

        Raises:
            Refused: One of them is not permitted.
        """
        headers = headers_in(scope["headers"])
        self._rules.check_sources(headers, has_tls=scope.get("scheme") == "https")
        host, port = scope.get("client") or ("a client", 0)
        token = bearer_in(headers)
        peer = self._access.admit(f"{host}:{port}", token) if token else None
        if peer is None and not (scope["method"] == "GET" and scope["path"] in self._public):
            reason = "the header Authorization must be: Bearer, and the token of the bridge"
            raise Refused(401, reason, ("WWW-Authenticate", "Bearer"))
        return peer


async def _refuse(refused: Refused, send: Send) -> None:
    logger.warning("HTTP %d: %s", refused.status, refused, extra={"kind": refused.status})
    body = f"{refused}\n".encode()
    headers = [
        (name.lower().encode(), value.encode("latin-1"))
        for name, value in (
            *refused.headers,
            ("Content-Type", "text/plain; charset=utf-8"),
            ("Content-Length", str(len(body))),
        )
    ]
    await send({"type": "http.response.start", "status": refused.status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
