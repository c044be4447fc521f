"""`NatsClient`: a connection to brokers, which is made again when it is lost.

Theory of operation
-------------------

`Dialer` makes each connection, with the login. nats-py is not used, for these reasons:

- Its methods swallow cancellation in places, and need tasks and futures for each message. Here
  callers put commands into a queue, and `_write` joins those of one turn of the event loop.
- Its way to connect again keeps commands of the lost connection, may wait forever until the lost
  one is closed, and ends for good after some errors. Here `keep_connected` connects again, and
  subscribes to everything again.
- Its `close` waits for a broker that is frozen. Here the messages before have a limited time.

All answers come to one subject, `_INBOX.<random>.<number>`: a request needs no subscription.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # callbacks of its loop, which anyio has not
import itertools
import math
import secrets
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import anyio

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.wire.channel import CHUNK
from fibaction.words.errors import TransportError
from fibaction_transports.nats.broker.answers import ACK_TIMEOUT, OnAnswer, PendingAnswers
from fibaction_transports.nats.broker.broker import (
    NO_RESPONDERS,
    BrokerAway,
    BrokerSubscription,
    Message,
    NoResponders,
    OnMessage,
)
from fibaction_transports.nats.broker.broker_socket import BrokerSocket, published
from fibaction_transports.nats.broker.dial import Dialer
from fibaction_transports.nats.broker.login import BrokerInfo
from fibaction_transports.nats.settings import FleetSettings

PING = 2.0
"""Seconds between pings."""
FIRST_PAUSE, LONGEST_PAUSE = 0.05, 1.0
"""Seconds between attempts to connect."""
CLOSE_TIMEOUT = 1.0
"""Seconds that closing waits for the last messages to be taken."""
MAX_QUEUED = 2**24
"""Bytes of messages that wait for a connection; more are lost."""
ANSWERS = 1
"""The number of the subscription to the answers of all requests."""

logger = clean_logger("fibaction.nats")


class _Outgoing(NamedTuple):
    """A message to send."""

    subject: str
    data: bytes
    reply: str
    headers: dict[str, str] | None
    number: str
    """The request that it is; empty if it is none."""


class _Subscribed(BrokerSubscription):
    """A subscription, renewed on each connection."""

    def __init__(self, client: NatsClient, number: int, subject: str, queue: str) -> None:
        self.number = number
        self.is_closed = False
        self.is_sent = False
        """True if the present connection has it."""
        self._client = client
        self._subject = subject
        self._queue = queue

    def close(self) -> None:
        if not self.is_closed:
            self.is_closed = True
            self._client.unsubscribe(self)

    def command(self) -> bytes:
        """Return the bytes that begin or end it on the present connection, if need be."""
        if self.is_closed is not self.is_sent:
            return b""
        self.is_sent = not self.is_closed
        if self.is_closed:
            return f"UNSUB {self.number}\r\n".encode()
        return f"SUB {self._subject} {self._queue} {self.number}\r\n".encode()


class NatsClient:
    """A connection to brokers, while its tasks `run`."""

    def __init__(self, settings: FleetSettings) -> None:
        self._settings = settings
        self._servers = list(settings.servers)
        self._socket: BrokerSocket | None = None
        self._commands: deque[_Outgoing | _Subscribed] = deque()
        self._queued = 0  # bytes
        self._is_due = False
        self._pending = PendingAnswers(self.new_inbox())
        self._numbers = itertools.count(ANSWERS)
        self._subscribed: dict[int, _Subscribed] = {}
        self._receivers: dict[int, OnMessage] = {}
        self._add_subscription(f"{self._pending.inbox}.*", self._pending.on_answer, "")
        self._changed = Notifier()  # the connection may be lost
        self._dialer = Dialer(settings, self._deliver, self._on_change)
        self.info = BrokerInfo()
        """The INFO of the broker."""
        self.connections = 0
        """The number of connections that were made."""
        self.reconnected_at = -math.inf
        self.to_notify: set[Notifier] = set()
        """Notified when the connection is lost, and when it is made again."""

    @property
    def url(self) -> str:
        """The brokers, for errors and logs."""
        return self._settings.url.rpartition("/")[0]

    @property
    def is_connected(self) -> bool:
        """True if there is a connection now."""
        return self._socket is not None

    # Messages

    def publish(
        self, subject: str, data: bytes, reply: str = "", headers: dict[str, str] | None = None
    ) -> None:
        """Send a message soon."""
        self._send(_Outgoing(subject, data, reply, headers, ""))

    def ask(
        self, subject: str, data: bytes, headers: dict[str, str] | None, then: OnAnswer
    ) -> None:
        """Send a message, and call `then` with the answer, or with None after `ACK_TIMEOUT`."""
        number = self._pending.number()
        self._pending.call_back(number, then)
        self._send(_Outgoing(subject, data, self._pending.subject(number), headers, number))

    async def answer(self, subject: str, data: bytes, timeout: float) -> Message:
        """Send a message, and return the first answer.

        Raises:
            NoResponders: The subject has no subscriber.
            BrokerAway: There was no answer within `timeout` seconds.
        """
        number = self._pending.number()
        command = _Outgoing(subject, data, self._pending.subject(number), None, number)
        message = await self._answer_to(command, timeout)
        if message.status == NO_RESPONDERS:
            raise NoResponders(f"{subject} has no subscriber")
        return message

    async def flush(self, timeout: float = ACK_TIMEOUT) -> None:
        """Wait until the broker has handled everything before, by a message to this client.

        Raises:
            BrokerAway: There is no connection.
        """
        number = self._pending.number()
        command = _Outgoing(self._pending.subject(number), b"", "", None, number)
        await self._answer_to(command, timeout)

    async def _answer_to(self, command: _Outgoing, timeout: float) -> Message:
        answer = self._pending.expect(command.number)
        self._send(command)
        try:
            with anyio.fail_after(timeout):
                return await answer
        except TimeoutError:
            raise BrokerAway(f"no answer within {timeout:g} s from {self.url}") from None
        finally:
            self._pending.forget(command.number)

    async def subscribe(
        self, subject: str, on_message: OnMessage, queue: str = ""
    ) -> BrokerSubscription:
        """Get the messages of a subject, from when this returns on.

        Raises:
            BrokerAway: There is no connection.
        """
        made = self._add_subscription(subject, on_message, queue)
        self._send(made)
        try:
            await self.flush()
        except BaseException:
            made.close()
            raise
        return made

    def _add_subscription(self, subject: str, on_message: OnMessage, queue: str) -> _Subscribed:
        number = next(self._numbers)
        made = self._subscribed[number] = _Subscribed(self, number, subject, queue)
        self._receivers[number] = on_message
        return made

    def unsubscribe(self, one: _Subscribed) -> None:
        """Get no more messages of a subscription."""
        del self._subscribed[one.number], self._receivers[one.number]
        self._send(one)

    def _deliver(self, number: int, message: Message) -> None:
        receiver = self._receivers.get(number)
        if receiver is not None:
            receiver(message)

    def soon(self, callback: Callable[[], None]) -> None:
        """Call something in another turn of the event loop."""
        asyncio.get_running_loop().call_soon(callback)

    def new_inbox(self) -> str:
        """Return a subject for messages to this client that are not answers."""
        return f"_INBOX.{secrets.token_hex(11)}"

    def _send(self, command: _Outgoing | _Subscribed) -> None:
        if isinstance(command, _Outgoing):
            if self._queued > MAX_QUEUED and not (command.number or self.is_connected):
                return
            self._queued += len(command.data)
        self._commands.append(command)
        if not self._is_due:
            self._is_due = True
            asyncio.get_running_loop().call_soon(self._write)

    def _write(self) -> None:
        """Send the commands, as far as the connection takes them."""
        self._is_due = False
        commands, socket = self._commands, self._socket
        while commands and socket is not None and socket.is_ready:
            parts: list[bytes] = []
            size = 0
            while commands and size < CHUNK:
                command = commands.popleft()
                if isinstance(command, _Subscribed):
                    parts.append(command.command())
                    continue
                subject, data, reply, headers, number = command
                size += len(data)
                if len(data) > socket.info.max_payload:
                    logger.debug("%s: a message to %s is too large", self.url, subject)
                elif not number or number in self._pending:
                    parts += published(subject, data, reply, headers)
            self._queued -= size
            socket.write(b"".join(parts))

    # Tasks

    async def expire(self) -> None:
        """Tell each write that has no answer in time, forever."""
        await self._pending.expire()

    async def keep_connected(self) -> None:
        """Connect again each time the connection is lost, forever."""
        while True:
            socket = self._socket
            if socket is None or not socket.is_lost:
                with anyio.move_on_after(PING) as pause:
                    await self._changed.wait()
                if pause.cancelled_caught and socket is not None:
                    socket.ping()
                continue
            self._socket = None
            logger.warning("the connection to %s is lost", self.url)
            self._give_up_answers()
            self._notify()
            await socket.cut()
            await self._connect_again()
            self.reconnected_at = anyio.current_time()
            logger.warning("the connection to %s is back", self.url)

    def _give_up_answers(self) -> None:
        """Fail all requests that were sent: their answers went to the lost connection."""
        unsent = {one.number for one in self._commands if isinstance(one, _Outgoing)}
        self._pending.give_up(unsent, f"the connection to {self.url} was lost")

    async def _connect_again(self) -> None:
        pause = FIRST_PAUSE
        while True:
            for server in tuple(self._servers):
                try:
                    await self._connect_to(server)
                except TransportError as exc:
                    logger.debug("%s: %s", server, exc)
                else:
                    return
            await anyio.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE)

    # Connecting

    async def connect(self) -> None:
        """Connect for the first time, to the first broker that answers.

        Raises:
            ServerNotFound: None of them answers.
            AuthenticationFailed: One of them does not let this client in.
            TransportError: The files of the settings cannot be used.
        """
        self._dialer.read_files()
        failure: TransportError | None = None
        for server in self._settings.servers:
            try:
                return await self._connect_to(server)
            except TransportError as exc:
                failure = failure or exc
        assert failure is not None
        raise failure

    async def _connect_to(self, server: str) -> None:
        self._socket = socket = await self._dialer.dial(server)
        for one in self._subscribed.values():
            one.is_sent = False
        socket.write(b"".join(one.command() for one in self._subscribed.values()))
        self.info = socket.info
        self._servers += [one for one in self.info.connect_urls if one not in self._servers]
        self.connections += 1
        self._notify()
        self._write()

    def _notify(self) -> None:
        for one in tuple(self.to_notify):
            one.notify()

    def _on_change(self) -> None:
        """Note that there is room to write again, or that the connection is lost."""
        self._changed.notify()
        self._write()

    async def close(self) -> None:
        """Send what was published, as far as the broker takes it soon, and close."""
        with anyio.CancelScope(shield=True):
            if self.is_connected:
                with suppress(BrokerAway):
                    await self.flush(CLOSE_TIMEOUT)
            socket, self._socket = self._socket, None
            if socket is not None:
                await socket.cut()
