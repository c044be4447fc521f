"""ROS 2 actions for asyncio, with or without ROS.

A client sends a goal; the server accepts or rejects it, streams feedback, and ends it with a
result; a client may cancel at any time. This package exports all names that programs need for that.

`fibaction.testing` has helpers for tests, `fibaction.action_files` has `load_action`, which makes
an action from an `.action` file of ROS 2, and `fibaction.abc` is for authors of transports.
"""

TYPE_CHECKING = False  # type checkers know the name; an import of `typing` would cost time

if TYPE_CHECKING:
    from fibaction._public import *  # noqa: F403 - all that is public
    from fibaction._public import __all__ as __all__
else:
    # The names are imported at the first use of one of them. The command line is imported through
    # this module, and handles Ctrl-C before it imports more.

    def __getattr__(name: str) -> object:
        if name == "__all__" or not name.startswith("_"):
            from fibaction import _public

            globals().update({one: getattr(_public, one) for one in _public.__all__})
            globals()["__all__"] = _public.__all__
            if name in globals():
                return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        from fibaction import _public

        return sorted({*globals(), *_public.__all__})
