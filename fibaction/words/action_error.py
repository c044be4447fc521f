"""The root of all errors, on its own: errors know goals, and goals know statuses."""


class ActionError(Exception):
    """The root: `except ActionError` catches all that fibaction raises on purpose.

    Programming errors are not included: they raise `TypeError`, `ValueError`, or, for a server that
    is started twice, `RuntimeError`.
    """
