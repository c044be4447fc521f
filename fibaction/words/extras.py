"""The sentence about a missing extra: what needs it, and how to install it.

For example, at the top of a package whose modules import h11:

    with NeedsExtra("my_transport", "my-transport[web]"):
        from my_transport.server import Server
"""

from __future__ import annotations

from typing import Final

OURS: Final = ("fibaction", "fibaction_transports")
"""Packages that come with each other, so that no extra brings a module of them."""


class MissingExtra(ModuleNotFoundError):
    """A module of an extra that is not installed, or is too old."""

    advice: str = ""
    """The missing module, and the command that installs it."""


class NeedsExtra:
    """A block that imports modules of an extra, such as `fibaction[web]`.

    A module that is not found there raises `MissingExtra`, with the name of what needs it.
    """

    def __init__(self, what: str, extra: str) -> None:
        self._what = what
        self._extra = extra

    def __enter__(self) -> None:
        """Begin the block."""

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        """End the block.

        Raises:
            MissingExtra: A module was not found in it, and is not one of fibaction itself.
        """
        if not isinstance(error, ImportError) or isinstance(error, MissingExtra):
            return
        missing = (error.name or "").partition(".")[0]
        if missing and missing not in OURS:
            advice = f"{missing}: pip install '{self._extra}'"
            told = MissingExtra(f"{self._what} needs {advice}", name=missing)
            told.advice = advice
            raise told from error
