"""A number of bytes that many parts share."""

from fibaction._budget import ByteBudget


def test_a_budget_has_room_up_to_its_limit() -> None:
    budget = ByteBudget(10)

    budget.take(4)

    assert budget.has_room(6)
    assert not budget.has_room(7)


def test_bytes_that_are_given_back_can_be_taken_again() -> None:
    budget = ByteBudget(10)
    budget.take(10)

    budget.give_back(3)

    assert budget.used == 7
    assert budget.has_room(3)


def test_a_budget_counts_what_is_over_its_limit() -> None:
    budget = ByteBudget(10)

    budget.take(25)

    assert budget.used == 25
    assert not budget.has_room()
