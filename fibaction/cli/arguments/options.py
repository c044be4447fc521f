"""The options that most verbs have: `--json`, and `--url`, with addresses that users have named."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

from fibaction._runtime.text import nearest
from fibaction.cli.process.exit_codes import Failure
from fibaction.words.plain_data import is_map

TABLE = "addresses"
"""The table of the file with a URL for each name."""


class _AddressName(click.ParamType[str]):
    """The name of an address."""

    name = "address"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        try:
            names = addresses()
        except Failure:
            return []
        return [CompletionItem(name) for name in sorted(names) if name.startswith(incomplete)]


ADDRESS = _AddressName()


def config_file() -> Path:
    """Return the path of the configuration file."""
    if path := os.environ.get("FIBACTION_CONFIG"):
        return Path(path)
    folder = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(folder, "fibaction", "config.toml")


def addresses() -> dict[str, str]:
    """Return the URL of each named address; none if there is no file.

    Raises:
        Failure: The file cannot be read, or has another form.
    """
    import tomllib  # it would slow down --help

    path = config_file()
    try:
        config: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except OSError as exc:
        raise Failure(f"{path}: {exc.strerror}") from exc
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as exc:
        raise Failure(f"{path} is not TOML: {exc}") from exc
    except RecursionError as exc:
        raise Failure(f"{path} is nested too deeply") from exc
    found: object = config.get(TABLE, {})
    if not is_map(found) or not all(isinstance(url, str) for url in found.values()):
        raise Failure(
            f'{path}: [{TABLE}] has a URL for each name, such as robot = "tcp://robot:7400"'
        )
    return found


def address_of(name: str) -> str:
    """Return the URL of a named address.

    Raises:
        Failure: There is no such name, or the file cannot be used.
    """
    known = addresses()
    if name in known:
        return known[name]
    text = f"{config_file()} has no address {name!r}"
    if near := nearest(name, known):
        text += f"; did you mean {near}?"
    elif known:
        text += f"; it has {', '.join(sorted(known))}"
    else:
        text += f': write it below [{TABLE}] as {name} = "tcp://{name}:7400"'
    raise Failure(text)


FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

URL = "tcp://127.0.0.1:7400"
"""The default URL; the TCP transport's own default."""


def url_of(context: click.Context) -> str:
    """Return the URL that counts for a verb: its own --url or FROM_URL, or what is said before the
    verb.

    Raises:
        Failure: The named address is not known.
    """
    if own := context.params.get("url") or context.params.get("from_url"):
        return str(own)
    before = context.find_root().params
    if name := before.get("address"):
        return address_of(name)
    return before.get("url") or URL


def reject_inproc(*urls: str) -> None:
    """Check that another process can be reached by at least one of these URLs.

    Raises:
        Failure: All of them are `inproc://`.
    """
    if all(url.startswith("inproc://") for url in urls):
        from fibaction.border.urls import without_settings  # its imports would slow down --help

        raise Failure(
            f"{without_settings(urls[0])} is for clients in the process of the server:"
            f" between processes, use tcp:// or unix://"
        )


def _url_to_reach(context: click.Context, _: click.Parameter, value: str | None) -> str:
    url = value or url_of(context)
    reject_inproc(url)
    return url


def url_option(function: FunctionT) -> FunctionT:
    """Add `--url` to a verb. The function gets `url`: by default the group's."""
    return click.option(
        "-u",
        "--url",
        metavar="URL",
        callback=_url_to_reach,
        help="URL of the server.  [as in fibaction --help]",
    )(function)


class NumberType(click.FloatRange):
    """A number that is at least 0, or above it, and not `nan`, which is in no range."""

    def __init__(self, *, min_open: bool = True) -> None:
        super().__init__(min=0, min_open=min_open)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number: float = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail(f"{value!r} is not a number")
        return number


class TimeType(click.ParamType[int]):
    """A time, in nanoseconds since 1970: ISO 8601, a stamp, or a time ago such as `10m`."""

    name = "time"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> int:
        from fibaction.words.goal_query import time_of  # its imports would slow down --help

        try:
            return time_of(value, time.time_ns(), is_local=True)
        except ValueError as exc:
            self.fail(str(exc))


class LabelType(click.ParamType[tuple[str, str]]):
    """A label of a goal, by its key and its value: KEY=VALUE."""

    name = "key=value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str]:
        from fibaction.words.goal_query import label_of  # its imports would slow down --help

        try:
            return label_of(value)
        except ValueError as exc:
            self.fail(str(exc))


def labels_option(text: str) -> Callable[[FunctionT], FunctionT]:
    """Add `--label` to a verb, with that help. The function gets `labels`."""
    return click.option("--label", "labels", type=LabelType(), multiple=True, help=text)


def json_option(function: FunctionT) -> FunctionT:
    """Add `--json` to a verb. The function gets `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON, one value per line.")(
        function
    )


def full_option(function: FunctionT) -> FunctionT:
    """Add `--full` to a verb. The function gets `full`."""
    return click.option("--full", is_flag=True, help="Show long lists and texts in full.")(function)
