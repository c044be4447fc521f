"""Find the transport of a URL, through the entry-point group `fibaction.transports`.

So any installed package can bring a transport.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from functools import cache
from typing import Any
from urllib.parse import SplitResult, parse_qsl, urlsplit

from fibaction._runtime.settings_struct import unknown_setting
from fibaction._runtime.text import nearest
from fibaction.border.abc import Transport
from fibaction.words.errors import InvalidURL, TransportError
from fibaction.words.extras import MissingExtra

GROUP = "fibaction.transports"


def transport_for(where: str | Transport, **settings: Any) -> Transport:
    """Return the transport of a URL; a transport is returned as it is.

    `settings` go to the constructor of the transport, and count for more than those in the URL.

    Raises:
        InvalidURL: The URL is malformed, or no installed package has a transport for its scheme.
        TransportError: A package that the transport needs is not installed.
        TypeError: The transport has no such setting; or `where` is a transport, which has its
            settings already, or is something else.
    """
    if isinstance(where, Transport):
        if settings:
            raise TypeError(f"{', '.join(settings)}: these belong into the transport's constructor")
        return where
    _check_is_address(where)
    scheme, separator, _ = where.partition("://")
    if not separator:
        shown = without_settings(where)
        raise InvalidURL(f"{shown!r} is not a URL: write it like tcp://127.0.0.1:7400")
    return transport_class(scheme).from_url(where, **settings)


@cache  # to read what each installed package declares takes longer than to connect
def transport_class(scheme: str) -> type[Transport]:
    """Return the transport of a scheme, which is looked for until it is found.

    Raises:
        InvalidURL: No installed package has a transport for the scheme.
        TransportError: A package that the transport needs is not installed.
    """
    from importlib.metadata import entry_points  # slow to import, and needed here only

    found = tuple(entry_points(group=GROUP, name=scheme))
    if not found:
        names = {entry.name for entry in entry_points(group=GROUP)}
        known = ", ".join(sorted(f"{name}://" for name in names))
        near = nearest(scheme, names)
        hint = f": did you mean {near}://? Installed" if near else "; installed"
        raise InvalidURL(
            f"no transport for {scheme}:// is installed{hint} are {known or 'none at all'}"
        )
    try:
        transport: type[Transport] = found[0].load()
    except TransportError:
        raise  # it says by itself what it needs
    except MissingExtra as exc:
        raise TransportError(f"{scheme}:// needs {exc.advice}") from exc
    except ModuleNotFoundError as exc:
        raise TransportError(
            f"{scheme}:// needs the module {exc.name!r}, which is not installed: install it,"
            f" or the extra of {found[0].dist.name if found[0].dist else 'its package'!r}"
            f" that brings it"
        ) from exc
    except Exception as exc:  # the import of any other package may raise anything
        raise TransportError(
            f"the transport for {scheme}://, {found[0].value}, cannot be imported: {exc}"
        ) from exc
    return transport


def _check_is_address(where: object) -> None:
    """Check that an address is text, and not for example a server.

    Raises:
        TypeError: It is not.
    """
    if not isinstance(where, str):
        raise TypeError(
            f"an address is a URL such as 'tcp://127.0.0.1:7400', or a transport, and not {where!r}"
        )


def without_settings(url: str) -> str:
    """Return a URL without anything that may be secret, for errors and logs.

    Its settings may have a token, and there may be a password before an `@`.
    """
    return re.sub("://[^/]*@", "://", url.partition("?")[0])


def split_url(url: str) -> tuple[SplitResult, dict[str, str]]:
    """Split a URL into its parts, and the settings after its `?`, as text.

    Raises:
        InvalidURL: It is malformed, it has a part behind `#`, or a setting is given twice.
    """
    with invalid_url(url):
        parts = urlsplit(url)
    if "#" in url:
        raise InvalidURL(
            f"{without_settings(url)} has a part behind #, which has no meaning here: write %23 if"
            f" the # belongs to a path or a token"
        )
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    settings = dict(pairs)
    if len(settings) < len(pairs):
        raise InvalidURL(f"{without_settings(url)}: setting given twice")
    return parts, settings


@contextmanager
def invalid_url(url: str) -> Generator[None, None, None]:
    """Turn a ValueError of the block into the error of a URL."""
    try:
        yield
    except ValueError as exc:
        raise InvalidURL(f"{without_settings(url)}: {exc}") from exc


def check_settings(where: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Check that a transport, or a server, has all settings that it is given by keyword.

    Raises:
        TypeError: It does not have one; the text lists those that it has.
    """
    names = tuple(known)
    for name in given:
        if name not in names:
            raise TypeError(unknown_setting(where, name, names))
