"""`serve --record`, `record`, `show`, `replay` and `export`: as processes, and with wrong files."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path
from signal import SIGINT

import msgspec
import pytest

from fibaction import serve as fibaction_serve
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.cli.verbs import recordings, serve
from fibaction.observe.recordings.recording_file import Record, read_records
from tests.cli.conftest import Invoke, Run, Start
from tests.cli.served import Heard, counter
from tests.support.processes import ended, lines_until


def test_a_recording_of_a_server_is_shown_and_replayed(
    folder: Path, started: Start, here: Run
) -> None:
    unix, file = f"unix://{folder}/socket", str(folder / "today.jsonl")
    server = started("serve", "robot:several", unix, "--record", file)
    lines_until("serving", server)
    real = here("send_goal", "count", "3", "-f", url=unix)
    assert here("send_goal", "count", "--", "-3", url=unix).code != ExitCode.SUCCEEDED
    server.send_signal(SIGINT)
    assert ended(server)[0] == 0

    shown = here("show", file)
    assert shown.code == ExitCode.SUCCEEDED
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d to .*, 2 goals", shown.lines[0])
    assert shown.lines[1:] == [
        "/count: 1 SUCCEEDED, 1 REJECTED; 3 feedback messages",
        "/arm/tell: no goals; 0 feedback messages",
    ]

    replay = started("replay", file, unix, "--speed", "1000")
    (line,) = lines_until("replaying", replay)
    assert line == f"replaying /count, /arm/tell of {file} at {unix}, Ctrl-C stops it\n"
    again = here("send_goal", "count", "3", "-f", url=unix)
    no_ids = [re.sub(r"\b[0-9a-f]{32}\b", "ID", "\n".join(one.lines)) for one in (real, again)]
    assert no_ids[0] == no_ids[1]
    assert here("send_goal", "count", "4", url=unix).code == ExitCode.REJECTED
    replay.send_signal(SIGINT)
    assert ended(replay)[0] == 0


def test_what_is_missing_in_a_recording_is_shown_too(folder: Path, invoke: Invoke) -> None:
    day = 86_400_000_000_000
    records = [
        Record(day * 10, "accepted", "count", "a"),
        Record(day * 12, "dropped", "", number=7),
    ]
    file = folder / "today.jsonl"
    file.write_bytes(b"".join(msgspec.json.encode(record) + b"\n" for record in records))

    lines = invoke("show", str(file)).stdout.splitlines()
    assert re.fullmatch(r"1970-01-\d\d \S+ to 1970-01-\d\d \S+, 1 goal", lines[0])
    assert lines[1:] == [
        "/count: 1 without an end; 0 feedback messages",
        "feedback messages that are missing: 7",
    ]
    assert json.loads(invoke("show", str(file), "--json").stdout) == {
        "first": day * 10,
        "last": day * 12,
        "dropped": 7,
        "actions": {"count": {"ends": {}, "active": 1, "feedback": 0}},
    }


class Said(Heard):
    """What a command says; as soon as it serves, it gets SIGTERM."""

    def __call__(self, *what: str) -> None:
        super().__call__(*what)
        (text,) = what
        if not text.startswith("metrics"):
            signal.raise_signal(signal.SIGTERM)


@pytest.mark.asyncio
async def test_a_server_has_metrics_and_a_recording_until_a_signal_comes(folder: Path) -> None:
    said, ends = Said(), list[str]()
    file, url = folder / "today.jsonl", f"unix://{folder}/socket"
    with said.on_stdout():
        code = await serve.serve_servers(
            [counter("count")],
            [url],
            metrics="127.0.0.1:0",
            record=str(file),
            at_end=lambda: ends.append("end"),
        )

    assert (code, ends) == (ExitCode.SUCCEEDED, ["end"])
    assert said[0].startswith("metrics at http://127.0.0.1:")
    assert said[1] == f"serving /count at {url}, Ctrl-C stops it"
    assert [record.event for record in read_records(file)] == ["server"]


def test_a_replay_serves_until_a_signal_comes(
    folder: Path, invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = Said()
    monkeypatch.setattr(recordings, "say", said)
    file = folder / "today.jsonl"
    info = counter("count").info
    file.write_bytes(msgspec.json.encode(Record(1, "server", "count", info=info)) + b"\n")
    result = invoke("replay", str(file), f"unix://{folder}/socket")

    assert result.exit_code == ExitCode.SUCCEEDED
    assert said[0].startswith(f"replaying /count of {file} at unix://")


def test_a_server_that_runs_already_is_recorded_and_exported(
    folder: Path, started: Start, fibaction: Run, here: Run
) -> None:
    unix, file = f"unix://{folder}/socket", str(folder / "today.jsonl")
    lines_until("serving", started("serve", "robot:several", unix))
    recording = started("record", unix, file)
    assert lines_until("recording", recording) == [f"recording {unix} to {file}, Ctrl-C stops it\n"]
    # In a process of its own: when it has ended, the recording has heard of the goal.
    assert fibaction("send_goal", "count", "3", url=unix).code == ExitCode.SUCCEEDED
    recording.send_signal(SIGINT)
    assert ended(recording)[0] == 0

    assert here("show", file).lines[1].startswith("/count: 1 SUCCEEDED; ")
    exported = here("export", file, f"{file}.mcap")
    assert re.fullmatch(r".*today\.jsonl\.mcap has \d+ messages", exported.lines[0])
    assert Path(f"{file}.mcap").read_bytes().startswith(b"\x89MCAP")


@pytest.mark.asyncio
async def test_a_recording_from_outside_ends_at_a_signal(folder: Path) -> None:
    said = Said()
    async with fibaction_serve(counter("count"), f"unix://{folder}/socket") as (url,):
        with said.on_stdout():
            code = await recordings.record(url, str(folder / "today.jsonl"))
    assert (code, len(said)) == (ExitCode.SUCCEEDED, 1)
    assert [one.event for one in read_records(folder / "today.jsonl")] in ([], ["server"])


@pytest.mark.asyncio
async def test_a_file_that_cannot_be_written_is_one_sentence(folder: Path) -> None:
    file = f"{folder}/missing/today.jsonl"
    async with fibaction_serve(counter("count"), f"unix://{folder}/socket") as (url,):
        with pytest.raises(Failure, match=f"cannot record to {file}: No such file or directory"):
            await recordings.record(url, file)


def test_a_recording_that_cannot_be_exported_is_one_sentence(folder: Path, invoke: Invoke) -> None:
    file = folder / "today.jsonl"
    file.write_text("hello\n")
    result = invoke("export", str(file), f"{folder}/no/a.mcap")
    problem = f"cannot write {folder}/no/a.mcap: No such file or directory"
    assert (result.exit_code, result.stderr) == (ExitCode.USAGE, f"Error: {problem}\n")


def test_a_server_that_is_not_there_leaves_no_file(folder: Path, invoke: Invoke) -> None:
    file = folder / "today.jsonl"
    result = invoke("record", f"unix://{folder}/nobody", str(file))
    assert result.exit_code == ExitCode.UNREACHABLE
    assert result.stderr.endswith(": start the server, or give another URL\n")
    assert not file.exists()
