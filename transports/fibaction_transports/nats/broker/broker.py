"""`Broker`: the interface of a connection to brokers, as far as a fleet uses them.

Everything else in this package is written against it. `NatsBroker` is the real one; the simulation
has another, on virtual time. There are four kinds of things:

- Messages, which are not stored: `publish`, `subscribe`, `request`.
- Records, of which the newest of each subject is stored. Each `put` names the sequence of the one
  that it replaces, and is refused if there is another by now. Sequences of a stream only grow. A
  record can have a time to live, which the broker judges; its end leaves a marker, which is a
  record without data.
- Records of the past, which are stored once, and whose oldest ones the broker removes. Each has a
  head, which can be read without the rest.
- Notes, a queue from which each note is taken by one reader.

No exception of a library crosses this interface.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from enum import Enum
from typing import NamedTuple, TypeAlias

from fibaction.border.abc import Notifier
from fibaction.words.goal_query import GoalHistory
from fibaction_transports.nats.names import FleetNames

NO_RESPONDERS = "503"
"""The status of the broker's answer to a message whose subject has no subscriber."""
NO_HEADERS: Mapping[str, str] = {}
"""The headers of most messages."""


class Message(NamedTuple):
    """A message that is not stored."""

    subject: str
    data: bytes
    reply: str
    """The subject for an answer; empty if none is expected."""
    headers: Mapping[str, str] = NO_HEADERS

    @property
    def status(self) -> str:
        """The status that the broker gives by itself, for example 503; mostly empty."""
        return self.headers.get("Status", "")

    @property
    def has_no_responders(self) -> bool:
        """True if it is the broker's answer to a message whose subject has no subscriber."""
        return self.headers.get("Status") == NO_RESPONDERS


class BrokerRecord(NamedTuple):
    """The newest record of a subject."""

    subject: str
    data: bytes
    """Empty if it is a marker: the record before was deleted, or its time to live is over."""
    sequence: int


class BrokerStream(NamedTuple):
    """A stream that is there."""

    identity: str
    """The text that tells it from a stream of the same name which is made later."""
    age: float
    """Seconds since it was made, by the clock of the brokers."""


class PutFailure(Enum):
    """The reason why a record was not stored for certain."""

    REFUSED = "refused"
    """There is another record by now than the expected one."""
    UNKNOWN = "unknown"
    """The broker has not answered: the record may be stored, or not."""
    TOO_LARGE = "too large"
    """The broker does not take records of this size. Nothing was stored."""
    FULL = "full"
    """The stream is full, or the broker has another fault. Nothing was stored."""


class PutError(NamedTuple):
    """A failed `put`."""

    kind: PutFailure
    text: str


Stored: TypeAlias = Callable[[int | PutError], None]
"""Takes the sequence of a stored record, or the error."""
OnMessage: TypeAlias = Callable[[Message], None]
"""Takes a message; it must not wait, and must not raise."""


class NoResponders(Exception):
    """An error for a request whose subject has no subscriber."""


class BrokerAway(Exception):
    """The broker did not answer in time; the text says what was asked."""


class BrokerSubscription(ABC):
    """A subscription to messages, until it is closed."""

    @abstractmethod
    def close(self) -> None:
        """Get no more messages. Closing twice is harmless."""


class BrokerWatch(ABC):
    """The records of some subjects, and then each change."""

    @abstractmethod
    async def next(self) -> list[BrokerRecord] | None:
        """Return the next records, in the order of their sequences; None once, when all records
        that were there at first have been returned.

        It never ends by itself. If changes were missed, it begins again: all records come again,
        and None again after them. Records that were forgotten meanwhile do not come.
        """


class Note(NamedTuple):
    """A note that was taken from the queue."""

    data: bytes
    done: Callable[[], None]
    """Removes the note. One that is not removed within some seconds comes again."""


class Broker(ABC):
    """A connection to the brokers of a fleet."""

    max_record: int
    """The bytes of the largest record or message that the broker takes."""
    brokers: int
    """The number of brokers that keep records together, as far as it is known."""
    reconnected_at: float = -math.inf
    """The time at which a lost connection was made again last; `-math.inf` if none was."""

    @property
    @abstractmethod
    def is_connected(self) -> bool:
        """True if there is a connection to a broker now. It is made again by itself."""

    # Messages

    @abstractmethod
    def publish(self, subject: str, data: bytes, reply: str = "") -> None:
        """Send a message soon, in the order of the calls.

        If `reply` is given and the subject has no subscriber, a message with `has_no_responders`
        comes to `reply`. Without a connection, it is sent on the next, or is lost.
        """

    @abstractmethod
    async def subscribe(
        self, subject: str, on_message: OnMessage, queue: str = ""
    ) -> BrokerSubscription:
        """Get the messages of a subject, from when this returns on; with a queue, each goes to one
        member of the queue only.

        Raises:
            BrokerAway: There is no connection.
        """

    @abstractmethod
    async def request(self, subject: str, data: bytes, timeout: float) -> bytes:
        """Send a message, and return the first answer.

        Raises:
            NoResponders: The subject has no subscriber.
            BrokerAway: There was no answer within `timeout` seconds.
        """

    @abstractmethod
    async def flush(self) -> None:
        """Wait until the broker has everything that was published.

        Raises:
            BrokerAway: There is no connection.
        """

    # Records

    @abstractmethod
    async def create_streams(
        self,
        names: FleetNames,
        *,
        replicas: int = 0,
        has_keys: bool = False,
        history: GoalHistory | None = None,
    ) -> None:
        """Make the streams of a fleet, or check those that are there.

        Clients make none: a stream that is missing is like an empty one. `replicas` is the number
        of brokers that keep each record; 0 leaves it to the broker, or as it is. With `has_keys`,
        the fleet has the stream of the slots of keys; with `history`, it has that of the history,
        with these bounds, which are set if it is there already.

        Raises:
            TransportError: A stream of this name is of something else, or cannot be made.
        """

    @abstractmethod
    async def find_stream(self, stream: str) -> BrokerStream | None:
        """Return a stream; None if it is missing.

        Raises:
            BrokerAway: The broker does not answer.
        """

    @abstractmethod
    def put(
        self,
        subject: str,
        data: bytes,
        *,
        expected: int,
        ttl: float | None = None,
        head: bytes = b"",
        then: Stored,
    ) -> None:
        """Store a record in place of the one with the sequence `expected`; 0 if there is none.

        `ttl` is its time to live in seconds, rounded up to whole ones. A record of the past has a
        head. `then` is called once, on the event loop. Without data, it stores a marker, which
        deletes the record.
        """

    async def put_and_wait(
        self, subject: str, data: bytes, *, expected: int, ttl: float | None = None
    ) -> int | PutError:
        """Store a record as `put` does, and return the answer."""
        answers: list[int | PutError] = []
        news = Notifier()

        def answered(answer: int | PutError) -> None:
            answers.append(answer)
            news.notify()

        self.put(subject, data, expected=expected, ttl=ttl, then=answered)
        while not answers:
            await news.wait()
        return answers[0]

    @abstractmethod
    async def get(self, stream: str, subject: str) -> BrokerRecord | None:
        """Return the newest record of a subject, which may be a marker; None if there is none.

        Raises:
            BrokerAway: The broker does not answer.
        """

    @abstractmethod
    def watch(
        self, stream: str, subject: str, *, heads_since: int | None = None
    ) -> AbstractAsyncContextManager[BrokerWatch]:
        """Watch the records of a subject, which may have wildcards, while the block lasts.

        With `heads_since`, the records have their heads in place of their data, and only those come
        that were stored at that time or later, in nanoseconds since 1970.

        Raises:
            BrokerAway: The broker does not answer.
        """

    async def is_new(self, stream: str, lease: float) -> bool:
        """Return whether a stream is missing, or so new that a record may be missing in it: workers
        have the time of one lease to write theirs again after the loss of a stream.

        Raises:
            BrokerAway: The broker does not answer.
        """
        found = await self.find_stream(stream)
        return found is None or found.age < lease

    # Notes

    @abstractmethod
    def add_note(self, subject: str, data: bytes) -> None:
        """Add a note to the queue; it is tried again until the broker has it."""

    @abstractmethod
    def notes(self, subject: str) -> AsyncGenerator[Note, None]:
        """Take notes of a subject, one after the other, in the order in which they were added.

        The next one is asked for when the iterator is asked, and not before: who has no room asks
        for none. It waits as long as need be, also for the broker. The caller closes it.
        """
