"""What a URL of these transports says: where the server is, and settings behind the `?`."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import SplitResult, parse_qsl, urlsplit

from fibaction.exceptions import TransportError
from fibaction.urls import without_settings

IN_CODE = ("tokens", "authorize", "limits")
"""Settings that no URL has: a URL ends up in logs, and is only text."""


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
    settings: dict[str, Any] = {}
    for name, text in query.items():
        try:
            if name in ("heartbeat", "reconnect_timeout", "grace"):
                settings[name] = float(text)
            elif name == "reconnect" or name in more & {"insecure"}:
                settings[name] = {"true": True, "false": False}[text]
            elif name == "window":
                settings[name] = int(text)
            elif name in {"token", "orphans"} | more:
                settings[name] = text
            elif name in IN_CODE:
                raise TransportError(
                    f"{without_settings(url)} cannot have the setting {name!r}: it is given in"
                    f" code, as in serve(..., {name}=...), and not in a URL, which ends up in logs"
                )
            else:
                raise TransportError(f"{without_settings(url)} has no setting {name!r}")
        except (ValueError, KeyError):
            raise TransportError(
                f"{without_settings(url)}: the setting {name!r} cannot be {text!r}"
            ) from None
    return settings
