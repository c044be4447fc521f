"""Import of the servers that the user names as `module:server`."""

from __future__ import annotations

import inspect
import pkgutil
import sys
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

from fibaction._runtime.text import nearest
from fibaction.cli.process.exit_codes import Failure
from fibaction.server import ActionServer, FunctionAction, actions_of

AnyServer: TypeAlias = ActionServer[Any, Any, Any]


class Target(NamedTuple):
    """A module, and a dotted name in it."""

    module: str
    attribute: str

    def __str__(self) -> str:
        return f"{self.module}:{self.attribute}"


def parse(target: str) -> Target:
    """Split `module:server`.

    Raises:
        Failure: The text is not written so.
    """
    path, _, attribute = target.partition(":")
    module = path.removesuffix(".py").strip("/").removeprefix("./").replace("/", ".")
    names = [*module.split("."), *attribute.split(".")]
    if all(name.isidentifier() for name in names) and module == path:
        return Target(module, attribute)
    near = f"{module}:{attribute or 'server'}"
    hint = f"; did you mean {near}?" if all(map(str.isidentifier, module.split("."))) else ""
    raise Failure(f"{target!r} is not written as module:server{hint}")


def import_servers(target: str) -> list[AnyServer]:
    """Import the module, and return the servers that the target names or its function returns.

    The module may be in the current folder or wherever Python finds modules.

    Raises:
        Failure: The module cannot be imported, or has no such servers.
    """
    found = parse(target)
    add_current_folder()
    try:
        module = import_module(found.module)
    except Exception as exc:
        if isinstance(exc, ModuleNotFoundError) and f"{found.module}.".startswith(f"{exc.name}."):
            raise no_module(found.module) from exc
        raise _broken(found, exc) from exc
    named = _attribute(found, module)
    try:
        value = _call(found, module, named)
        several = issubclass(type(value), list | tuple)
        given: list[Any] = list(value) if several else [value]
        servers = [server for one in given for server in _servers_of_one(one)]
    except TypeError as exc:
        raise Failure(f"{target}: {exc}") from exc
    wrong = [type(one).__name__ for one in servers if not isinstance(one, ActionServer)]
    if wrong or not servers:
        place = "in the list " if several else ""
        what = f"gives {place}something of type {wrong[0]}" if wrong else "gives nothing"
        raise _no_server(found, module, f"{what}, and not an ActionServer or several")
    return servers


def add_current_folder() -> None:
    """Let Python find modules in the current folder, as it does for `python -m`."""
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)


def no_module(name: str) -> Failure:
    """Return the error for a module that does not exist, with the most similar name."""
    *parents, last = name.split(".")
    paths: Iterable[str] = [str(Path.cwd())]
    for depth, part in enumerate(parents):
        # A parent that was not imported is the one that is missing.
        parent = sys.modules.get(".".join(parents[: depth + 1]))
        if parent is None:
            parents, last = parents[:depth], part
            break
        paths = getattr(parent, "__path__", ())
    known = [found.name for found in pkgutil.iter_modules(paths)]
    text = f"there is no module {'.'.join([*parents, last])!r}"
    if near := nearest(last, known):
        text += f"; did you mean {'.'.join([*parents, near])}?"
    elif not parents:
        text += f" in {Path.cwd()}, nor installed"
    return Failure(text)


def _attribute(target: Target, module: ModuleType) -> Any:
    value: Any = module
    for name in target.attribute.split("."):
        if not hasattr(value, name):
            servers = _servers_of(value)
            public = [known for known in dir(value) if not known.startswith("_")]
            text = f"{target.module} has no {target.attribute!r}"
            if near := nearest(name, servers) or nearest(name, public):
                text += f"; did you mean {target.module}:{near}?"
            elif servers:
                text += f"; there is {', '.join(servers)}"
            raise Failure(text)
        value = getattr(value, name)
    return value


def _call(target: Target, module: ModuleType, value: Any) -> Any:
    """Return what the user's function returns; anything else as it is."""
    is_served = issubclass(type(value), ActionServer) or actions_of(value)
    if is_served or not callable(value):
        return value
    if inspect.iscoroutinefunction(value) or inspect.isasyncgenfunction(value):
        text = "is an async function, and not an ActionServer or what gives one"
        raise _no_server(target, module, text)
    with suppress(ValueError):  # some built-in functions have no signature
        try:
            inspect.signature(value).bind()
        except TypeError as exc:
            text = f"cannot be called without arguments: {exc}"
            raise _no_server(target, module, text) from exc
    try:
        return value()
    except Exception as exc:
        raise _broken(target, exc) from exc


def _servers_of_one(value: Any) -> list[Any]:
    """Return the servers of the actions of a function or of an object; anything else as it is."""
    return [ActionServer(one) for one in actions_of(value)] or [value]


def _servers_of(module: Any) -> list[str]:
    """Return the names of the servers in a module."""
    names: dict[str, object] = getattr(module, "__dict__", {})
    return [
        name for name, value in names.items() if isinstance(value, ActionServer | FunctionAction)
    ]


def _no_server(target: Target, module: ModuleType, text: str) -> Failure:
    """Return the error for a value that is not a server, with the names of those that there are."""
    others = [f"{target.module}:{name}" for name in _servers_of(module)]
    there = f"; there is {', '.join(others)}" if others else ""
    return Failure(f"{target} {text}{there}")


def _broken(target: Target, error: Exception) -> Failure:
    """Return the error for an exception of the user's code, with its file and line."""
    import traceback

    file, line, text = "", 0, str(error)
    if isinstance(error, SyntaxError) and error.filename:
        file, line, text = error.filename, error.lineno or 0, error.msg
    else:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if Path(frame.filename).is_relative_to(Path.cwd())]
        for frame in (own or frames)[-1:]:
            file, line = frame.filename, frame.lineno or 0
    with suppress(ValueError):
        file = str(Path(file).relative_to(Path.cwd()))
    said = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return Failure(f"{target}: {file}, line {line}: {said}")
