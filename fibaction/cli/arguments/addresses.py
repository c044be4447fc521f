"""Named addresses of servers, from the user's configuration file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

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
