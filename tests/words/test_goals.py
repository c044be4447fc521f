from __future__ import annotations

import pickle
import uuid

import pytest
from hypothesis import given, strategies
from pydantic import BaseModel, ValidationError

from fibaction import Action
from fibaction.words.goals import (
    CancelAnswer,
    CancelCode,
    GoalID,
    GoalInfo,
    Outcome,
    Sender,
    child_id,
    digest_of,
)
from fibaction.words.statuses import GoalStatus

GOAL_ID = GoalID(bytes(range(16)))


@given(strategies.binary(max_size=40))
def test_a_goal_id_has_16_bytes(value: bytes) -> None:
    if len(value) == 16:
        assert GoalID(value) == value
    else:
        with pytest.raises(ValueError, match=rf"a goal ID has 16 bytes, not {len(value)}$"):
            GoalID(value)


@given(strategies.binary(min_size=16, max_size=16).map(GoalID))
def test_a_goal_id_is_read_back_from_its_text(goal_id: GoalID) -> None:
    read = GoalID.parse(str(goal_id))
    assert type(read) is GoalID
    assert read == goal_id


@given(strategies.uuids())
def test_a_goal_id_is_read_from_a_uuid(value: uuid.UUID) -> None:
    assert GoalID.parse(str(value)) == value.bytes
    assert str(GoalID(value.bytes)) == value.hex


@pytest.mark.parametrize("text", ["", "00", "g" * 32, "0" * 31, "0" * 34, "é" * 32])
def test_other_text_is_no_goal_id(text: str) -> None:
    with pytest.raises(ValueError, match="a goal ID has 32 hexadecimal digits, not") as caught:
        GoalID.parse(text)
    assert repr(text) in str(caught.value)


def test_an_id_is_given_as_itself_or_as_text() -> None:
    assert GoalID.of(GOAL_ID) is GOAL_ID
    with pytest.raises(ValueError, match=r"not 'abc': goal\.goal_id is one, and client\.goals\(\)"):
        GoalID.of("abc")
    assert GoalID.of(str(GOAL_ID)) == GOAL_ID
    with pytest.raises(TypeError, match="goal_id must be a GoalID, or the text of one, not 7"):
        GoalID.of(7)


class Noted(BaseModel):
    goal_id: GoalID


def test_a_goal_id_is_a_field_of_a_pydantic_model() -> None:
    noted = Noted(goal_id=GOAL_ID)
    text = str(GOAL_ID)
    assert noted.model_dump() == {"goal_id": text}
    assert Noted.model_validate_json(noted.model_dump_json()) == noted
    read = Noted.model_validate({"goal_id": str(uuid.UUID(text))}).goal_id
    assert isinstance(read, GoalID)
    assert read == GOAL_ID
    assert Noted.model_json_schema()["properties"]["goal_id"]["type"] == "string"
    with pytest.raises(ValidationError, match="should match pattern"):
        Noted.model_validate({"goal_id": "g1"})
    action = Action("note", goal=Noted, feedback=int, result=Noted)
    assert action.result.decode(action.goal.encode(noted)) == noted


def test_the_representation_of_a_goal_id_makes_the_same_one() -> None:
    assert repr(GOAL_ID) == "GoalID.parse('000102030405060708090a0b0c0d0e0f')"
    assert eval(repr(GOAL_ID)) == GOAL_ID


def test_a_goal_id_survives_the_way_to_another_process() -> None:
    copy = pickle.loads(pickle.dumps(GOAL_ID))
    assert type(copy) is GoalID
    assert copy == GOAL_ID


@pytest.mark.parametrize(
    ("sender", "text"),
    [
        (Sender(), ""),
        (Sender(owner=b"ann"), ""),
        (Sender("ann"), "ann"),
        (Sender(address="127.0.0.1:51234"), "127.0.0.1:51234"),
        (Sender("ann", b"", "127.0.0.1:51234"), "ann at 127.0.0.1:51234"),
        (Sender("ann\x1b[2J" + "n" * 999), "ann\\x1b[2J" + "n" * 189 + "…"),
    ],
)
def test_a_sender_as_text_is_for_people(sender: Sender, text: str) -> None:
    assert str(sender) == text


def test_return_codes_have_the_numbers_of_ros() -> None:
    assert {code.name: code.value for code in CancelCode} == {
        "NONE": 0,
        "REJECTED": 1,
        "UNKNOWN_GOAL_ID": 2,
        "GOAL_TERMINATED": 3,
    }


def test_a_cancel_is_accepted_if_a_goal_is_canceling() -> None:
    canceling = GoalInfo(GOAL_ID, 1, GoalStatus.CANCELING)
    assert CancelAnswer(CancelCode.NONE, (canceling,), "another refused").accepted
    # NONE is no yes: a cancel of all that found no goal has it too.
    assert not CancelAnswer(CancelCode.NONE).accepted
    assert not CancelAnswer(CancelCode.REJECTED, reason="no").accepted


CANCELING = GoalInfo(GoalID(bytes(range(16))), 1, GoalStatus.CANCELING)
NO_GOALS = CancelAnswer(CancelCode.NONE)
NOT_NOW = CancelAnswer(CancelCode.REJECTED, reason="not now")
TOO_LATE = CancelAnswer(CancelCode.GOAL_TERMINATED)
NOT_HERE = CancelAnswer(CancelCode.UNKNOWN_GOAL_ID)
ONE = CancelAnswer(CancelCode.NONE, (CANCELING,))


@pytest.mark.parametrize(
    ("answers", "merged"),
    [
        ([], NO_GOALS),
        ([NOT_HERE, NOT_HERE], NOT_HERE),
        ([NOT_HERE, NO_GOALS], NO_GOALS),
        ([NOT_HERE, TOO_LATE, NO_GOALS], TOO_LATE),
        ([TOO_LATE, NOT_NOW, NOT_NOW, NO_GOALS], NOT_NOW),
        ([ONE, NOT_NOW], CancelAnswer(CancelCode.NONE, (CANCELING,), "not now")),
        ([ONE, NOT_HERE, ONE], CancelAnswer(CancelCode.NONE, (CANCELING, CANCELING))),
    ],
)
def test_the_answers_of_several_servers_to_one_cancel_are_merged(
    answers: list[CancelAnswer], merged: CancelAnswer
) -> None:
    assert CancelAnswer.merged(answers) == merged


def test_a_digest_is_the_same_in_every_process_and_has_sixteen_bytes() -> None:
    # By `printf goal | b2sum -l 128`.
    assert digest_of(b"goal").hex() == "c3d1adee19a9bf84e992ef006f4b2153"
    assert digest_of(b"goal") != digest_of(b"goa")


def test_the_id_of_a_child_follows_from_its_parent_its_action_and_its_step() -> None:
    child = child_id(GOAL_ID, "pick", "cup")
    name = "pick" + chr(10) + "cup"
    assert child == GoalID(uuid.uuid5(uuid.UUID(bytes=bytes(GOAL_ID)), name).bytes)
    others = child_id(child, "pick", "cup"), child_id(GOAL_ID, "pickc", "up")
    assert child not in others


@pytest.mark.parametrize(("reason", "begin"), [("", ""), ("stuck", "stuck; ")])
def test_an_outcome_whose_result_cannot_be_read_says_so(reason: str, begin: str) -> None:
    def decode(result: bytes) -> None:
        raise ValueError("it is cut")

    outcome = Outcome(GoalStatus.ABORTED, b"?", reason, ended_at=5)
    told = f"{begin}its result cannot be read: it is cut"
    assert outcome.readable(decode) == Outcome(GoalStatus.ABORTED, None, told, 5)
    with pytest.raises(ValueError, match="it is cut"):
        outcome.decoded(decode)


def test_an_outcome_is_decoded_if_it_has_a_result() -> None:
    ended = Outcome(GoalStatus.SUCCEEDED, b"3", ended_at=5)
    assert ended.decoded(int) == Outcome(GoalStatus.SUCCEEDED, 3, ended_at=5)
    none = Outcome[bytes](GoalStatus.ABORTED, reason="stuck")
    assert none.readable(int) == none
    assert (ended.size, none.size) == (1, 5)
    assert none.members == {"status": "ABORTED", "result": None, "reason": "stuck"}


@pytest.mark.parametrize(
    ("began_at", "ended_at", "spans"),
    [
        (None, None, (None, None)),
        (1_500_000_000, None, (0.5, None)),
        (None, 4_000_000_000, (None, None)),
        (1_500_000_000, 4_000_000_000, (0.5, 2.5)),
        (500_000_000, 400_000_000, (0, 0)),  # the clock was set back twice
    ],
)
def test_a_goal_has_waited_until_its_begin_and_has_run_until_its_end(
    began_at: int | None, ended_at: int | None, spans: tuple[float | None, float | None]
) -> None:
    info = GoalInfo(
        *(GoalID(bytes(range(16))), 10**9, GoalStatus.ABORTED),
        began_at=began_at,
        ended_at=ended_at,
    )
    assert (info.waited, info.ran) == spans


def test_the_info_of_a_goal_with_labels_and_a_result_can_be_in_a_set() -> None:
    goal_id = GoalID.random()
    info = GoalInfo(goal_id, 1, GoalStatus.SUCCEEDED, labels={"order": "17"}, result={"a": 1})
    same = GoalInfo(goal_id, 1, GoalStatus.SUCCEEDED, labels={"order": "17"}, result={"a": 1})
    other = GoalInfo(goal_id, 1, GoalStatus.SUCCEEDED)
    assert {info, same, other} == {info, other}
