"""`NatsClient`: a connection to brokers, which is made again when it is lost.

Theory of operation
-------------------

nats-py does the handshake, reads messages and writes them; a `Client` of it is used for one
connection only, and with one task of ours. What is around that is done here, for these reasons:

- Its methods swallow cancellation in places, so no task of a caller runs them. Callers put commands
  into a queue; the task `_write` hands them to the `Client`, many in one turn.
- Its way to connect again keeps commands of the lost connection, may wait for ever until the lost
  one is closed, and ends for good after some errors. So `_keep_connected` connects again itself,
  with a new `Client`, and subscribes to everything again.
- Its `close` waits for a broker that is frozen. Here the messages before are flushed, within a
  limit of time, and then the socket is closed at once.

Answers to all requests come to one subject, `_INBOX.<random>.<number>`, so a request needs neither
a subscription nor a task of its own.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # nats-py is for asyncio only
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import anyio
import nats.errors
from nats.aio.client import Client
from nats.nuid import NUID

from fibaction._log import clean_logger
from fibaction._notify import Notifier
from fibaction.exceptions import ServerNotFound, TransportError
from fibaction_transports.nats.broker import BrokerAway, NobodyListens, Subscription
from fibaction_transports.nats.fleet_settings import FleetSettings
from fibaction_transports.nats.nats_answers import (
    ACK_TIMEOUT,
    NOBODY,
    OnAnswer,
    OnRaw,
    PendingAnswers,
    RawMessage,
    raw_message,
)
from fibaction_transports.nats.nats_dial import PING, Dialer, cut, is_alive, tasks_of

FIRST_PAUSE, LONGEST_PAUSE = 0.05, 1.0
"""Seconds between attempts to connect."""
CLOSE_TIMEOUT = 1.0
"""Seconds that closing waits for the last messages to be taken."""
MAX_QUEUED = 2**24
"""Bytes of messages that wait for a connection; more are lost."""

logger = clean_logger("fibaction.nats")


class _Command(NamedTuple):
    """A message to send."""

    subject: str
    data: bytes
    reply: str
    headers: dict[str, str] | None
    number: str
    """The request that it is; empty if it is none."""


class _Subscribed(Subscription):
    """A subscription, on each connection anew."""

    def __init__(self, client: NatsClient, subject: str, on_message: OnRaw, queue: str) -> None:
        self.subject = subject
        self.queue = queue
        self.on_message = on_message
        self._client = client
        self.is_closed = False
        self.part: Any = None
        """The subscription of nats-py on the present connection."""

    def close(self) -> None:
        if not self.is_closed:
            self.is_closed = True
            self._client.unsubscribe(self)

    async def deliver(self, msg: Any) -> None:
        if not self.is_closed:
            self.on_message(raw_message(msg))


class NatsClient:
    """A connection to brokers, while its tasks `run`."""

    def __init__(self, settings: FleetSettings) -> None:
        self._settings = settings
        self._servers = list(settings.servers)
        self._nats: Client | None = None
        self._commands: deque[_Command | _Subscribed] = deque()
        self._queued = 0  # bytes
        self._is_written = Notifier()  # something is to be written
        self._subscribed: dict[_Subscribed, None] = {}
        self._pending = PendingAnswers(self.new_inbox())
        self._is_hurt = Notifier()  # the connection may be lost
        self._dialer = Dialer(settings, self._is_hurt.notify)
        self.info: Mapping[str, Any] = {}
        """The INFO of the broker."""
        self.connections = 0
        """The number of connections that were made."""
        self.to_notify: set[Notifier] = set()
        """Notified when the connection is lost, and when it is made again."""

    @property
    def url(self) -> str:
        """The brokers, for errors and logs."""
        return self._settings.url.rpartition("/")[0]

    @property
    def is_connected(self) -> bool:
        """True if there is a connection now."""
        return self._nats is not None

    # Messages

    def publish(
        self, subject: str, data: bytes, reply: str = "", headers: dict[str, str] | None = None
    ) -> None:
        """Send a message soon."""
        self._send(_Command(subject, data, reply, headers, ""))

    def ask(
        self, subject: str, data: bytes, headers: dict[str, str] | None, then: OnAnswer
    ) -> None:
        """Send a message, and call `then` with the answer, or with None after `ACK_TIMEOUT`."""
        number = self._pending.number()
        self._pending.call_back(number, then)
        self._send(_Command(subject, data, self._pending.subject(number), headers, number))

    async def request(self, subject: str, data: bytes, timeout: float) -> RawMessage:
        """Send a message, and return the first answer.

        Raises:
            NobodyListens: Nobody gets it.
            BrokerAway: There was no answer within `timeout` seconds.
        """
        number = self._pending.number()
        command = _Command(subject, data, self._pending.subject(number), None, number)
        message = await self._answer_to(command, timeout)
        if message.status == NOBODY:
            raise NobodyListens(f"nobody gets {subject}")
        return message

    async def flush(self, timeout: float = ACK_TIMEOUT) -> None:
        """Wait until the broker has handled everything before, by a message to this client.

        A PING would not do: nats-py writes it before what waits to be written.

        Raises:
            BrokerAway: There is no connection.
        """
        number = self._pending.number()
        command = _Command(self._pending.subject(number), b"", "", None, number)
        await self._answer_to(command, timeout)

    async def _answer_to(self, command: _Command, timeout: float) -> RawMessage:
        answer = self._pending.expect(command.number)
        self._send(command)
        try:
            with anyio.fail_after(timeout):
                return await answer
        except TimeoutError:
            raise BrokerAway(f"no answer within {timeout:g} s from {self.url}") from None
        finally:
            self._pending.forget(command.number)

    async def subscribe(self, subject: str, on_message: OnRaw, queue: str = "") -> Subscription:
        """Get the messages of a subject, from when this returns on.

        Raises:
            BrokerAway: There is no connection.
        """
        made = _Subscribed(self, subject, on_message, queue)
        self._subscribed[made] = None
        self._send(made)
        try:
            await self.flush()
        except BaseException:
            made.close()
            raise
        return made

    def unsubscribe(self, one: _Subscribed) -> None:
        """Get no more messages of a subscription."""
        self._subscribed.pop(one, None)
        self._send(one)

    def soon(self, callback: Callable[[], None]) -> None:
        """Call something in another turn of the event loop."""
        asyncio.get_running_loop().call_soon(callback)

    def new_inbox(self) -> str:
        """Return a subject for messages to this client that are not answers."""
        return f"_INBOX.{NUID().next().decode()}"

    def _send(self, command: _Command | _Subscribed) -> None:
        if isinstance(command, _Command):
            if self._queued > MAX_QUEUED and not (command.number or self.is_connected):
                return
            self._queued += len(command.data)
        self._commands.append(command)
        if len(self._commands) == 1:
            self._is_written.notify()

    # Tasks

    async def write(self) -> None:
        """Hand the commands to nats-py, for ever."""
        while True:
            client = self._nats
            if client is None or not self._commands:
                await self._is_written.wait()
                continue
            command = self._commands.popleft()
            try:
                if isinstance(command, _Subscribed):
                    await self._apply(client, command)
                    continue
                self._queued -= len(command.data)
                number = command.number
                if not number or number in self._pending:
                    await client.publish(
                        command.subject, command.data, command.reply, headers=command.headers
                    )
            except (nats.errors.Error, OSError) as exc:
                logger.debug("%s: a message was not sent: %s", self.url, exc)
                self._is_hurt.notify()
                await anyio.lowlevel.checkpoint()

    async def _apply(self, client: Any, one: _Subscribed) -> None:
        """Begin or end a subscription on the present connection."""
        if not one.is_closed and one.part is None:
            one.part = await client.subscribe(one.subject, one.queue, cb=one.deliver)
        elif one.is_closed and one.part is not None:
            part, one.part = one.part, None
            await part.unsubscribe()

    async def expire(self) -> None:
        """Tell each write that has no answer in time, for ever."""
        await self._pending.expire()

    async def keep_connected(self) -> None:
        """Connect again each time the connection is lost, for ever."""
        while True:
            with anyio.move_on_after(PING):
                await self._is_hurt.wait()
            client = self._nats
            if client is None or is_alive(client):
                continue
            self._nats = None
            logger.warning("the connection to %s is lost", self.url)
            self._give_up_answers()
            self._notify()
            await cut(client)
            await self._connect_again()
            logger.warning("the connection to %s is back", self.url)

    def _give_up_answers(self) -> None:
        """Fail all requests that were sent: their answers went to the lost connection."""
        unsent = {one.number for one in self._commands if isinstance(one, _Command)}
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
        client: Any = await self._dialer.dial(server)
        try:
            await client.subscribe(f"{self._pending.inbox}.*", cb=self._pending.on_answer)
            for one in tuple(self._subscribed):
                one.part = None
                await self._apply(client, one)
        except nats.errors.Error as exc:
            await cut(client)
            raise ServerNotFound(f"the broker {server} has closed the connection") from exc
        except BaseException:
            await cut(client)
            raise
        self._begin(client)

    def _begin(self, client: Any) -> None:
        for task in tasks_of(client):
            task.add_done_callback(self._on_done)
        self.info = client._server_info
        for url in self.info.get("connect_urls") or ():
            if url not in self._servers:
                self._servers.append(url)
        self._nats = client
        self.connections += 1
        self._notify()
        self._is_written.notify()

    def _notify(self) -> None:
        for one in tuple(self.to_notify):
            one.notify()

    def _on_done(self, task: asyncio.Task[Any]) -> None:
        """Note the end of a task of nats-py, which means that the connection is lost."""
        if not task.cancelled():
            task.exception()  # asked for, so that asyncio does not log it
        self._is_hurt.notify()

    async def close(self) -> None:
        """Send what was published, as far as the broker takes it soon, and close."""
        with anyio.CancelScope(shield=True):
            if self.is_connected:
                with suppress(BrokerAway):
                    await self.flush(CLOSE_TIMEOUT)
            client, self._nats = self._nats, None
            await cut(client)
