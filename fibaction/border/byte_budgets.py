"""Limits for the bytes that many parts hold together.

A stranger must not fill the memory of a server, however many connections it opens. So the parts
that hold bytes of peers share a `ByteBudget`. Where it is not known who lets go of the bytes last,
`CountedBytes` counts them for as long as anything references it:

    held = CountedBytes(budget, len(body))
    if budget.is_over:
        raise LimitReached("...")
"""

from fibaction._runtime.budget import ByteBudget, CountedBytes

__all__ = ["ByteBudget", "CountedBytes"]
