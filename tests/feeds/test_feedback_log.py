from __future__ import annotations

import gc
import math
import weakref
from collections.abc import Awaitable, Callable, Sequence
from time import process_time

import anyio
import pytest
from hypothesis import example, given, strategies

from fibaction.border.abc import FeedbackItem, GoalStream, GoalUpdate
from fibaction.border.byte_budgets import ByteBudget, CountedBytes
from fibaction.feeds.feedback_log import KEPT_MESSAGE, FeedbackCursor, FeedbackLog
from fibaction.feeds.feedback_window import HELD_SHARE, LONGEST_HOLD
from fibaction.feeds.followed_goal import GoalFacts
from fibaction.words.errors import ConnectionLost, GoalKept, UnknownGoal
from fibaction.words.goals import GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus
from tests.support.virtual_time import in_virtual_time

GOAL_ID = GoalID(bytes(range(16)))
OUTCOME = Outcome(GoalStatus.SUCCEEDED, b"done")


def new_log(window: int = 1000, *, latest: bool = False) -> FeedbackLog[GoalFacts]:
    return FeedbackLog(GoalFacts(GOAL_ID, 7), window=window, latest=latest)


def append(log: FeedbackLog[GoalFacts], count: int) -> None:
    """Add feedback, each of which is its own number as text."""
    for _ in range(count):
        is_full = log.append(b"%d" % (log.count + 1))
        assert is_full == log.is_full


def change(log: FeedbackLog[GoalFacts], status: GoalStatus) -> None:
    log.goal.told_status = status
    log.tell_status()


def end(log: FeedbackLog[GoalFacts]) -> None:
    log.goal.outcome = OUTCOME
    change(log, GoalStatus.SUCCEEDED)
    log.finish()


async def numbers(stream: FeedbackCursor) -> list[int]:
    """The numbers of all feedback up to the end of the stream."""
    seen: list[int] = []
    while (item := await stream.receive()) is not None:
        assert item.payload == b"%d" % item.number
        seen.append(item.number)
    return seen


async def while_waiting(waiting: Callable[[], Awaitable[object]], then: Callable[[], None]) -> None:
    """See that something waits, do something about it, and see that it waits no longer."""
    done = anyio.Event()

    async def wait() -> None:
        await waiting()
        done.set()

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            await anyio.wait_all_tasks_blocked()
            assert not done.is_set()
            then()


def test_a_stream_knows_its_goal_as_an_entry_of_a_list() -> None:
    log = new_log()
    stream = log.follow()
    append(log, 2)
    assert stream.info == GoalInfo(GOAL_ID, 7, GoalStatus.ACCEPTED, 2)
    told = GoalInfo(GOAL_ID, 7, GoalStatus.SUCCEEDED, labels={"order": "17"})
    log.goal.told_info = told
    assert stream.info == told


# What a follower reads


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("attempt", "expected"), [(1, [1, 2, 3, 4]), (2, [3, 4]), (3, [1, 2, 3, 4]), (None, [3, 4])]
)
async def test_a_number_of_another_attempt_is_not_one_to_begin_behind(
    attempt: int | None, expected: list[int]
) -> None:
    log = new_log()
    log.goal.attempt = 2
    append(log, 3)
    stream = log.follow(after=2, attempt=attempt)
    append(log, 1)
    end(log)
    with anyio.fail_after(5):
        assert await numbers(stream) == expected
    assert (stream.attempt, stream.dropped) == (2, 0)


KEPT = GoalKept("the server keeps the goal")


@pytest.mark.asyncio
@pytest.mark.parametrize("feedback", [True, False])
async def test_a_log_that_fails_fails_all_that_follow_it_now_or_later(feedback: bool) -> None:
    log = new_log()
    stream, closed, gone = (log.follow(feedback=feedback) for _ in range(3))
    closed.close()
    del gone
    append(log, 1)

    async def outcome() -> None:
        with pytest.raises(GoalKept, match=r"^the server keeps the goal$"):
            await stream.outcome()

    await while_waiting(outcome, lambda: log.fail(KEPT))
    for other in (stream, closed):
        with pytest.raises(GoalKept):
            other.take()
    with pytest.raises(GoalKept):
        log.follow()


@pytest.mark.asyncio
async def test_an_executor_waits_for_no_follower_of_a_log_that_has_failed() -> None:
    log = new_log(window=1)
    stream = log.follow(own=True)
    append(log, 1)
    await while_waiting(lambda: log.wait_for_room(math.inf), lambda: log.fail(KEPT))
    assert not stream.holding
    append(log, 2)
    assert not log.is_full


@pytest.mark.parametrize("reads", [True, False])
def test_what_a_closed_follower_has_not_read_is_missed_if_it_wanted_any(reads: bool) -> None:
    log = new_log()
    stream = log.follow(feedback=reads)
    append(log, 2)
    stream.take()
    stream.close()
    append(log, 1)
    assert not stream.take()
    assert stream.dropped == 0  # it is told with the end
    end(log)
    for _ in range(2):
        assert stream.take() == (OUTCOME,)
        assert (stream.cursor, stream.dropped) == ((3, 2) if reads else (0, 0))


# What is there already


def numbers_of(taken: Sequence[GoalUpdate]) -> list[int]:
    return [update.number for update in taken if isinstance(update, FeedbackItem)]


@pytest.mark.parametrize("limit", [1, 10])
def test_with_latest_a_piece_is_the_newest_whatever_its_limit(limit: int) -> None:
    log = new_log(latest=True)
    stream = log.follow()
    append(log, 5)
    assert not stream.take(0)
    assert numbers_of(stream.take(limit)) == [5]
    assert stream.dropped == 4
    assert not stream.take(limit)


@pytest.mark.parametrize("latest", [False, True])
def test_a_goal_that_has_ended_has_no_end_for_a_reader_with_feedback_left_to_take(
    latest: bool,
) -> None:
    log = new_log(latest=latest)
    stream = log.follow()
    append(log, 1)
    assert stream.known_outcome() is None
    end(log)
    assert not stream.take(0)
    assert stream.known_outcome() is OUTCOME
    assert (stream.cursor, stream.dropped) == (0, 0)
    assert numbers_of(stream.take(5)) == [1]
    assert stream.take(5) == (OUTCOME,)
    assert stream.take(0) == (OUTCOME,)
    assert (stream.cursor, stream.dropped) == (1, 0)


@given(
    window=strategies.integers(1, 5),
    latest=strategies.booleans(),
    after=strategies.none() | strategies.integers(0, 10),
    steps=strategies.lists(
        strategies.sampled_from(["append", "status"]) | strategies.integers(0, 4), max_size=30
    ),
)
def test_pieces_of_any_size_are_in_order_and_leave_nothing_out_but_what_is_counted(
    window: int, latest: bool, after: int | None, steps: list[str | int]
) -> None:
    log = new_log(window, latest=latest)
    append(log, 4)
    stream = log.follow(after=after)
    start = 4 if after is None else min(after, 4)
    seen: list[int] = []
    statuses = told = 0

    def take(limit: int) -> bool:
        nonlocal told
        taken = stream.take(limit)
        if taken and isinstance(taken[0], GoalStatus):
            told += 1
        else:
            assert told == statuses
            assert len(numbers_of(taken)) <= limit
            seen.extend(numbers_of(taken))
            assert stream.cursor == start + len(seen) + stream.dropped
        return taken == (OUTCOME,)

    for step in steps:
        if step == "append":
            append(log, 1)
        elif step == "status":
            change(log, GoalStatus.EXECUTING)
            statuses += 1
        else:
            assert isinstance(step, int)
            assert not take(step)
    end(log)
    while not take(2):
        pass
    assert seen == sorted(set(seen))
    assert len(seen) + stream.dropped == log.count - start
    assert log.count == start or seen[-1] == log.count


# Who is told that there is something


def count_wakes(stream: FeedbackCursor) -> list[None]:
    """A list that grows at each of the stream's wakes."""
    wakes: list[None] = []
    stream.news.on_next = lambda: wakes.append(None)
    return wakes


def test_a_reader_is_told_of_feedback_of_statuses_of_the_end_and_of_its_being_closed() -> None:
    for happens in (
        lambda log, stream: append(log, 1),
        lambda log, stream: change(log, GoalStatus.EXECUTING),
        lambda log, stream: log.finish(),
        lambda log, stream: stream.close(),
    ):
        log = new_log()
        stream = log.follow()
        wakes = count_wakes(stream)
        happens(log, stream)
        assert len(wakes) == 1


def test_a_log_keeps_its_readers_alive_and_no_other_cursor() -> None:
    log = new_log()
    reader, closed = log.follow(), log.follow()
    without = log.follow(feedback=False)
    closed.close()
    streams = [weakref.ref(stream) for stream in (reader, closed, without)]
    wakes = count_wakes(reader)
    del reader, closed, without
    gc.collect()
    assert [stream() is not None for stream in streams] == [True, False, False]
    end(log)  # and it does not stumble over those that are gone
    assert wakes


def test_a_log_that_is_followed_after_its_end_is_freed_when_the_stream_is_closed() -> None:
    log = new_log()
    end(log)
    stream = log.follow()
    gone = weakref.ref(log)
    gc.disable()
    try:
        stream.close()
        del log, stream
        assert gone() is None
    finally:
        gc.enable()


def test_a_log_that_has_ended_is_freed_with_the_last_of_its_streams() -> None:
    log = new_log()
    one, other = log.follow(own=True), log.follow()
    append(log, 2)
    end(log)
    gone = weakref.ref(log)
    del log
    assert numbers_of(one.take(9)) == [1, 2]
    one.hold(False)
    del one
    assert gone() is not None
    del other
    assert gone() is None


def test_a_log_forgets_those_that_waited_for_the_end_and_are_gone() -> None:
    log = new_log()
    waiting = [log.follow(feedback=False) for _ in range(10)]
    for _ in range(1000):
        log.follow(feedback=False)
        log.follow().close()
    assert log._others is not None
    assert len(log._others) <= 40
    wakes = [count_wakes(stream) for stream in waiting]
    end(log)
    assert all(wakes)


def test_following_reading_and_leaving_take_the_same_time_with_ten_thousand_followers() -> None:
    def seconds_with(followers: int) -> float:
        log = new_log()
        began = process_time()
        for hold in (False, True):
            streams = [log.follow(own=hold) for _ in range(followers)]
            append(log, 1)
            for stream in streams:
                assert numbers_of(stream.take(9)) == [log.count]
            for stream in streams:
                stream.close()
        return process_time() - began

    # Ten times the work; a hundred times, if each of them looked at all others.
    assert seconds_with(10_000) < 40 * seconds_with(1000)


# What a follower hears of the status


@pytest.mark.asyncio
@pytest.mark.parametrize("wait", [GoalStream.receive, GoalStream.outcome])
async def test_a_cursor_that_has_failed_raises_its_error_anew_for_each_wait(
    wait: Callable[[GoalStream], Awaitable[object]],
) -> None:
    log, error = new_log(), ConnectionLost("gone")
    stream, ended = log.follow(own=True), log.follow()
    raised: list[ConnectionLost] = []

    async def fails() -> None:
        with pytest.raises(ConnectionLost, match=r"^gone$") as caught:
            await wait(stream)
        raised.append(caught.value)

    await while_waiting(fails, lambda: stream.fail(error))
    await fails()
    assert len({id(one) for one in (*raised, error)}) == 3
    append(log, 2000)
    assert not log.is_full
    end(log)
    ended.fail(error)
    assert ended.known_outcome() is OUTCOME, "an outcome that is known stays"


# Making the executor wait


def test_a_follower_holds_nothing_up_unless_told_to_and_a_log_keeps_one_feedback() -> None:
    log = FeedbackLog(GoalFacts(GOAL_ID, 7))
    assert not log.follow().holding
    assert log.follow(own=True).holding
    append(log, 2)
    assert [(item.number, item.payload) for item in log.after(0, 10)] == [(2, b"2")]


def read_one(log: FeedbackLog[GoalFacts], stream: FeedbackCursor) -> None:
    assert stream.take()


@pytest.mark.asyncio
@pytest.mark.parametrize(
    "make_room",
    [
        read_one,
        lambda log, stream: stream.seek(1),
        lambda log, stream: stream.hold(False),
        lambda log, stream: stream.close(),
    ],
    ids=["reading", "passing over", "not holding", "closing"],
)
async def test_the_wait_for_room_ends_when_its_client_reads_or_lets_go(
    make_room: Callable[[FeedbackLog[GoalFacts], FeedbackCursor], None],
) -> None:
    log = new_log(window=1)
    stream = log.follow(own=True)
    append(log, 1)
    await while_waiting(lambda: log.wait_for_room(math.inf), lambda: make_room(log, stream))
    assert not log.is_full


a_follower = strategies.integers(0, 3)


@given(
    window=strategies.integers(1, 4),
    steps=strategies.lists(
        strategies.tuples(strategies.sampled_from(["append", "stall"]), strategies.just(0))
        | strategies.tuples(
            strategies.sampled_from(["take", "close", "hold", "let go", "seek"]), a_follower
        )
        | strategies.tuples(strategies.sampled_from(["follow"]), a_follower),
        max_size=60,
    ),
)
@example(1, [("follow", 0), ("append", 0), ("take", 0), ("take", 1)])
def test_a_log_is_full_exactly_if_a_holding_follower_is_a_window_behind(
    window: int, steps: list[tuple[str, int]]
) -> None:
    async def check() -> None:
        log = new_log(window)
        streams = [log.follow(own=True), log.follow(own=True), log.follow(), log.follow()]
        everyone = set(streams)
        for step, number in steps:
            stream = streams[number]
            match step:
                case "append":
                    append(log, 1)
                case "stall":
                    await log.wait_for_room(0)
                case "follow":
                    streams[number] = log.follow(own=number != 3, after=log.count - 1)
                case "take":
                    stream.take(2)
                case "close":
                    stream.close()
                case "seek":
                    stream.seek(log.count - 2)
                case _:
                    stream.hold(step == "hold")
            # A follower that was replaced still holds: nobody has closed it.
            everyone.update(streams)
            behind = [log.count - one.cursor for one in everyone if one.holding]
            assert log.is_full is (max(behind, default=-1) >= window)

    anyio.run(check)


# The bytes of feedback


def log_within(budget: ByteBudget, *, window: int = 4) -> FeedbackLog[GoalFacts]:
    return FeedbackLog(GoalFacts(GOAL_ID, 7), window=window, budget=budget)


def test_the_bytes_of_remembered_feedback_are_counted_and_given_back() -> None:
    budget = ByteBudget(1000)
    log = log_within(budget, window=3)
    for size in (1, 10, 100):
        log.append(bytes(size))
    assert budget.used == 111
    log.append(bytes(5))
    assert budget.used == 115
    del log
    assert budget.used == 0


def test_a_log_without_holding_readers_keeps_its_newest_feedback_when_bytes_are_used_up() -> None:
    budget = ByteBudget(20)
    log = log_within(budget)
    observer = log.follow()
    for size in (8, 8, 8):
        log.append(bytes(size))
    assert (budget.used, log.is_full) == (16, False)
    log.append(bytes(30))
    assert budget.used == 30
    assert numbers_of(observer.take(9)) == [4]
    assert observer.dropped == 3


def test_what_is_kept_without_need_gives_way_before_the_feedback_of_a_log() -> None:
    budget = ByteBudget(20)
    budget.take(10)  # as a goal that has ended
    log = log_within(budget)
    observer = log.follow()
    log.append(bytes(8))
    budget.make_room = lambda: budget.give_back(10)
    log.append(bytes(8))
    assert budget.used == 16
    assert numbers_of(observer.take(9)) == [1, 2]


def test_a_holding_reader_loses_nothing_when_bytes_are_used_up_and_the_executor_waits() -> None:
    budget = ByteBudget(20)
    log = log_within(budget)
    client = log.follow(own=True)
    log.append(bytes(8))
    log.append(bytes(8))
    assert not log.is_full
    log.append(bytes(8))
    assert log.is_full
    assert numbers_of(client.take(2)) == [1, 2]
    assert log.is_full
    assert numbers_of(client.take(2)) == [3]
    assert not log.is_full
    log.append(bytes(8))
    assert (budget.used, log.is_full) == (16, False)
    assert client.dropped == 0


@pytest.mark.asyncio
async def test_a_wait_for_bytes_ends_soon_after_others_have_given_them_back() -> None:
    budget = ByteBudget(20)
    log = log_within(budget)
    client = log.follow(own=True)
    log.append(bytes(8))
    budget.take(15)
    await while_waiting(lambda: log.wait_for_room(math.inf), lambda: budget.give_back(15))
    assert client.holding


@pytest.mark.asyncio
async def test_a_client_that_does_not_read_stalls_also_when_it_is_the_bytes_that_are_used_up() -> (
    None
):
    budget = ByteBudget(20)
    log = log_within(budget)
    slow, quick = log.follow(own=True), log.follow(own=True)
    log.append(bytes(21))
    quick.take()
    with anyio.fail_after(5):
        await log.wait_for_room(0)
    assert (slow.holding, quick.holding, log.is_full) == (False, True, False)


@pytest.mark.anyio
@pytest.mark.parametrize(("is_brief", "seconds"), [(False, 10.0), (True, LONGEST_HOLD)])
@in_virtual_time()
async def test_a_client_stalls_after_exactly_the_time_that_it_was_given(
    is_brief: bool, seconds: float
) -> None:
    log = new_log(window=1)
    stream = log.follow(own=True)
    if is_brief:
        stream.hold_briefly()
    append(log, 1)
    start = anyio.current_time()
    await log.wait_for_room(10.0)
    assert anyio.current_time() - start == pytest.approx(seconds)
    assert not stream.holding


@pytest.mark.anyio
@in_virtual_time()
async def test_a_client_that_reads_slowly_takes_a_tenth_of_the_time_at_most() -> None:
    log = new_log(window=1)
    stream = log.follow(own=True)
    stream.hold_briefly()
    waited, start = 0.0, anyio.current_time()

    async def read_slowly() -> None:
        while True:
            stream.take(1000)
            await anyio.sleep(0.1)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(read_slowly)
        for number in range(1, 1000):
            before = anyio.current_time()
            if log.is_full:
                await log.wait_for_room(10.0)
            waited += anyio.current_time() - before
            append(log, number)
            await anyio.sleep(0.01)
        tasks.cancel_scope.cancel()
    assert waited <= LONGEST_HOLD + HELD_SHARE * (anyio.current_time() - start)
    assert waited > LONGEST_HOLD, "it is waited for again after a while"


@pytest.mark.anyio
@in_virtual_time()
async def test_a_client_that_may_hold_for_long_does_so_beside_one_that_may_not() -> None:
    log = new_log(window=1)
    short, long = log.follow(own=True), log.follow(own=True)
    short.hold_briefly()
    append(log, 1)
    start = anyio.current_time()
    await log.wait_for_room(10.0)
    assert anyio.current_time() - start == pytest.approx(10.0)
    assert (short.holding, long.holding) == (False, False)


# The payload of the goal


def test_the_payload_and_the_feedback_of_an_ended_goal_count_until_its_log_is_gone() -> None:
    budget = ByteBudget(1000)
    goal = GoalFacts(GOAL_ID, 7)
    goal.held = CountedBytes(budget, 100)
    log = FeedbackLog(goal, window=10, budget=budget, payload=bytes(100))
    stream = log.follow()
    log.append(bytes(30))
    assert (stream.goal, budget.used) == (bytes(100), 130)  # the payload is counted by the server
    goal.held.resize(5)
    goal.outcome = OUTCOME
    log.finish()
    assert (budget.used, goal.held.size) == (135 + KEPT_MESSAGE, 135 + KEPT_MESSAGE)
    del log, stream
    assert (budget.used, goal.held.size) == (5, 5)
    goal.held = None
    assert budget.used == 0


def test_a_log_that_loses_its_payload_counts_the_rest() -> None:
    budget = ByteBudget(1000)
    goal = GoalFacts(GOAL_ID, 7)
    goal.held = CountedBytes(budget, 5)
    log = FeedbackLog(goal, window=10, budget=budget, payload=bytes(100))
    stream = log.follow()
    log.append(bytes(30))
    goal.outcome = OUTCOME
    log.finish()
    for _ in range(2):
        log.lose_payload()
        assert (budget.used, stream.goal) == (35 + KEPT_MESSAGE, None)
    assert len(stream.take()) == 1
    del log, stream
    assert budget.used == 5


def test_a_log_that_loses_its_result_has_nothing_left_and_its_streams_end_with_an_error() -> None:
    budget = ByteBudget(1000)
    goal = GoalFacts(GOAL_ID, 7)
    goal.held = CountedBytes(budget, 5)
    log = FeedbackLog(goal, window=10, budget=budget, payload=bytes(100))
    stream, other, told = log.follow(), log.follow(feedback=False), log.follow(feedback=False)
    append(log, 3)
    goal.outcome = OUTCOME
    log.finish()
    assert told.take() == (OUTCOME,)
    log.lose_result()
    assert (budget.used, goal.held.size, stream.goal) == (5, 5, None)
    for lost in (stream.take, other.take, stream.known_outcome, log.follow):
        with pytest.raises(UnknownGoal):
            lost()


# Feedback that followers may not have


@pytest.mark.asyncio
async def test_hidden_feedback_comes_when_it_is_revealed() -> None:
    log = new_log()
    log.is_hidden = True
    stream = log.follow(after=0)
    append(log, 1)
    assert stream.take() == ()
    await while_waiting(stream.receive, log.reveal)
    assert stream.cursor == 1


def test_feedback_after_the_end_of_a_goal_is_discarded_and_holds_no_bytes() -> None:
    budget = ByteBudget(1000)
    goal = GoalFacts(GOAL_ID, 7)
    goal.held = CountedBytes(budget, 100)
    log = FeedbackLog(goal, budget=budget)
    append(log, 1)
    log = log.discarding()
    goal.held = None
    assert budget.used == 0
    stream = log.follow(after=0)
    log.append(b"too late")
    assert (stream.take(), log.count, budget.used, log.is_full) == ((), 1, 0, False)


def test_a_log_whose_bytes_are_not_counted_loses_its_result_too() -> None:
    log = new_log()
    stream = log.follow()
    end(log)
    log.lose_result()
    with pytest.raises(UnknownGoal):
        stream.take()
