"""The fuzz targets, without the fuzzer: each kept input, and random changes of it."""

from __future__ import annotations

import random
from types import ModuleType

import pytest

from tests.fuzz import fuzzer, rosbridge, rtps, web, websocket, wire


@pytest.mark.parametrize("target", [wire, websocket, web, rosbridge, rtps])
def test_without_atheris_it_says_what_to_type(
    target: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzzer, "find_spec", lambda name: None)

    with pytest.raises(SystemExit, match="atheris is not installed: `make fuzz` installs it"):
        target.main()


def test_the_fuzzer_begins_with_the_kept_inputs_and_writes_elsewhere() -> None:
    command = fuzzer.command("wire", ["-max_total_time=30"])
    assert command[2:4] == ["build/fuzz/wire", "tests/fuzz/corpus/wire"]
    assert command[4:] == ["-artifact_prefix=build/fuzz/wire/"]


@pytest.mark.parametrize("target", [wire, websocket, web, rosbridge, rtps])
def test_each_kept_input_is_taken_again_as_it_is_and_with_another_byte(target: ModuleType) -> None:
    kept = fuzzer.kept(target.__name__.rpartition(".")[2])
    assert 10 <= len(kept) <= 100
    assert sum(path.stat().st_size for path in kept) <= 200_000
    chance = random.Random(1)
    target.one_input(b"")
    for path in kept:
        data = path.read_bytes()
        target.one_input(data)
        for _ in range(3):
            spot = chance.randrange(len(data) + 1)
            target.one_input(data[:spot] + chance.randbytes(1) + data[spot + 1 :])
