"""The code of a rejection decides what is done, and the reason never does.

`test_doors` shows that each door tells the code.
"""

from __future__ import annotations

import re
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any, cast

import pytest

from fibaction import (
    ActionServer,
    GoalHandle,
    GoalRejected,
    RejectionCode,
    Retry,
    connect,
    serve,
)
from fibaction_transports._http.problems import problem_of
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import COUNT, FakeFleet, client_of

pytestmark = pytest.mark.anyio

THRICE = Retry(attempts=3, delay=0)
TABLE = Path(__file__).parents[1] / "docs" / "concepts.md"
CASES = [
    pytest.param("busybox is missing", RejectionCode.REJECTED, id="a text that begins with busy"),
    pytest.param("busy: it is not", RejectionCode.INVALID, id="the text of a busy server"),
    pytest.param("the battery is charging", RejectionCode.BUSY, id="busy"),
    pytest.param("it goes to bed", RejectionCode.STOPPING, id="stopping"),
]
each_case = pytest.mark.parametrize(("reason", "code"), CASES)


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


class Deciding:
    """An `on_goal` that rejects each goal in one way."""

    def __init__(self, reason: str, code: RejectionCode) -> None:
        self._reason, self._code = reason, code
        self.decided = 0
        """The number of decisions."""

    def __call__(self, goal: int) -> None:
        self.decided += 1
        raise GoalRejected(self._reason, code=self._code)

    @property
    def server(self) -> ActionServer[int, int, str]:
        return ActionServer(COUNT, never, on_goal=self)


async def never(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    raise AssertionError("no goal is accepted")
    yield ""


# Clients that try again


@each_case
async def test_only_a_temporary_rejection_is_retried(reason: str, code: RejectionCode) -> None:
    deciding = Deciding(reason, code)
    async with serve(deciding.server, "tcp://127.0.0.1:0") as (url,), connect(url, COUNT) as client:
        with pytest.raises(GoalRejected) as caught:
            await client.call(3, retry=THRICE)
    assert (caught.value.reason, caught.value.code) == (reason, code)
    assert deciding.decided == (3 if code.is_temporary else 1)


@each_case
@in_virtual_time()
async def test_only_a_temporary_rejection_of_a_worker_sends_the_goal_to_another(
    reason: str, code: RejectionCode
) -> None:
    fleet, deciding = FakeFleet(), Deciding(reason, code)
    async with (
        fleet.worker("a").serve(deciding.server),
        fleet.worker("b").serve(deciding.server),
        fleet.connect() as connection,
    ):
        with pytest.raises(GoalRejected) as caught:
            await client_of(connection).call(3)
    assert (caught.value.reason, caught.value.code) == (reason, code)
    assert (deciding.decided > 1) is code.is_temporary


# The table


def test_the_page_says_what_is_done_for_each_code() -> None:
    page = TABLE.read_text(encoding="utf-8")
    section = page.partition("\n### Rejections\n")[2].partition("\n### ")[0]
    rows = re.findall(
        r"^\| (\d) \| `(\w+)` \| [^|]+ \| (\w+) \| (\w+) \| (\d+) \|$", section, re.MULTILINE
    )
    words = ("no", "yes")
    assert rows == [
        (
            str(int(code)),
            code.name,
            words[code.is_temporary],
            words[code.is_temporary or code is RejectionCode.UNREADABLE],
            str(problem_of(GoalRejected("", code=code)).status),
        )
        for code in RejectionCode
    ]


def test_the_code_of_a_newer_peer_is_that_of_a_decision() -> None:
    assert RejectionCode(1000) is RejectionCode.REJECTED
    with pytest.raises(ValueError, match="BUSY"):
        GoalRejected("", code=cast("Any", "BUSY"))
