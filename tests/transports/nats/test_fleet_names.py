"""Names as tokens of subjects."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction.words.goals import GoalID
from fibaction_transports.nats.names import (
    FleetNames,
    action_of,
    last_token,
    name_of,
    stream_of_note,
    token_of,
)

ANY_NAME = st.text(st.characters())  # with surrogates, as in arguments that are not valid text
TOKEN = re.compile(r"[A-Za-z0-9_=-]*")


@given(ANY_NAME)
def test_any_name_is_one_token_and_is_read_back(name: str) -> None:
    token = token_of(name)
    assert TOKEN.fullmatch(token)
    assert name_of(token) == name


@given(ANY_NAME, ANY_NAME)
def test_two_names_are_two_tokens(one: str, other: str) -> None:
    assert (token_of(one) == token_of(other)) == (one == other)


@pytest.mark.parametrize("token", ["=", "=4", "=ZZ", "=FF", "ü"])
def test_what_is_not_such_a_token_is_an_error(token: str) -> None:
    with pytest.raises(ValueError):
        name_of(token)


@given(ANY_NAME.filter(bool), ANY_NAME.filter(bool))
def test_what_subjects_name_can_be_read_from_them(fleet: str, action: str) -> None:
    names, goal_id = FleetNames(fleet), GoalID.random()
    subject = names.goal(action, goal_id)
    assert action_of(subject) == action
    assert last_token(subject) == str(goal_id)
    assert last_token(names.worker(action)) == token_of(action)
    assert {stream_of_note(names.want(action)), stream_of_note(names.left(action))} == {names.notes}
