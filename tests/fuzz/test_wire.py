"""The fuzz targets, without what they need."""

from __future__ import annotations

import random
from types import ModuleType

import pytest

from tests.fuzz import websocket, wire
from tests.transports.web.upgrade import upgrade


@pytest.mark.parametrize("target", [wire, websocket])
def test_without_atheris_it_says_what_to_type(
    target: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(target, "find_spec", lambda name: None)

    with pytest.raises(SystemExit, match="atheris is not installed: `make fuzz` installs it"):
        target.main()


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
