"""A number of bytes that many parts share."""

from fibaction.border.byte_budgets import ByteBudget, CountedBytes


def test_a_budget_has_room_up_to_its_limit() -> None:
    budget = ByteBudget(10)

    budget.take(4)

    assert budget.has_room(6)
    assert not budget.has_room(7)


def test_bytes_count_as_long_as_anything_references_them() -> None:
    budget = ByteBudget(10)
    counted = CountedBytes(budget, 4)
    other = counted

    del counted
    assert budget.used == other.size == 4

    del other
    assert budget.used == 0


def test_bytes_that_become_others_count_anew() -> None:
    budget = ByteBudget(10)
    counted = CountedBytes(budget, 4)

    counted.resize(7)
    assert budget.used == counted.size == 7

    del counted
    assert budget.used == 0
