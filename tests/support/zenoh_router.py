"""A router of Zenoh, which the library of Zenoh can be, on this machine only."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from tests.support.ports import free_port


def start_router(port: int, *others: int, **more: object) -> zenoh.Session:
    """Start a router, until it is closed; it connects to other routers, by their ports."""
    config = zenoh.Config()
    for key, value in {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "connect/endpoints": [f"tcp/127.0.0.1:{one}" for one in others],
        "scouting/multicast/enabled": False,
        **more,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def own_router() -> Iterator[int]:
    """Run a router, which all sessions connect to that do not name another one; gives its port."""
    port = free_port()
    router = start_router(port)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("ZENOH_SESSION_CONFIG_URI", raising=False)
        patch.setenv(
            "ZENOH_CONFIG_OVERRIDE",
            f'connect/endpoints=["tcp/127.0.0.1:{port}"];listen/endpoints=["tcp/127.0.0.1:0"]',
        )
        try:
            yield port
        finally:
            router.close()
