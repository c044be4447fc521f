"""`RosbridgeTranslator` by itself: what only a session over a long time meets."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from fibaction.border.byte_budgets import ByteBudget
from fibaction.wire.frames import FrameMemory
from fibaction.wire.messages import (
    Credit,
    Ended,
    Feedback,
    FromClient,
    Hello,
    SendGoal,
    decode_from_client,
    encode,
)
from fibaction.wire.settings import WireSettings
from fibaction.words.statuses import GoalStatus
from fibaction_transports.web.rosbridge.server import pending_calls
from fibaction_transports.web.rosbridge.server.translator import RosbridgeTranslator
from tests.transports.hearing import Hearing
from tests.transports.tcp.servers import new_server
from tests.transports.web.rosbridge.robot import goal

pytestmark = pytest.mark.anyio


def sent(frames: list[bytes]) -> list[FromClient]:
    return [decode_from_client(frame) for frame in frames]


@pytest.fixture
def translator() -> RosbridgeTranslator:
    memory = FrameMemory(ByteBudget(2**20))
    made = RosbridgeTranslator("peer", {"fibonacci": new_server()}, WireSettings(), memory)
    (hello,) = sent(made.begin())
    assert isinstance(hello, Hello)
    assert made.begin() == []
    return made


async def send(translator: RosbridgeTranslator, **more: Any) -> SendGoal:
    (frame,) = sent(await translator.frames_of(json.dumps(goal(1, **more))))
    assert isinstance(frame, SendGoal)
    return frame


async def test_a_goal_gets_more_credit_when_it_has_used_it_up(
    translator: RosbridgeTranslator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pending_calls, "CREDIT", 2)
    request = await send(translator)
    assert request.credit == 2
    feedback = encode(Feedback(request.id, 1, msgspec.msgpack.encode({})))
    replies: list[FromClient] = []
    for _ in range(4):
        assert len(translator.texts_of(feedback)) == 1
        replies += sent(translator.calls.take_replies())
    assert replies == [Credit(request.id, 2)] * 2


@pytest.mark.parametrize(
    ("status", "shown"),
    [(GoalStatus.SUCCEEDED, 4), (GoalStatus.ABORTED, 6), (GoalStatus.UNKNOWN, 0)],
)
async def test_what_json_cannot_express_is_told_or_left_out(
    status: GoalStatus, shown: int, translator: RosbridgeTranslator, log: Hearing
) -> None:
    request = await send(translator)
    wrong = b"\xc1"  # not msgpack
    assert translator.texts_of(encode(Feedback(request.id, 1, wrong))) == []
    assert "is left out" in log.records[0].getMessage()
    (text,) = translator.texts_of(encode(Ended(request.id, status, wrong, "", 0)))
    answer = json.loads(text)
    assert (answer["result"], answer["status"]) == (False, shown)
    assert "not a valid payload" in answer["values"]
