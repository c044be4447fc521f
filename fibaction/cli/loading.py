"""The servers of a module of the user's, named as `module:server`; or what is wrong with it, if it
gives none.
"""

from __future__ import annotations

import inspect
import pkgutil
import sys
import traceback
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

from fibaction.cli.app import nearest
from fibaction.cli.ending import ExitCode, Failure
from fibaction.server import ActionServer

AnyServer: TypeAlias = ActionServer[Any, Any, Any]


class Target(NamedTuple):
    """What `module:server` says."""

    module: str
    attribute: str

    def __str__(self) -> str:
        return f"{self.module}:{self.attribute}"


def parse(target: str) -> Target:
    """Take `module:server` apart.

    Raises:
        Failure: It is something else.
    """
    path, _, attribute = target.partition(":")
    module = path.removesuffix(".py").strip("/").removeprefix("./").replace("/", ".")
    names = [*module.split("."), *attribute.split(".")]
    if all(name.isidentifier() for name in names) and module == path:
        return Target(module, attribute)
    near = f"{module}:{attribute or 'server'}"
    hint = f"; did you mean {near}?" if all(map(str.isidentifier, module.split("."))) else ""
    raise Failure(f"{target!r} is not written as module:server{hint}", ExitCode.USAGE)


def load(target: str) -> list[AnyServer]:
    """Import the module, from the current folder or from where else Python finds it, and take the
    servers from it.

    Raises:
        Failure: That cannot be done; the text says why, and what may have been meant.
    """
    found = parse(target)
    add_current_folder()
    try:
        module = import_module(found.module)
    except ModuleNotFoundError as exc:
        if f"{found.module}.".startswith(f"{exc.name}."):
            raise no_module(found.module) from exc
        raise _broken(found, exc) from exc
    except Exception as exc:  # whatever the user's module does
        raise _broken(found, exc) from exc
    value = _attribute(found, module)
    return _servers_in(found, module, _called(found, module, value))


def add_current_folder() -> None:
    """Let Python find modules in the current folder, as it does for `python -m`."""
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)


def no_module(name: str) -> Failure:
    """What to say of a module that is not there, with the nearest that is."""
    *parents, last = name.split(".")
    paths: Iterable[str] = [str(Path.cwd())]
    for depth in range(len(parents)):
        # Those that were imported: the first that was not is the one that is missing.
        parent = sys.modules.get(".".join(parents[: depth + 1]))
        if parent is None:
            parents, last = parents[:depth], parents[depth]
            break
        paths = getattr(parent, "__path__", ())
    known = [found.name for found in pkgutil.iter_modules(paths)]
    text = f"there is no module {'.'.join([*parents, last])!r}"
    if near := nearest(last, known):
        text += f"; did you mean {'.'.join([*parents, near])}?"
    elif not parents:
        text += f" in {Path.cwd()}, nor installed"
    return Failure(text, ExitCode.USAGE)


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
            raise Failure(text, ExitCode.USAGE)
        value = getattr(value, name)
    return value


def _servers_of(module: Any) -> list[str]:
    """The names of the servers in a module."""
    names: dict[str, object] = getattr(module, "__dict__", {})
    return [name for name, value in names.items() if isinstance(value, ActionServer)]


def _called(target: Target, module: ModuleType, value: Any) -> Any:
    """What the user's function gives; anything else as it is."""
    if issubclass(type(value), ActionServer) or not callable(value):
        return value
    if inspect.iscoroutinefunction(value) or inspect.isasyncgenfunction(value):
        text = "is an async function, and not an ActionServer or what gives one"
        raise _no_server(target, module, text)
    with suppress(ValueError):  # some of what is built in does not say what it takes
        try:
            inspect.signature(value).bind()
        except TypeError as exc:
            text = f"cannot be called without arguments: {exc}"
            raise _no_server(target, module, text) from exc
    try:
        return value()
    except Exception as exc:  # whatever the user's function does
        raise _broken(target, exc) from exc


def _servers_in(target: Target, module: ModuleType, value: Any) -> list[AnyServer]:
    several = issubclass(type(value), list | tuple)
    found: list[Any] = list(value) if several else [value]
    wrong = [type(one).__name__ for one in found if not isinstance(one, ActionServer)]
    if wrong or not found:
        place = "in the list " if several else ""
        what = f"gives {place}something of type {wrong[0]}" if wrong else "gives nothing"
        raise _no_server(target, module, f"{what}, and not an ActionServer or several")
    return found


def _no_server(target: Target, module: ModuleType, text: str) -> Failure:
    """What to say of something that is no server, with those that the module has."""
    others = [f"{target.module}:{name}" for name in _servers_of(module)]
    there = f"; there is {', '.join(others)}" if others else ""
    return Failure(f"{target} {text}{there}", ExitCode.USAGE)


def _broken(target: Target, error: Exception) -> Failure:
    """What to say of an exception of the user's code: where it was, and what."""
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
    return Failure(f"{target}: {file}, line {line}: {said}", ExitCode.USAGE)
