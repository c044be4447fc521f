"""Modules that are hidden from a process, as if they were not installed or not of this system."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


class _Blinkered:
    """A finder of modules that does not find some of them."""

    def __init__(self, finder: Any, hidden: frozenset[str]) -> None:
        self._finder = finder
        self._hidden = hidden

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name.partition(".")[0] in self._hidden:
            return None
        spec: ModuleSpec | None = self._finder.find_spec(name, path, target)
        return spec

    def __getattr__(self, name: str) -> Any:
        """The rest of a finder, such as finding distributions."""
        return getattr(self._finder, name)


def hide(*names: str) -> None:
    """Hide these modules, and what is in them, from all imports from here on.

    Raises:
        ValueError: One is imported already, so that hiding it would have no effect.
    """
    late = [name for name in names if name in sys.modules]
    if late:
        raise ValueError(f"already imported: {', '.join(late)}")
    finders: list[Any] = [_Blinkered(finder, frozenset(names)) for finder in sys.meta_path]
    sys.meta_path[:] = finders
