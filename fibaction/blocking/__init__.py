"""Clients and servers for programs without an event loop: `with`, `for`, and plain calls.

    from fibaction.blocking import connect

    with connect("tcp://127.0.0.1:7400", ACTION) as client:
        print(client.call(3, on_feedback=print))

A connection has an event loop of its own, in a thread that ends with the block. Ctrl-C cancels the
goals of the block. `call` sends one goal, `track` shows the progress of one, and `serve` serves
functions.
"""

from fibaction.blocking._blocking_client import BlockingClient, BlockingConnection
from fibaction.blocking._blocking_goal import BlockingFeedback, BlockingGoal, track
from fibaction.blocking._open_block import BlockingServing, call, connect, serve

__all__ = [
    "BlockingClient",
    "BlockingConnection",
    "BlockingFeedback",
    "BlockingGoal",
    "BlockingServing",
    "call",
    "connect",
    "serve",
    "track",
]
