"""Which HTTP requests a server lets in: the path, the host, and the page that asks.

A browser lets every page open a WebSocket to every address, even to one of this machine, and says
by `Origin` which page it was. So a page may only use the server that it came from, or one that
names it in `origins`. A page of another host may still point its own name at this machine after it
was loaded ("DNS rebinding"): then `Origin` and `Host` agree, but the name is foreign. So `Host`
must be an address, a name of this machine, or one of `hosts`. With TLS the certificate keeps such
names away, and `Host` is not checked. Clients that are not browsers send no `Origin`.

Every server of HTTP or WebSocket needs these rules, for example:

    access = rules(host, "/", hosts=(), origins=(), has_tls=False)
    try:
        access.check(target, headers)
    except Refused as exc:
        answer(exc.status, str(exc))
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from urllib.parse import urlsplit

__all__ = ["HttpRules", "Refused", "bearer_in", "headers_in", "rules"]

EVERY = "*"
"""In `origins` or `hosts`: all of them."""


class Refused(Exception):
    """A request that a server does not let in: the HTTP status, and the reason."""

    def __init__(self, status: int, reason: str, *headers: tuple[str, str]) -> None:
        super().__init__(reason)
        self.status = status
        self.headers = headers
        """Headers that belong to the answer with this status."""


@dataclass(frozen=True)
class HttpRules:
    """The rules of one server."""

    path: str
    """The only path that it serves."""
    hosts: frozenset[str]
    """Names under which it is reached, without ports."""
    origins: frozenset[str]
    """Other pages that may use it, for example `https://robot.example`."""
    has_tls: bool = False
    """True if it speaks TLS itself, and so do its pages."""

    def check(self, target: str, headers: Mapping[str, str]) -> None:
        """Check the target and the headers of a request, whose names are in lower case.

        Raises:
            Refused: One of them is not permitted.
        """
        path = target.partition("?")[0]
        if path != self.path:
            raise Refused(404, f"there is nothing at {path}: the server is at {self.path}")
        self.check_sources(headers, has_tls=self.has_tls)

    def check_sources(self, headers: Mapping[str, str], *, has_tls: bool = False) -> None:
        """Check the host and the page of a request, as `check` does.

        Raises:
            Refused: One of them is not permitted.
        """
        host = headers.get("host", "")
        if not (has_tls or self._serves(host)):
            raise Refused(
                421, f"the server is not known as {host!r}: name it in its setting hosts="
            )
        origin = headers.get("origin")
        if origin is not None and not self._admits(origin, host, has_tls=has_tls):
            raise Refused(
                403, f"pages of {origin!r} may not use the server: name them in its origins="
            )

    def _serves(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return EVERY in self.hosts or name in self.hosts or _is_address(name)

    def _admits(self, origin: str, host: str, *, has_tls: bool) -> bool:
        if EVERY in self.origins or origin.lower() in self.origins:
            return True
        if origin.lower() == f"https://{host.lower()}":
            return True  # else TLS may end at a proxy, so the scheme of the page may be either
        return not has_tls and origin.lower() == f"http://{host.lower()}"


def rules(
    host: str, path: str, *, hosts: tuple[str, ...], origins: tuple[str, ...], has_tls: bool
) -> HttpRules:
    """Return the rules of a server that listens at a host."""
    here = socket.gethostname().lower()
    names = {"localhost", host.lower(), here, f"{here}.local", *(one.lower() for one in hosts)}
    if has_tls:
        names.add(EVERY)
    named = frozenset(one.lower() for one in origins)
    return HttpRules(path, frozenset(names), named, has_tls)


def headers_in(raw: Iterable[tuple[bytes, bytes]]) -> dict[str, str]:
    """Return the headers of a request, whose names are in lower case.

    A header that comes twice is one with both values, as RFC 9110 (5.3) has it, so a second `Host`
    or `Origin` fits no rule.
    """
    headers: dict[str, str] = {}
    for key, value in raw:
        name, text = key.decode("latin-1").lower(), value.decode("latin-1")
        headers[name] = f"{headers[name]}, {text}" if name in headers else text
    return headers


def bearer_in(headers: Mapping[str, str]) -> str:
    """Return the access token in the headers of a request; empty if there is none."""
    scheme, _, text = headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer":
        return ""
    return text.strip().encode("latin-1").decode(errors="replace")


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
