"""What a Fibonacci goal asks for by its order: the same at the stock server and at ours."""

from __future__ import annotations

MOST = 100
"""Up to this, the order is one: that many terms, with feedback for each."""
WAITS = 1000
"""Ends when it is canceled, and has sent one feedback before."""
ABORTS = 1001
"""Aborts with the result `PART`."""
RAISES = 1002
STUBBORN = 1003
"""Refuses to be canceled; goes on until `RELEASES` is sent."""
RELEASES = 1004
"""Succeeds, and so do the stubborn goals; those that were deferred are executed."""
DEFERRED = 1005
"""Is accepted, and executed only after a goal `RELEASES`."""
FORGETS = 1006
"""Sends no status at the end (stock), or ends without a result (ours)."""
OVERFLOWS = 1007
"""Its result is out of the range of an int32 (ours)."""
FEEDBACK_OVERFLOWS = 1008
"""The second of its three feedback messages is out of range (ours)."""
CANCEL_RAISES = 1009
"""The callback that is asked for its cancel raises."""
BURST = 10_000
"""From here on: so many feedback messages, as quickly as can be."""
REJECTED, GOAL_RAISES = -1, -2
PART = [5, 3]
