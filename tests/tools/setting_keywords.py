"""Write the types of the settings as keyword arguments, for type checkers.

    python -m tests.tools.setting_keywords

A `TypedDict` cannot be made from a struct in a way that a type checker follows, so the module
`fibaction_transports.keywords` is made from the settings of all transports, and a test compares.
"""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import entry_points
from pathlib import Path

from fibaction.border.abc import Transport
from fibaction.border.settings import TransportSettings
from fibaction.border.urls import GROUP, transport_class
from fibaction.wire.transport import ConfiguredTransport
from fibaction_transports.web import WebTransport

ROOT = Path(__file__).resolve().parents[2]
WRITTEN = ROOT / "transports" / "fibaction_transports" / "keywords.py"
HEAD = '''"""The settings of the transports as keyword arguments, for type checkers.

Made from the settings of each transport by `python -m tests.tools.setting_keywords`, and not to be
changed by hand.
"""

from __future__ import annotations
'''


def in_order(kinds: Iterable[type[TransportSettings]]) -> list[type[TransportSettings]]:
    """The settings once each, base classes first."""
    return sorted(set(kinds), key=lambda kind: (len(kind.__mro__), kind.__name__))


def settings_of_transports() -> list[type[TransportSettings]]:
    """The settings of all transports."""
    found: set[type[Transport]] = {WebTransport}
    found.update(transport_class(entry.name) for entry in entry_points(group=GROUP))
    return in_order(one.settings_type for one in found if issubclass(one, ConfiguredTransport))


def with_bases(kinds: Iterable[type[TransportSettings]]) -> list[type[TransportSettings]]:
    """The settings, and those that they are made of."""
    return in_order(
        base
        for kind in kinds
        for base in kind.__mro__
        if issubclass(base, TransportSettings) and base is not TransportSettings
    )


def keywords_of(kind: type[TransportSettings]) -> str:
    """The name of the keyword arguments of settings."""
    return f"{kind.__name__.removesuffix('Settings')}Keywords"


def base_of(kind: type[TransportSettings]) -> type[TransportSettings]:
    """The settings that some are made of."""
    (base,) = kind.__bases__
    assert issubclass(base, TransportSettings)
    return base


def own_types(kind: type[TransportSettings]) -> dict[str, str]:
    """The types of the settings that the base class does not have, or has with another type."""
    known = base_of(kind).types()
    return {name: one for name, one in kind.types().items() if known.get(name) != one}


def joined(kinds: Iterable[type[TransportSettings]], left_out: str) -> dict[str, str]:
    """The types of all settings but those that one half does not read."""
    types: dict[str, str] = {}
    for kind in kinds:
        for name, written in kind.types().items():
            if name not in getattr(kind, left_out):
                known = types.setdefault(name, written)
                assert known == written, f"{name} has two types: {known} and {written}"
    return types


def imports_of(kinds: Iterable[type[TransportSettings]]) -> set[str]:
    """The imports that the types of the settings need, as the modules of the settings have them."""
    found: set[str] = set()
    for kind in kinds:
        words = set(re.findall(r"\w+", " ".join(own_types(kind).values())))
        module = inspect.getmodule(kind)
        assert module is not None
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.ClassDef) and node.name in words:
                found.add(f"from {module.__name__} import {node.name}")
            elif isinstance(node, ast.ImportFrom):
                names = [one.name for one in node.names if one.name in words]
                found.update(f"from {node.module} import {name}" for name in names)
    return found


def typed_dict(name: str, base: str, about: str, types: dict[str, str]) -> str:
    """The text of a `TypedDict`."""
    fields = "\n".join(f"    {name}: {written}" for name, written in types.items())
    return f'class {name}({base}, total=False):\n    """{about}"""\n\n{fields}\n'


def typed_dict_of(name: str, about: str, types: dict[str, str]) -> str:
    """The text of a `TypedDict` with these settings: those of as many transports as are whole in
    it, and the rest.
    """
    bases: list[type[TransportSettings]] = []
    for kind in reversed(with_bases(settings_of_transports())):
        is_whole = kind.types().items() <= types.items()
        if is_whole and not any(issubclass(base, kind) for base in bases):
            bases.insert(0, kind)
    known = {setting for base in bases for setting in base.types()}
    rest = {setting: written for setting, written in types.items() if setting not in known}
    return typed_dict(name, ", ".join(map(keywords_of, bases)), about, rest)


def made() -> str:
    """The text of the module."""
    own = settings_of_transports()
    kinds = with_bases(own)
    parts: list[str] = []
    for kind in kinds:
        base = base_of(kind)
        above = "TypedDict" if base is TransportSettings else keywords_of(base)
        about = f"The keyword arguments of `{kind.__name__}`."
        parts.append(typed_dict(keywords_of(kind), above, about, own_types(kind)))
    parts += [
        typed_dict_of(
            "ConnectKeywords",
            "The settings that `connect` passes on to the transport of a URL.",
            joined((kind for kind in own if kind.for_clients), "only_for_servers"),
        ),
        typed_dict_of(
            "ServeKeywords",
            "The settings that `serve` passes on to the transports of URLs.",
            joined((kind for kind in own if kind.for_servers), "only_for_clients"),
        ),
    ]
    imports = "\n".join(sorted({*imports_of(kinds), "from typing import TypedDict"}))
    text = "\n\n".join((HEAD, imports, *parts))
    for command in (["check", "--fix", "--quiet", "--select", "I"], ["format", "--quiet"]):
        text = subprocess.run(
            [sys.executable, "-m", "ruff", *command, "--stdin-filename", str(WRITTEN), "-"],
            input=text,
            capture_output=True,
            check=True,
            text=True,
        ).stdout
    return text


if __name__ == "__main__":
    WRITTEN.write_text(made(), encoding="utf-8")
