"""A fuzz target: the JSON of a hostile client of rosbridge.

    python -m tests.fuzz.rosbridge -max_total_time=600

The input is cut into messages at each zero byte, and goes through the real translator and a real
session to a real action server. Whatever it is, the connection ends, all that is answered is an
operation that clients of rosbridge know, and the log has no error, which would be a bug. Needs
atheris, which `make fuzz` installs.
"""

from __future__ import annotations

import json
from typing import Any

import anyio

from fibaction import ActionServer
from fibaction.wire.settings import Limits, WireSettings
from fibaction.wire.wire_server import open_server
from fibaction_transports.web.rosbridge.server.channel import RosbridgeGuest
from tests.fuzz.fuzzer import fuzz, run_without_errors
from tests.support.fibonacci import FIBONACCI, fibonacci

LIMITS = Limits(frame=2**14, queue=2**12)
KNOWN = {"action_feedback", "action_result", "service_response", "fragment", "publish"}


async def serve(data: bytes) -> None:
    texts = iter(data.decode(errors="replace").split("\0"))

    async def receive() -> dict[str, Any]:
        await anyio.lowlevel.checkpoint()
        for text in texts:
            return {"type": "websocket.receive", "text": text}
        return {"type": "websocket.disconnect", "code": 1001}

    async def send(message: Any) -> None:
        await anyio.lowlevel.checkpoint()
        if message["type"] == "websocket.send":
            assert json.loads(message["text"])["op"] in KNOWN
        else:
            assert len(message["reason"].encode()) <= 123

    settings = WireSettings(limits=LIMITS, grace=0, orphans="cancel")
    async with (
        ActionServer(FIBONACCI, fibonacci, max_goals=4) as server,
        open_server({"fibonacci": server}, settings) as wire,
    ):
        await RosbridgeGuest().serve_asgi(wire, receive, send, "the fuzzer", {})


def one_input(data: bytes) -> None:
    run_without_errors(serve, data)


def main() -> None:
    fuzz("rosbridge", one_input)


if __name__ == "__main__":
    main()
