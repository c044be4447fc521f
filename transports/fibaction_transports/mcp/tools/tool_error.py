"""`ToolError`: an answer to a model that something did not work."""

from __future__ import annotations


class ToolError(Exception):
    """The answer of a tool that did not do what it was asked for.

    The text is for the model: it says what happened, and what to do next.
    """
