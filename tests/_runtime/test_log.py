"""The loggers of fibaction: each record is one clean line, and its traceback clean lines below."""

from __future__ import annotations

import io
import logging
import logging.handlers
import queue
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction._runtime import log as log_module
from fibaction._runtime.log import (
    ARGUMENT,
    ERRORS,
    FRAMES,
    INDENT,
    INTERVAL,
    LINE,
    LINES,
    MESSAGE,
    LineLimit,
    clean_logger,
    traceback_text,
)

NASTY = "a\nWARNING root: forged\r\x1b[2J\x85\u2028\u202e\udc80"
CLEAN = "a\\x0aWARNING root: forged\\x0d\\x1b[2J\\x85\\u2028\\u202e\\udc80"


class Mute(Exception):
    def __str__(self) -> str:
        raise ValueError("it does not say")


class Handler(logging.StreamHandler[io.StringIO]):
    """A handler that keeps its records."""

    def __init__(self) -> None:
        super().__init__(io.StringIO())
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)
        super().emit(record)


class Log:
    """A clean logger that writes to a text, as a program may have set it up."""

    def __init__(self) -> None:
        self.handler = handler = Handler()
        handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
        self.logger = clean_logger("fibaction.test")
        self.logger.handlers[:] = [handler]

    @property
    def lines(self) -> list[str]:
        return self.handler.stream.getvalue().split("\n")[:-1]


@pytest.fixture
def log() -> Iterator[Log]:
    log = Log()
    level, log.logger.propagate = log.logger.level, False
    log.logger.setLevel(logging.INFO)
    yield log
    log.logger.setLevel(level)
    log.logger.handlers.clear()


def raised(error: Exception, cause: Exception | None = None) -> Exception:
    """Return the error after it was raised."""
    try:
        raise error from cause
    except Exception as exc:
        return exc


# Messages


@pytest.mark.parametrize("argument", [NASTY, ValueError(NASTY)], ids=["text", "error"])
def test_a_message_is_one_printable_line(log: Log, argument: object) -> None:
    log.logger.info("rejected: %s", argument)

    assert log.lines == [f"INFO fibaction.test: rejected: {CLEAN}"]


def test_a_long_argument_is_cut_and_the_others_are_shown(log: Log) -> None:
    log.logger.info("%s and %s and %s", "x" * 10**7, ValueError("y" * 10**7), "the end")

    (line,) = log.lines
    assert line.endswith("x… and " + (ARGUMENT - 1) * "y" + "… and the end")


def test_a_message_without_arguments_is_cut(log: Log) -> None:
    log.logger.info("\n" * 10**6)
    log.logger.info("100 %\n")

    long, percent = log.lines
    assert len(long) == len("INFO fibaction.test: ") + MESSAGE
    assert percent == "INFO fibaction.test: 100 %\\x0a"


def test_arguments_by_name_are_cleaned(log: Log) -> None:
    log.logger.info("rejected: %(reason)s", {"reason": NASTY})

    assert log.lines == [f"INFO fibaction.test: rejected: {CLEAN}"]


@pytest.mark.parametrize(
    ("message", "arguments", "line"),
    [
        ("it said: %s", (Mute(),), "it said: (no text of a Mute)"),
        ("%d of %d", ("one",), "%d of %d (its arguments cannot be shown)"),
    ],
)
def test_a_message_that_cannot_be_made_does_not_raise(
    log: Log, message: str, arguments: tuple[object, ...], line: str
) -> None:
    log.logger.info(message, *arguments)

    assert log.lines == [f"INFO fibaction.test: {line}"]


def test_a_record_does_not_keep_an_error_that_is_an_argument(log: Log) -> None:
    log.logger.info("lost: %s", ConnectionError("the line"))

    assert log.handler.records[0].args == ("the line",)


# Tracebacks


def test_a_traceback_is_indented_and_clean(log: Log) -> None:
    log.logger.error("it failed", exc_info=raised(ValueError(NASTY)))

    first, *traceback = log.lines
    assert first == "ERROR fibaction.test: it failed"
    assert traceback[0] == f"{INDENT}Traceback (most recent call last):"
    assert traceback[1].startswith(f'{INDENT}  File "')
    assert traceback[-2:] == [
        f"{INDENT}ValueError: a",
        f"{INDENT}WARNING root: forged\\x0d\\x1b[2J\\x85\\u2028\\u202e\\udc80",
    ]


def test_a_traceback_is_clean_behind_a_queue(log: Log) -> None:
    waiting: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    handler = log.logger.handlers[0]
    log.logger.handlers[:] = [logging.handlers.QueueHandler(waiting)]
    log.logger.error("it failed", exc_info=raised(ValueError(NASTY)))
    handler.handle(waiting.get())

    assert all(line.startswith(INDENT) for line in log.lines[1:])
    assert all(line.isprintable() for line in log.lines)


def test_the_stack_of_a_call_is_indented(log: Log) -> None:
    log.logger.info("here", stack_info=True)

    assert log.lines[1] == f"{INDENT}Stack (most recent call last):"
    assert all(line.startswith(INDENT) for line in log.lines[1:])


def test_a_traceback_has_a_limited_size() -> None:
    text = traceback_text(raised(ValueError("x\n" * 10**6)))
    lines = text.split("\n")

    assert len(lines) <= LINES
    assert len(text) <= 3000
    assert len(traceback_text(ValueError("x" * 10**7))) <= LINE + len(INDENT)


def test_the_errors_behind_an_error_come_first() -> None:
    cause = raised(KeyError("key"))
    try:
        try:
            raise ValueError("value") from cause
        except ValueError:
            raise TypeError("type")  # noqa: B904 - its context is told
    except TypeError as exc:
        lines = traceback_text(exc).split("\n")

    places = [
        lines.index(INDENT + line)
        for line in (
            "KeyError: 'key'",
            "The above exception was the direct cause of the following exception:",
            "ValueError: value",
            "During handling of the above exception, another exception occurred:",
            "TypeError: type",
        )
    ]
    assert places == sorted(places)


def test_a_long_chain_is_cut_and_ends_with_the_error_itself() -> None:
    error: Exception = ValueError("0")
    for number in range(1000):
        error = raised(ValueError(f"{number + 1}"), error)
    lines = traceback_text(error).split("\n")

    assert lines[-1] == f"{INDENT}ValueError: 1000"
    assert len(lines) < LINES
    assert sum(line.startswith(f"{INDENT}ValueError") for line in lines) == ERRORS


def test_an_error_that_is_its_own_cause_is_shown() -> None:
    error = ValueError("again")
    error.__cause__ = error

    assert traceback_text(error).count("ValueError: again") == ERRORS


def test_what_does_not_fit_is_left_out_of_the_errors_behind() -> None:
    error = raised(ValueError("x\n" * 150), ValueError("y\n" * 150))
    lines = traceback_text(error).split("\n")

    assert lines[0] == f"{INDENT}... (some lines are left out)"
    assert len(lines) == LINES
    assert f"{INDENT}ValueError: x" in lines


def test_the_innermost_frames_are_shown() -> None:
    def fall(depth: int) -> None:
        if depth == 0:
            raise ValueError("deep")
        rise(depth - 1)

    def rise(depth: int) -> None:  # two, since Python folds repeated lines
        fall(depth)

    with pytest.raises(ValueError, match="deep") as caught:
        fall(200)
    lines = traceback_text(caught.value).split("\n")

    assert sum("File " in line for line in lines) == FRAMES
    assert any('raise ValueError("deep")' in line for line in lines)


def test_the_errors_of_a_group_are_below_it() -> None:
    group = ExceptionGroup("two", [raised(ValueError(NASTY)), raised(TypeError("no"))])
    lines = traceback_text(raised(group)).split("\n")

    assert f"{INDENT}ExceptionGroup: two (2 sub-exceptions)" in lines
    assert f"{INDENT}+---- 2 of 2 ----" in lines
    assert lines[-1] == f"{INDENT}| TypeError: no"
    assert all(line.isprintable() and line.startswith(INDENT) for line in lines)


def test_groups_of_any_width_and_depth_are_cut() -> None:
    group: Exception = ExceptionGroup("wide", [raised(ValueError("no")) for _ in range(1000)])
    for _ in range(100):
        group = raised(ExceptionGroup("deep", [group, group]), group)

    assert len(traceback_text(group).split("\n")) <= LINES


def test_notes_are_shown() -> None:
    error = ValueError("no")
    error.add_note(NASTY)

    first, second, third = traceback_text(error).split("\n")
    assert (first, second) == (f"{INDENT}ValueError: no", f"{INDENT}a")
    assert third.isprintable()


def test_a_mistake_in_code_is_shown_with_its_line() -> None:
    with pytest.raises(SyntaxError) as caught:
        compile("lift = = 3", "robot.py", "exec")

    lines = traceback_text(caught.value).split("\n")
    assert lines[-4:] == [
        f'{INDENT}  File "robot.py", line 1',
        f"{INDENT}    lift = = 3",
        f"{INDENT}           ^",
        f"{INDENT}SyntaxError: invalid syntax",
    ]


def test_an_error_of_a_module_is_named_with_it() -> None:
    assert traceback_text(Mute()) == f"{INDENT}tests._runtime.test_log.Mute: (no text of a Mute)"
    assert traceback_text(ValueError()) == f"{INDENT}ValueError"


def test_an_error_that_cannot_be_read_does_not_raise() -> None:
    error = ValueError("no")
    error.__notes__ = 3  # type: ignore[assignment]  # as foreign code may

    assert traceback_text(error) == f"{INDENT}(no traceback of a ValueError: TypeError)"


@given(st.text(max_size=500), st.text(max_size=500))
def test_no_text_makes_a_line_of_its_own(text: str, name: str) -> None:
    log = Log()
    log.logger.propagate = False
    try:
        error = type(name.replace("\0", "") or "E", (Exception,), {})(text)
    except (UnicodeError, ValueError):  # not the name of a class
        error = ValueError(text)
    log.logger.error("%s: %s", name, text, exc_info=error)
    log.logger.handlers.clear()

    first, *others = log.lines
    assert first.startswith("ERROR fibaction.test: ")
    assert all(line.startswith(INDENT) for line in others)
    assert all(line.isprintable() for line in log.lines)


# Floods of lines


QUOTA = 20
"""As in the module, where the other tests have another one."""


class Clock:
    """A clock that a test sets."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of the limit of lines."""
    clock = Clock()
    monkeypatch.setattr(log_module, "LIMIT", LineLimit(clock))
    monkeypatch.setattr(log_module, "QUOTA", QUOTA)
    return clock


def reject(log: Log, number: int, **how: object) -> None:
    log.logger.warning("%s is rejected", f"client {number}", **how)  # type: ignore[arg-type]


def test_a_flood_of_one_kind_is_some_lines_and_then_a_count_in_each_interval(
    log: Log, clock: Clock
) -> None:
    for number in range(1000):
        reject(log, number)
    assert log.lines == [
        f"WARNING fibaction.test: client {number} is rejected" for number in range(QUOTA)
    ]
    for _ in range(2):
        clock.now += INTERVAL
        for number in range(500):
            reject(log, number)
    clock.now += INTERVAL
    reject(log, 7)
    left_out, first = 1000 - QUOTA, f"client {QUOTA}"
    assert log.lines[QUOTA:] == [
        f"WARNING fibaction.test: {left_out} more lines like this one in 10 s: {first} is rejected",
        "WARNING fibaction.test: 500 more lines like this one in 10 s: client 0 is rejected",
        "WARNING fibaction.test: 500 more lines like this one in 10 s: client 0 is rejected",
    ]


def test_lines_are_written_again_when_a_flood_is_over(log: Log, clock: Clock) -> None:
    for number in range(QUOTA + 1):
        reject(log, number)
    for _ in range(2):
        clock.now += INTERVAL
        log.logger.info("a line of another kind")
    reject(log, 999)
    assert log.lines[-1].endswith(" client 999 is rejected")


def test_the_same_call_about_something_else_is_of_another_kind(log: Log, clock: Clock) -> None:
    for number in range(QUOTA + 1):
        reject(log, number, extra={"kind": 404})
    reject(log, 7, extra={"kind": 401})
    assert len(log.lines) == QUOTA + 1
    assert log.lines[-1].endswith(" client 7 is rejected")


def test_what_was_left_out_is_written_at_the_end_of_the_process(log: Log, clock: Clock) -> None:
    for number in range(QUOTA + 5):
        reject(log, number)
    log.logger.debug("a line of another kind, which is not enabled")
    log.logger.info("a line of another kind")
    log_module.LIMIT.flush()
    log_module.LIMIT.flush()
    assert log.lines[QUOTA + 1 :] == [
        f"WARNING fibaction.test: 5 more lines like this one in 0 s: client {QUOTA} is rejected"
    ]


def test_a_count_is_clean_and_one_whose_example_has_no_text_is_written_too(
    log: Log, clock: Clock
) -> None:
    for _ in range(QUOTA + 1):
        log.logger.warning("%s came", NASTY)
        log.logger.warning("%s came", Mute())
        log.logger.warning("%d came", "nobody")
    log_module.LIMIT.flush()
    said = [
        line.partition(" more lines like this one in 0 s: ")[2] for line in log.lines[3 * QUOTA :]
    ]
    assert said == [f"{CLEAN} came", "%s came", "%d came"]


def test_the_kinds_of_lines_are_forgotten_after_their_interval(log: Log, clock: Clock) -> None:
    for status in range(1000):
        reject(log, 1, extra={"kind": status})
    clock.now += INTERVAL
    reject(log, 1)
    assert len(log_module.LIMIT._kinds) == 1


def test_kinds_beyond_the_most_are_one_kind(
    log: Log, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_module, "MOST_KINDS", 3)
    for status in range(100):
        reject(log, 1, extra={"kind": status})
    assert len(log.lines) == 3 + QUOTA
