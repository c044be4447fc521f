"""The meta of a goal: a small text map that goes with it, for traces.

`Endpoint.send_goal` gets it. A transport carries it if it can, and rejects one that is too large:

    carried = checked_meta(meta)  # a copy; None if it is empty
    size = len(goal) + size_of(carried)

`trace_meta` makes the meta of a goal from the headers of a trace.
"""

from fibaction.words.meta import Meta, checked_meta, size_of, trace_meta

__all__ = ["Meta", "checked_meta", "size_of", "trace_meta"]
