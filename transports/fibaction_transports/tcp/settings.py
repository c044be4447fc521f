"""What a URL of these transports says: where the server is, and settings behind the `?`."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import SplitResult, parse_qsl, urlsplit

from fibaction.exceptions import TransportError
from fibaction.urls import without_settings

IN_CODE = ("tokens", "authorize", "limits")
"""Settings that no URL has: a URL ends up in logs, and is only text."""

_yes_or_no = {"true": True, "false": False}.__getitem__
_KINDS: dict[str, Callable[[str], Any]] = {
    "token": str,
    "heartbeat": float,
    "reconnect": _yes_or_no,
    "reconnect_timeout": float,
    "window": int,
    "orphans": str,
    "grace": float,
}
_MORE: dict[str, Callable[[str], Any]] = {
    "insecure": _yes_or_no,
    "ca": str,
    "cert": str,
    "key": str,
}
"""What only some of the transports have."""


def split(url: str) -> tuple[SplitResult, dict[str, str]]:
    """A URL in its parts, and what stands behind its `?`.

    Raises:
        TransportError: It is none, or some of it would be left out silently.
    """
    with translated(url):
        parts = urlsplit(url)
    if "#" in url:
        raise TransportError(
            f"{without_settings(url)} has a part behind #, which says nothing here: write %23 if"
            f" the # belongs to a path or a token"
        )
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    settings = dict(pairs)
    if len(settings) < len(pairs):
        raise TransportError(f"{without_settings(url)} has a setting twice: say it once")
    return parts, settings


def check_has_host_only(url: str, parts: SplitResult) -> None:
    """See that nothing but a host stands before the `?`, or it would be left out silently.

    Raises:
        TransportError: Something does.
    """
    for what, is_there in (
        ("user", "@" in parts.netloc),
        ("path", parts.path not in ("", "/")),
    ):
        if is_there:
            raise TransportError(
                f"{without_settings(url)} has a {what}, and the URL of a server is like"
                f" {parts.scheme}://host:port, with settings behind ? such as token="
            )


@contextmanager
def translated(url: str) -> Generator[None, None, None]:
    """A value that cannot be is the URL's fault."""
    try:
        yield
    except ValueError as exc:
        raise TransportError(f"{without_settings(url)}: {exc}") from exc


def settings_of(url: str, query: Mapping[str, str], more: set[str]) -> dict[str, Any]:
    """The settings in a URL, of their types: those that all have, and `more`.

    Raises:
        TransportError: There is no such setting, or it cannot have such a value.
    """
    kinds = _KINDS | {name: kind for name, kind in _MORE.items() if name in more}
    settings: dict[str, Any] = {}
    for name, text in query.items():
        if name in IN_CODE:
            raise TransportError(
                f"{without_settings(url)} cannot have the setting {name!r}: it is given in code,"
                f" as in serve(..., {name}=...), and not in a URL, which ends up in logs"
            )
        if name not in kinds:
            raise TransportError(
                f"{without_settings(url)} has no setting {name!r}; there is {', '.join(kinds)}"
            )
        try:
            settings[name] = kinds[name](text)
        except (ValueError, KeyError):
            raise TransportError(
                f"{without_settings(url)}: the setting {name!r} cannot be {text!r}"
            ) from None
    return settings
