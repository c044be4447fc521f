"""`ScriptedClient`: a connection to brokers whose answers a test gives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from fibaction._runtime.notify import Notifier
from fibaction_transports.nats.broker.broker import (
    BrokerSubscription,
    Message,
    NoResponders,
    OnMessage,
)
from fibaction_transports.nats.broker.login import BrokerInfo

NO_RESPONDERS = None
"""The answer of nobody."""


def failed(number: int, code: int = 400, text: str = "no") -> dict[str, Any]:
    """An answer with an error of JetStream."""
    return {"error": {"code": code, "err_code": number, "description": text}}


class _Subscribed(BrokerSubscription):
    def close(self) -> None:
        """See `BrokerSubscription.close`."""


class ScriptedClient:
    """The part of `NatsClient` that JetStream needs; each answer is used once, but for the last."""

    url = "nats://broker"
    is_connected = True

    def __init__(self, **answers: Any) -> None:
        """Answer to each request whose subject has this part of the API in it (`_` for the dot)."""
        self.answers = {name.replace("_", "."): list(found) for name, found in answers.items()}
        self.asked: list[tuple[str, Any]] = []
        """The requests, and the messages that were published."""
        self.timeouts: list[float] = []
        """The seconds of each request."""
        self.info = BrokerInfo()
        self.connections = 1
        self.to_notify: set[Notifier] = set()
        self.on_message: OnMessage = lambda _message: None
        self.on_publish: Callable[[str], None] = lambda _subject: None

    def new_inbox(self) -> str:
        return "_INBOX.one"

    async def subscribe(
        self, subject: str, on_message: OnMessage, queue: str = ""
    ) -> BrokerSubscription:
        self.on_message = on_message
        return _Subscribed()

    def publish(self, subject: str, data: bytes, reply: str = "") -> None:
        self.asked.append((subject, data))
        self.on_publish(subject)

    async def answer(self, subject: str, data: bytes, timeout: float) -> Message:
        self.asked.append((subject, msgspec.json.decode(data) if data else None))
        self.timeouts.append(timeout)
        found = next(found for name, found in self.answers.items() if name in subject)
        answer = found.pop(0) if len(found) > 1 else found[0]
        if isinstance(answer, Exception):
            raise answer
        if answer is NO_RESPONDERS:
            raise NoResponders(subject)
        if isinstance(answer, Message):
            return answer
        return Message("", msgspec.json.encode(answer), "", {})

    def bodies(self, name: str) -> list[Any]:
        """The bodies of the requests of one part of the API."""
        return [body for subject, body in self.asked if name in subject]
