from __future__ import annotations

import sys

from hypothesis import given, strategies

from fibaction.feeds.feedback_window import Members, with_member, without_member


@given(steps=strategies.lists(strategies.tuples(strategies.booleans(), strategies.integers(0, 4))))
def test_members_are_a_set_in_order_of_entry(steps: list[tuple[bool, int]]) -> None:
    members: Members[int] = ()
    model: list[int] = []
    for adds, number in steps:
        if adds and number not in model:
            members = with_member(members, number)
            model.append(number)
        elif not adds:
            members = without_member(members, number)
            model = [one for one in model if one != number]
        assert list(members) == model
        assert bool(members) is bool(model)


def test_no_member_takes_no_memory_and_one_takes_little() -> None:
    empty: Members[int] = ()
    one = with_member(empty, 1)
    assert without_member(one, 1) is empty
    assert without_member(with_member(one, 2), 2) == {1: None}
    assert sys.getsizeof(one) <= 64 < sys.getsizeof(with_member(one, 2))
