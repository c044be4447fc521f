"""Orders of Fibonacci goals with a meaning, for the stock server and for that of fibaction."""

from __future__ import annotations

MOST = 100
"""The greatest real order: so many terms, with feedback for each."""
WAITS = 1000
"""Ends when it is canceled, and has sent one feedback before."""
ABORTS = 1001
"""Aborts with the result `PART`."""
RAISES = 1002
STUBBORN = 1003
"""Rejects its cancel; goes on until `RELEASES` is sent."""
RELEASES = 1004
"""Succeeds, and so do the stubborn goals; those that were deferred are executed."""
DEFERRED = 1005
"""Is accepted, and executed only after a goal `RELEASES`."""
FORGETS = 1006
"""Sends no status at the end (stock), or ends without a result (ours)."""
CANCEL_RAISES = 1009
"""Its cancel callback raises."""
BURST = 10_000
"""Plus a number: so many feedback messages, as fast as possible."""
RATED = 100_000
"""Plus a number: so many feedback messages, with `PERIOD` between them."""
PERIOD = 0.005
REJECTED, GOAL_RAISES = -1, -2
PART = [5, 3]
