"""`FairQueue` of `fibaction.server.execution.turns`: keys take turns."""

from __future__ import annotations

from collections import defaultdict, deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction.server.execution.turns import FairQueue


def test_items_of_one_key_keep_their_order() -> None:
    queue: FairQueue[int] = FairQueue()
    for number in range(5):
        queue.append(number, "a")
    assert [queue.popleft() for _ in range(5)] == list(range(5))
    assert queue.count == 0


def test_a_key_with_one_item_waits_for_one_item_of_each_other_key() -> None:
    queue: FairQueue[str] = FairQueue()
    for number in range(10_000):
        queue.append(f"a{number}", "a")
    queue.append("b0", "b")
    queue.append("c0", "c")
    assert [queue.popleft() for _ in range(5)] == ["a0", "b0", "c0", "a1", "a2"]


def test_a_key_that_was_alone_and_has_no_items_left_is_passed_over_and_forgotten() -> None:
    queue: FairQueue[str] = FairQueue()
    queue.append("a0", "a")
    assert queue.popleft() == "a0"
    queue.append("b0", "b")
    queue.append("b1", "b")
    assert [queue.popleft(), queue.popleft()] == ["b0", "b1"]
    assert list(queue._items) == ["b"]


def test_an_empty_queue_has_nothing_to_give() -> None:
    queue: FairQueue[int] = FairQueue()
    with pytest.raises(IndexError):
        queue.popleft()
    queue.append(1, "a")
    queue.popleft()
    with pytest.raises(IndexError):
        queue.popleft()


@given(st.lists(st.one_of(st.none(), st.integers(0, 3))))
def test_it_gives_each_item_once_in_turns_and_keeps_no_key_without_items(
    steps: list[int | None],
) -> None:
    queue: FairQueue[int] = FairQueue()
    waiting: defaultdict[int, deque[int]] = defaultdict(deque)
    passed_over: defaultdict[int, int] = defaultdict(int)
    keys: dict[int, int] = {}
    for number, key in enumerate(steps):
        if key is not None:
            keys[number] = key
            queue.append(number, key)
            waiting[key].append(number)
        elif queue.count:
            item = queue.popleft()
            taken = keys[item]
            assert waiting[taken].popleft() == item
            passed_over[taken] = 0
            for other, items in waiting.items():
                passed_over[other] = passed_over[other] + 1 if items and other != taken else 0
                assert passed_over[other] <= 3  # as many as there are other keys
        assert queue.count == sum(map(len, waiting.values()))
        assert len(queue._items) == len(queue._turns) <= 1 + sum(map(bool, waiting.values()))
