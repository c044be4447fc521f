"""`PendingAnswers`: the requests of one client that wait for an answer."""

from __future__ import annotations

import asyncio  # noqa: TID251  # each answer is a callback, which anyio has not
from collections.abc import Callable, Collection
from typing import TypeAlias

import anyio

from fibaction.border.abc import Notifier
from fibaction_transports.nats.broker.broker import BrokerAway, Message

ACK_TIMEOUT = 2.0
"""Seconds within which a broker answers to a write."""
OnAnswer: TypeAlias = Callable[[Message | None], None]
"""Takes an answer; None if there was none in time."""


class PendingAnswers:
    """The requests of one client that wait for an answer, each with a number.

    A write has a callback, and a time that all writes have in common, so that it needs no task. A
    request of a caller has a future, and the caller's own limit of time.
    """

    def __init__(self, inbox: str) -> None:
        self.inbox = inbox
        """The subject before the numbers."""
        self._last = 0
        self._acks: dict[str, tuple[float, OnAnswer]] = {}
        self._has_acks = Notifier()
        self._answers: dict[str, asyncio.Future[Message]] = {}

    def __contains__(self, number: str) -> bool:
        return number in self._acks or number in self._answers

    def subject(self, number: str) -> str:
        """Return the subject for the answer to a request."""
        return f"{self.inbox}.{number}"

    def number(self) -> str:
        """Return the number of a new request."""
        self._last += 1
        return str(self._last)

    def call_back(self, number: str, then: OnAnswer) -> None:
        """Call `then` with the answer, or with None after `ACK_TIMEOUT`."""
        self._acks[number] = asyncio.get_running_loop().time() + ACK_TIMEOUT, then
        self._has_acks.notify()

    def expect(self, number: str) -> asyncio.Future[Message]:
        """Return a future for the answer; `forget` it in the end."""
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        return answer

    def forget(self, number: str) -> None:
        """Wait for the answer to a request no longer."""
        del self._answers[number]

    def on_answer(self, message: Message) -> None:
        """Take a message to the inbox."""
        number = message.subject.rpartition(".")[2]
        ack = self._acks.pop(number, None)
        if ack is not None:
            ack[1](message)
        else:
            answer = self._answers.get(number)
            if answer is not None and not answer.done():
                answer.set_result(message)

    async def expire(self) -> None:
        """Tell each write that has no answer in time, forever."""
        loop = asyncio.get_running_loop()
        while True:
            while not self._acks:
                await self._has_acks.wait()
            number, (deadline, then) = next(iter(self._acks.items()))
            if deadline > loop.time():
                await anyio.sleep(deadline - loop.time())
            else:
                del self._acks[number]
                then(None)

    def give_up(self, unsent: Collection[str], reason: str) -> None:
        """Fail all requests but the unsent ones: their answers went to a lost connection."""
        for number in [number for number in self._acks if number not in unsent]:
            self._acks.pop(number)[1](None)
        for number, answer in self._answers.items():
            if number not in unsent and not answer.done():
                answer.set_exception(BrokerAway(reason))
