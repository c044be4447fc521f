"""A client of one service of ROS: questions that wait for their answers.

DDS drops what a full queue cannot take, and tells nobody: so only a few questions are asked at a
time, and one that has no answer after a while is asked again.
"""

from __future__ import annotations

from typing import Any

import anyio

from fibaction._notify import Notifier
from fibaction.exceptions import ConnectionLost
from fibaction_transports.ros2.intake import Responses, Source

AT_ONCE = 8
"""How many questions may be without an answer: the queues of rclpy and rclcpp have 10 places."""
FIRST_PATIENCE, LONGEST_PATIENCE = 1.0, 30.0
"""Seconds until a question is asked again, for the first time and at most; each time it is twice
as long, because a server may just be slow to decide."""


class Question:
    """Something that is asked, once or several times, and the answer that came last."""

    def __init__(self, asker: Asker, request: Any) -> None:
        self.tries = 0
        self.response: Any = None
        self._asker = asker
        self._request = request
        self._numbers: list[int] = []
        self._news = Notifier()
        self._patience = FIRST_PATIENCE
        self._error: ConnectionLost | None = None

    def __enter__(self) -> Question:
        self._asker.questions.add(self)
        return self

    def __exit__(self, *_: object) -> None:
        self._asker.questions.discard(self)
        for number in self._numbers:
            self._asker.forget(number)

    async def ask(self) -> bool:
        """Ask, for the first time or again, and say whether there is an answer in good time.

        Raises:
            ConnectionLost: There will be none.
        """
        if self.tries:
            return await self._try()
        async with self._asker.turns:
            return await self._try()

    async def _try(self) -> bool:
        self._raise_error()
        self.tries += 1
        self._numbers.append(self._asker.send(self._request, self))
        patience, self._patience = self._patience, min(2 * self._patience, LONGEST_PATIENCE)
        return await self.wait(patience)

    async def wait(self, seconds: float) -> bool:
        """Wait for an answer without asking again; say whether there is one."""
        with anyio.move_on_after(seconds):
            while self.response is None:
                self._raise_error()
                await self._news.wait()
        return self.response is not None

    def answer(self, response: Any) -> None:
        """That is the answer, or another one if it was asked several times."""
        self.response = response
        self._news.notify()

    def fail(self, error: ConnectionLost) -> None:
        """There will be no answer."""
        self._error = error
        self._news.notify()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise ConnectionLost(str(self._error))


class Asker:
    """Asks one service."""

    def __init__(self, handle: Any, service_type: Any) -> None:
        self.handle = handle
        self.source: Source = Responses(handle, service_type, self._take)
        """Where the answers arrive."""
        self.turns = anyio.Semaphore(AT_ONCE, fast_acquire=True)
        """Who has one may be without an answer."""
        self.questions: set[Question] = set()
        """Those that are under way, or wait for their turn."""
        self._open: dict[int, Question] = {}

    async def ask(self, request: Any) -> Any:
        """Ask until there is an answer.

        Raises:
            ConnectionLost: There will be none.
        """
        with Question(self, request) as question:
            while not await question.ask():
                pass
            return question.response

    def send(self, request: Any, question: Question) -> int:
        """Send a request, and give its number.

        Raises:
            ConnectionLost: ROS cannot send any more.
        """
        number = sent(self.handle, request)
        self._open[number] = question
        return number

    def forget(self, number: int) -> None:
        """Nobody waits for that answer any more."""
        self._open.pop(number, None)

    def fail(self, error: ConnectionLost) -> None:
        """No answer will come any more, to none of the questions."""
        for question in self.questions:
            question.fail(error)

    def _take(self, item: Any) -> None:
        number, response = item
        question = self._open.get(number)
        if question is not None:
            question.answer(response)


def sent(handle: Any, request: Any) -> int:
    """Send a request by a raw client, and give its number.

    Raises:
        ConnectionLost: ROS cannot send any more.
    """
    try:
        number: int = handle.send_request(request)
    except Exception as exc:  # rclpy raises whatever rcl says
        raise ConnectionLost(f"ROS cannot send any more: {exc}") from exc
    return number
