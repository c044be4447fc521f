"""From a URL to a transport, through the entry-point group `fibaction.transports`.

So a package that nobody here has heard of can bring a transport of its own.
"""

from __future__ import annotations

from importlib.metadata import entry_points

from fibaction.abc import Transport
from fibaction.exceptions import TransportError

GROUP = "fibaction.transports"


def transport_for(where: str | Transport) -> Transport:
    """The transport that a URL asks for; a transport is given back as it is.

    Raises:
        TransportError: No installed package brings a transport for the URL's scheme, or what that
            transport needs is not installed, or the URL is not one.
    """
    if isinstance(where, Transport):
        return where
    scheme, separator, _ = where.partition("://")
    if not separator:
        raise TransportError(f"{where!r} is no URL: write it like tcp://127.0.0.1:7400")
    found = tuple(entry_points(group=GROUP, name=scheme))
    if not found:
        known = ", ".join(sorted({f"{entry.name}://" for entry in entry_points(group=GROUP)}))
        raise TransportError(
            f"no transport for {scheme}:// is installed; there is {known or 'none at all'}"
        )
    try:
        transport: type[Transport] = found[0].load()
    except ImportError as exc:
        raise TransportError(
            f"{scheme}:// needs the module {exc.name!r}, which is not installed: install it,"
            f" or the extra of {found[0].dist.name if found[0].dist else 'its package'!r}"
            f" that brings it"
        ) from exc
    return transport.from_url(where)
