from __future__ import annotations

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
