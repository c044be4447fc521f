"""The fuzz targets, without the fuzzer: each kept input once, and random ones."""

from __future__ import annotations

import json
import random
from types import ModuleType

import pytest

from tests.fuzz import fuzzer, rosbridge, rtps, web, websocket, wire
from tests.transports.rtps.test_golden import GOLDEN
from tests.transports.web.upgrade import upgrade


@pytest.mark.parametrize("target", [wire, websocket, web, rosbridge, rtps])
def test_without_atheris_it_says_what_to_type(
    target: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzzer, "find_spec", lambda name: None)

    with pytest.raises(SystemExit, match="atheris is not installed: `make fuzz` installs it"):
        target.main()


@pytest.mark.parametrize("target", [wire, websocket, web, rosbridge, rtps])
def test_each_kept_input_is_taken_again(target: ModuleType) -> None:
    kept = fuzzer.kept(target.__name__.rpartition(".")[2])
    assert 10 <= len(kept) <= 100
    assert sum(path.stat().st_size for path in kept) <= 200_000
    for path in kept:
        target.one_input(path.read_bytes())


def test_the_fuzzer_begins_with_the_kept_inputs_and_writes_elsewhere() -> None:
    command = fuzzer.command("wire", ["-max_total_time=30"])
    assert command[2:4] == ["build/fuzz/wire", "tests/fuzz/corpus/wire"]
    assert command[4:] == ["-artifact_prefix=build/fuzz/wire/"]


def test_the_target_of_websocket_takes_any_input() -> None:
    chance = random.Random(1)
    codes = b"\x80\x81\x82\x83\x88\x89\x8a\0\1\2\xc2"
    websocket.one_input(b"")
    for _ in range(300):
        frames = b"".join(
            bytes([chance.choice(codes), chance.choice([0x80, 0x82, 0x85, 0xFE, 0xFF, 5])])
            + bytes(4)
            + chance.randbytes(chance.randrange(9))
            for _ in range(4)
        )
        websocket.one_input(chance.randbytes(1) + frames)
        websocket.one_input(chance.randbytes(1) + upgrade() + frames)


def test_the_target_of_http_takes_any_input() -> None:
    chance = random.Random(1)
    goals = "/actions/fibonacci/goals"
    lines = [
        f"{method} {path} HTTP/1.{version}\r\n"
        for method in ("GET", "POST", "PUT", "DELETE", "OPTIONS", "HEAD")
        for path in ("/", "/actions", goals, f"{goals}?wait=0", f"{goals}/{'1' * 32}", "/%ff/../")
        for version in (0, 1)
    ]
    headers = [
        "Host: 127.0.0.1\r\n",
        "Host: a b\r\n",
        "Content-Type: application/json\r\n",
        "Accept: text/event-stream\r\n",
        "Content-Length: 11\r\n",
        "Content-Length: x\r\n",
        "Transfer-Encoding: chunked\r\n",
        "Expect: 100-continue\r\n",
        "Upgrade: websocket\r\n",
        "Origin: \xff\r\n",
        "Connection: close\r\n",
        "Last-Event-ID: 1.1\r\n",
    ]
    bodies = [b"", b'{"order":1}', b'{"order":NaN}', b"b\r\n" + b"[" * 11 + b"\r\n0\r\n\r\n"]
    web.one_input(b"")
    for _ in range(150):
        data = b""
        for _ in range(2):
            said = [chance.choice(lines), headers[0], *chance.sample(headers, 4), "\r\n"]
            data += "".join(said).encode("latin-1") + chance.choice(bodies)
        spot = chance.randrange(len(data))
        web.one_input(chance.randbytes(1) + data)
        web.one_input(chance.randbytes(1) + data[:spot] + chance.randbytes(1) + data[spot + 1 :])


def test_the_target_of_rosbridge_takes_any_input() -> None:
    chance = random.Random(1)
    ops = [
        "send_action_goal",
        "cancel_action_goal",
        "call_service",
        "fragment",
        "auth",
        "subscribe",
    ]
    names = ["fibonacci", "/fibonacci/_action/cancel_goal", "/rosapi/action_servers", "/x"]
    values: list[object] = [0, 1, -1, 2**64, 1.5, None, True, "", "a", [], {}, [[1]], float("nan")]

    def message() -> str:
        goal_info = {"goal_id": {"uuid": [1] * 16}, "stamp": chance.choice([{}, {"sec": 1}])}
        members = {
            "op": chance.choice([*ops, *ops, 5]),
            "id": chance.choice(["a", "b", 1, *values]),
            "action": chance.choice(names),
            "service": chance.choice(names),
            "args": chance.choice([{"order": 3}, {"goal_info": goal_info}, [1], *values]),
            "feedback": chance.choice([True, False, *values]),
            "fragment_size": chance.choice([1, 5000, *values]),
            "cancel_on_disconnect": True,
            "data": chance.choice(['{"op":"', 'auth"}', *values]),
            "num": chance.choice([0, 1, *values]),
            "total": chance.choice([1, 2, *values]),
            "mac": chance.choice(values),
            "type": chance.choice(values),
        }
        kept = chance.sample(sorted(members), chance.randrange(4, len(members)))
        return json.dumps({name: members[name] for name in ["op", *kept]})

    rosbridge.one_input(b"")
    rosbridge.one_input(b'{"op":"call_service","service":"/x"}\0' * 200)
    rosbridge.one_input(b"[" * 100_000)
    for _ in range(150):
        data = "\0".join(message() for _ in range(8)).encode()
        spot = chance.randrange(len(data))
        rosbridge.one_input(data)
        rosbridge.one_input(data[:spot] + chance.randbytes(1) + data[spot + 1 :])


def test_the_target_of_rtps_takes_any_input() -> None:
    chance = random.Random(1)
    packets = list(GOLDEN.values())
    rtps.one_input(b"")
    rtps.one_input(b"\1\0")
    for _ in range(30):
        changed = []
        for _ in range(6):
            packet = bytearray(chance.choice(packets))
            packet[chance.randrange(len(packet))] = chance.randrange(256)
            changed.append((chance.randrange(256), bytes(packet)))
        rtps.one_input(rtps.conversation(*changed))
