"""The lines of a recording, and payloads from them."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from fibaction.observe.recordings.recording_file import Record, payload_of, read_records
from fibaction.schema.payload import PayloadError
from tests.support.fibonacci import FIBONACCI, Goal


def test_lines_that_are_not_records_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "recording.jsonl"
    good = msgspec.json.encode(Record(1, "left", "count"))
    path.write_bytes(b'{"time":1\n' + good + b"\n\xff\n" + b"[" * 5000 + b"\n\n" + good[:-1])

    assert list(read_records(path)) == [Record(1, "left", "count")]


@pytest.mark.parametrize("number", ["9" * 5000, str(10**30), str(2**63), "1e300", "-1"])
@pytest.mark.parametrize("field", ["time", "number", "attempt"])
def test_lines_with_impossible_numbers_are_left_out(
    tmp_path: Path, field: str, number: str
) -> None:
    path = tmp_path / "recording.jsonl"
    good = Record(1, "left", "count", number=1, attempt=2)
    line = msgspec.json.encode(good).decode()
    assert line.count(f'"{field}":') == 1
    broken = re.sub(f'"{field}":\\d+', f'"{field}":{number}', line)
    path.write_text(f"{broken}\n{line}\n")

    assert list(read_records(path)) == [good]


def test_the_payload_of_a_record_is_that_of_its_data_or_its_raw_bytes() -> None:
    goal = Record(1, "accepted", "fibonacci", data={"order": 3})

    assert payload_of(goal, FIBONACCI.info.goal) == FIBONACCI.goal.encode(Goal(3))
    assert payload_of(Record(1, "end", "fibonacci"), {}) is None
    assert payload_of(Record(1, "end", "fibonacci", raw=b"\xc1"), {}) == b"\xc1"


def test_data_of_another_type_is_an_error_that_names_the_goal() -> None:
    record = Record(1, "accepted", "fibonacci", "12ab", data={"order": "x"})

    with pytest.raises(PayloadError, match=r"^accepted of goal 12ab in the recording: goal\.order"):
        payload_of(record, FIBONACCI.info.goal)
