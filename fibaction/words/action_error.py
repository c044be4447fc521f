"""The root of all errors, on its own: errors know goals, and goals know statuses."""


class ActionError(Exception):
    """Base class of all errors that fibaction raises on purpose: `except ActionError` catches them.

    Programming errors are not included: they raise `TypeError`, `ValueError`, or, for a server that
    is started twice, `RuntimeError`.
    """
