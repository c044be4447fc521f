from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable
from contextlib import suppress

import pytest
from hypothesis import assume, given, strategies

from fibaction.border.byte_budgets import ByteBudget
from fibaction.wire.frames import (
    _OTHERS,
    FIRST_FRAME,
    HEADER,
    MAX_FRAME,
    UNCOUNTED,
    FrameMemory,
    FrameReader,
    framed,
    header,
)
from fibaction.words.errors import LimitReached, ProtocolError

FRAMES = strategies.lists(strategies.binary(max_size=300), max_size=8)
LIMIT = 100


def chopped(data: bytes, places: Iterable[int]) -> list[bytes]:
    """The same bytes in pieces, some of which may be empty."""
    cuts = [0, *sorted(min(place, len(data)) for place in places), len(data)]
    return [data[start:end] for start, end in itertools.pairwise(cuts)]


def test_a_header_is_the_length_in_four_bytes_the_highest_first() -> None:
    assert header(0) == b"\0\0\0\0"
    assert header(0x01020304) == b"\1\2\3\4"
    assert len(header(MAX_FRAME)) == HEADER


@given(FRAMES, strategies.lists(strategies.integers(0, 2500), max_size=20))
def test_frames_come_out_alike_in_any_chopping(frames: list[bytes], places: list[int]) -> None:
    data = framed(frames)
    in_pieces, byte_by_byte = FrameReader(), FrameReader()
    assert FrameReader().feed(data) == frames
    assert [frame for piece in chopped(data, places) for frame in in_pieces.feed(piece)] == frames
    assert [frame for byte in data for frame in byte_by_byte.feed(bytes([byte]))] == frames


@given(FRAMES, strategies.integers(0, 2500))
def test_it_is_within_a_frame_unless_the_bytes_end_with_one(frames: list[bytes], cut: int) -> None:
    data = framed(frames)[:cut]
    reader = FrameReader()
    whole = framed(reader.feed(data))
    assert reader.is_within_frame == (whole != data)


@given(FRAMES, strategies.lists(strategies.integers(0, 2500), max_size=20))
def test_no_more_is_held_than_one_frame_that_is_not_complete(
    frames: list[bytes], places: list[int]
) -> None:
    data = framed(frames)
    reader = FrameReader()
    fed = given_out = 0
    for piece in chopped(data, places):
        fed += len(piece)
        given_out += sum(HEADER + len(frame) for frame in reader.feed(piece))
        held = bytes(reader._buffer)
        assert held == data[given_out:fed]
        assert len(held) < HEADER or len(held) < HEADER + int.from_bytes(held[:HEADER], "big")


def test_the_memory_of_a_large_frame_is_given_back() -> None:
    reader = FrameReader()
    large = bytes(2**20)
    assert reader.feed(framed([large]) + b"\0") == [large]
    assert sys.getsizeof(reader._buffer) < 1000


@given(
    strategies.lists(strategies.binary(max_size=LIMIT), max_size=3),
    strategies.integers(LIMIT + 1, 2**32 - 1),
)
def test_a_frame_over_the_limit_is_rejected_with_its_header(frames: list[bytes], size: int) -> None:
    reader = FrameReader(LIMIT)
    assert reader.feed(framed(frames)) == frames
    assert reader.feed(header(size)[:-1]) == []
    assume(not header(size).startswith(tuple(_OTHERS)))  # see below
    with pytest.raises(ProtocolError, match=f"^frame of {size} bytes exceeds .* {LIMIT} bytes$"):
        reader.feed(header(size)[-1:])


ADVICE = {
    "TLS": "use tls:// at both ends, or at neither",
    "HTTP": "use http:// at both ends, or check the port",
}


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (b"\x16\x03\x01\x02\x00", "TLS"),
        (b"GET / HTTP/1.1", "HTTP"),
        (b"POST /goals HTTP/1.1", "HTTP"),
        (b"HEAD / HTTP/1.1", "HTTP"),
        (b"HTTP/1.1 400 Bad Request", "HTTP"),
        (b"<!DOCTYPE HTML>", "HTTP"),
        (b"\x15\x03\x03\x00\x02", "TLS"),
    ],
)
def test_bytes_of_another_protocol_are_recognized(data: bytes, name: str) -> None:
    with pytest.raises(ProtocolError, match=f"bytes: this looks like {name}: {ADVICE[name]}$"):
        FrameReader().feed(data)


@pytest.mark.parametrize("limit", [1, LIMIT, MAX_FRAME])
def test_a_frame_at_the_limit_is_let_through(limit: int) -> None:
    assert FrameReader(limit).feed(framed([bytes(limit)])) == [bytes(limit)]


def test_the_limit_is_that_of_the_protocol_unless_another_is_given() -> None:
    assert FrameReader().feed(header(MAX_FRAME)) == []
    with pytest.raises(ProtocolError, match=str(MAX_FRAME)):
        FrameReader().feed(header(MAX_FRAME + 1))


@given(strategies.lists(strategies.binary(max_size=50)))
def test_any_bytes_are_frames_or_a_protocol_error(pieces: list[bytes]) -> None:
    reader = FrameReader(LIMIT)
    frames: list[bytes] = []
    try:
        for piece in pieces:
            frames += reader.feed(piece)
    except ProtocolError:
        pass
    assert b"".join(pieces).startswith(framed(frames))
    assert all(len(frame) <= LIMIT for frame in frames)


# The first frame of a client


def first_reader() -> FrameReader:
    return FrameReader(10_000, first=FIRST_FRAME)


def test_the_first_frame_has_a_limit_of_its_own() -> None:
    reader = first_reader()
    assert reader.feed(framed([bytes(FIRST_FRAME)])) == [bytes(FIRST_FRAME)]
    with pytest.raises(
        ProtocolError, match=r"^frame of 4097 bytes exceeds the limit of 4096 bytes"
    ):
        first_reader().feed(header(FIRST_FRAME + 1))


@given(strategies.lists(strategies.integers(0, 20_000), max_size=5))
def test_after_the_first_frame_the_limit_is_that_of_all(places: list[int]) -> None:
    frames = [b"hello", bytes(10_000), bytes(9_000)]
    reader = first_reader()
    pieces = chopped(framed(frames), places)
    assert [frame for piece in pieces for frame in reader.feed(piece)] == frames
    with pytest.raises(ProtocolError, match=r"limit of 10000 bytes$"):
        reader.feed(header(10_001))


# The memory that readers share


def sharing(limit: int) -> tuple[ByteBudget, FrameReader, FrameReader]:
    budget = ByteBudget(limit)
    memory = FrameMemory(budget)
    return budget, FrameReader(memory=memory), FrameReader(memory=memory)


def test_what_is_held_of_large_frames_is_counted_and_given_back() -> None:
    budget, one, other = sharing(10 * UNCOUNTED)
    one.feed(header(3 * UNCOUNTED) + bytes(UNCOUNTED - HEADER))
    assert budget.used == 0  # small messages always pass
    one.feed(bytes(100))
    assert budget.used == 100
    other.feed(header(2 * UNCOUNTED) + bytes(UNCOUNTED))
    assert budget.used == 100 + HEADER
    assert one.feed(bytes(2 * UNCOUNTED - 100 + HEADER)) == [bytes(3 * UNCOUNTED)]
    assert budget.used == HEADER
    other.close()
    other.close()
    assert budget.used == 0
    assert not other.is_within_frame


def test_the_reader_that_holds_the_most_is_given_up_for_another() -> None:
    budget, large, small = sharing(3 * UNCOUNTED)
    large.feed(header(MAX_FRAME) + bytes(4 * UNCOUNTED - HEADER))
    assert budget.used == budget.limit
    assert small.feed(header(2 * UNCOUNTED) + bytes(UNCOUNTED)) == []
    assert budget.used == HEADER  # its memory is free at once
    with pytest.raises(LimitReached, match=r"^the server is busy: it has no room for a large"):
        large.feed(b"more")
    assert small.feed(bytes(UNCOUNTED)) == [bytes(2 * UNCOUNTED)]
    assert budget.used == 0


def test_the_reader_that_wants_more_fails_if_it_holds_the_most() -> None:
    budget, large, small = sharing(2 * UNCOUNTED)
    small.feed(header(MAX_FRAME) + bytes(2 * UNCOUNTED - HEADER))
    with pytest.raises(LimitReached):
        large.feed(header(MAX_FRAME) + bytes(3 * UNCOUNTED))
    assert budget.used == UNCOUNTED
    assert small.feed(b"more") == []


def test_small_frames_pass_whatever_is_held() -> None:
    budget, _, small = sharing(1)
    budget.take(1000)  # by others
    assert small.feed(header(1000) + bytes(500)) == []
    assert small.feed(bytes(500)) == [bytes(1000)]
    with pytest.raises(LimitReached):
        small.feed(header(MAX_FRAME) + bytes(2 * UNCOUNTED))
    assert budget.used == 1000


def test_a_frame_that_is_complete_passes_whatever_is_held() -> None:
    budget, reader, _ = sharing(UNCOUNTED)
    reader.feed(header(3 * UNCOUNTED) + bytes(UNCOUNTED))
    budget.take(UNCOUNTED)  # by others
    assert reader.feed(bytes(2 * UNCOUNTED)) == [bytes(3 * UNCOUNTED)]
    assert budget.used == UNCOUNTED


@given(
    strategies.lists(
        strategies.tuples(strategies.integers(0, 3), strategies.integers(0, 3 * UNCOUNTED)),
        max_size=20,
    )
)
def test_nothing_leaks_and_the_limit_holds(feeds: list[tuple[int, int]]) -> None:
    budget = ByteBudget(4 * UNCOUNTED)
    memory = FrameMemory(budget)
    readers = [FrameReader(memory=memory) for _ in range(4)]
    for reader in readers:
        reader.feed(header(5 * UNCOUNTED))
    for number, size in feeds:
        with suppress(LimitReached, ProtocolError):
            readers[number].feed(bytes(size))
        held = sum(max(0, len(reader._buffer) - UNCOUNTED) for reader in readers)
        assert budget.used == held <= budget.limit
    for reader in readers:
        reader.close()
    assert budget.used == 0
