"""The actions whose interface files this program has loaded, by their types."""

from __future__ import annotations

from fibaction.interfaces.files import ActionFile

_KNOWN: dict[str, ActionFile] = {}


def remember(action: ActionFile) -> None:
    """Remember a file for transports that need its definitions; of one type the last one counts."""
    if action.type_name:
        _KNOWN[action.type_name] = action


def known_action(type_name: str) -> ActionFile | None:
    """Return the file of a type; None if it was not loaded."""
    return _KNOWN.get(type_name)
