"""Names of subjects and streams of one fleet.

A token of a subject may not contain dots, spaces or wildcards, and names of actions and workers may
contain anything. So each byte that is not a letter, a digit, `_` or `-` is written as `=` and two
hexadecimal digits. IDs of goals are 32 hexadecimal digits.

    fib.<fleet>.offer.<action>           question for a worker that can run a goal now
    fib.<fleet>.queue.<action>           question for a worker that has room in its queue
    fib.<fleet>.taken.<worker>           hint to a worker that another one has taken a goal of it
    fib.<fleet>.reads.<worker>.<action>  question to a worker whether it can run a goal
    fib.<fleet>.up.<worker>.<client>.<line>     pieces of a line, from a client to a worker
    fib.<fleet>.down.<client>.<line>            pieces of a line, from a worker to a client
    fib.<fleet>.goal.<action>.<goal>     record of a goal, in the stream FIB_<fleet>_GOALS
    fib.<fleet>.worker.<worker>          lease of a worker, in the stream FIB_<fleet>_WORKERS
    fib.<fleet>.want.<action>            note of a goal that waits, in the stream FIB_<fleet>_NOTES
    fib.<fleet>.left.<action>            note of a goal without a worker, in that stream as well
    fib.<fleet>.key.<limit>.<key>        slots of a key, in the stream FIB_<fleet>_KEYS
    fib.<fleet>.key.=00intake.<action>   how an action takes goals, in that stream as well
    fib.<fleet>.turn.<worker>            hint to a worker that it has a slot of a key by now
    fib.<fleet>.past.<action>.<goal>.<stamp>    goal that has ended, in FIB_<fleet>_HISTORY

A fleet has the stream of the keys only if a schedule has a `fleet_limit`, or an action was paused,
and that of the history only if a worker keeps one. A key, and an action there, is a digest.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import blake2b

from fibaction.words.goals import GoalID

_PLAIN = frozenset(b"abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")

ANY = "*"
"""The wildcard that matches one token."""
OFFER_GROUP = "workers"
"""The queue group of all workers: each offer goes to one of them."""


@lru_cache(maxsize=1000)  # several subjects of each goal have the name of its action
def token_of(name: str) -> str:
    """Return a name as a token of a subject."""
    return "".join(
        chr(byte) if byte in _PLAIN else f"={byte:02X}"
        for byte in name.encode("utf-8", "surrogatepass")
    )


def name_of(token: str) -> str:
    """Return the name that was written as a token.

    Raises:
        ValueError: It is not such a token.
    """
    first, *rest = token.split("=")
    parts = [first.encode("ascii")]
    for one in rest:
        parts += bytes.fromhex(one[:2]), one[2:].encode("ascii")
    name = b"".join(parts).decode("utf-8", "surrogatepass")
    if token_of(name) != token:
        raise ValueError(f"{token!r} is not the token of a name")
    return name


class FleetNames:
    """The subjects and streams of one fleet."""

    def __init__(self, fleet: str) -> None:
        token = token_of(fleet)
        self.fleet = fleet
        self.root = f"fib.{token}"
        self.goals = f"FIB_{token}_GOALS"
        """The stream of the records of goals."""
        self.workers = f"FIB_{token}_WORKERS"
        """The stream of the leases of workers."""
        self.notes = f"FIB_{token}_NOTES"
        """The stream of the notes, a work queue."""

        self.keys = f"FIB_{token}_KEYS"
        """The stream of the slots of keys."""
        self.history = f"FIB_{token}_HISTORY"
        """The stream of the goals of the past."""

    def offer(self, action: str) -> str:
        """Return the subject of offers to workers that can run a goal of the action now."""
        return f"{self.root}.offer.{token_of(action)}"

    def queue(self, action: str) -> str:
        """Return the subject of offers to workers that have room in their queue."""
        return f"{self.root}.queue.{token_of(action)}"

    def taken(self, worker: str) -> str:
        """Return the subject of hints to a worker that another one has taken a goal of it."""
        return f"{self.root}.taken.{token_of(worker)}"

    def reads(self, worker: str, action: str) -> str:
        """Return the subject of questions to a worker whether it can run a goal of the action."""
        return f"{self.root}.reads.{token_of(worker)}.{token_of(action)}"

    def up(self, worker: str, client: str = "", line: str = "") -> str:
        """Return the subject of one line to a worker; without a client, that of all its lines."""
        rest = f"{client}.{line}" if client else ">"
        return f"{self.root}.up.{token_of(worker)}.{rest}"

    def down(self, client: str, line: str = ANY) -> str:
        """Return the subject of one line to a client; without a line, that of all its lines."""
        return f"{self.root}.down.{client}.{line}"

    def goal(self, action: str, goal_id: GoalID | None = None) -> str:
        """Return the subject of a goal's record; without an ID, that of all goals of the action."""
        return f"{self.root}.goal.{token_of(action)}.{ANY if goal_id is None else goal_id}"

    def all_goals(self) -> str:
        """Return the subject of the records of all goals."""
        return f"{self.root}.goal.{ANY}.{ANY}"

    def worker(self, worker: str | None = None) -> str:
        """Return the subject of a worker's lease; without a name, that of all leases."""
        return f"{self.root}.worker.{ANY if worker is None else token_of(worker)}"

    def want(self, action: str) -> str:
        """Return the subject of notes of goals that wait, and may run at another worker."""
        return f"{self.root}.want.{token_of(action)}"

    def left(self, action: str) -> str:
        """Return the subject of notes of goals whose worker is gone, or has given them up."""
        return f"{self.root}.left.{token_of(action)}"

    def key(self, limit: str, key: bytes) -> str:
        """Return the subject of the slots of a key of a limit."""
        return f"{self.root}.key.{token_of(limit)}.{blake2b(key, digest_size=16).hexdigest()}"

    def intake(self, action: str) -> str:
        """Return the subject of how an action takes goals, in the stream of the slots of keys."""
        return self.key("\0intake", action.encode("utf-8", "surrogatepass"))

    def all_keys(self) -> str:
        """Return the subject of the slots of all keys."""
        return f"{self.root}.key.{ANY}.{ANY}"

    def past(self, action: str, goal_id: GoalID | None = None, stamp: int | None = None) -> str:
        """Return the subject of a goal of the past; without an ID or a stamp, that of all such
        goals of the action.
        """
        goal, when = (ANY if given is None else given for given in (goal_id, stamp))
        return f"{self.root}.past.{token_of(action)}.{goal}.{when}"

    def all_past(self) -> str:
        """Return the subject of all goals of the past."""
        return f"{self.root}.past.{ANY}.{ANY}.{ANY}"

    def turn(self, worker: str) -> str:
        """Return the subject of hints to a worker that it has a slot of a key by now."""
        return f"{self.root}.turn.{token_of(worker)}"

    def all_want(self) -> str:
        """Return the subject of all notes of goals that wait."""
        return f"{self.root}.want.{ANY}"

    def all_left(self) -> str:
        """Return the subject of all notes of goals without a worker."""
        return f"{self.root}.left.{ANY}"


def last_token(subject: str) -> str:
    """Return the last token of a subject: the ID of a goal, or the token of a worker."""
    return subject.rpartition(".")[2]


def action_of(subject: str) -> str:
    """Return the action in the subject of a goal's record."""
    return name_of(subject.split(".")[3])


def stream_of_note(subject: str) -> str:
    """Return the stream of a note's subject."""
    return f"FIB_{subject.split('.')[1]}_NOTES"
