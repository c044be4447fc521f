"""The environment of the tests of `dds://` and `zenoh://`: a domain and a router of their own, on
this machine only.
"""

from __future__ import annotations

import os
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from fibaction.interfaces import files
from tests.support.ros_domain import own_domain

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
CONTRACTS = {
    Path(__file__).with_name(f"test_{name}.py"): scheme
    for name, scheme in (("contract", "dds"), ("zenoh_contract", "zenoh"))
}
"""The modules with the contract, and the middleware of each."""
FOLDERS = (ROOT / "examples/ros2", ROOT / "tests/ros2")


@pytest.fixture(autouse=True, scope="package")
def domain() -> Iterator[None]:
    """Take a domain that no other test run has, and the interface files of this project."""
    with own_domain() as patch:
        patch.setenv("FIBACTION_SEARCH", os.pathsep.join(map(str, FOLDERS)))
        patch.delenv("AMENT_PREFIX_PATH", raising=False)
        yield


@pytest.fixture(scope="package")
def router() -> Iterator[int]:
    """Run a router of Zenoh for the tests that use it; gives its port."""
    from tests.support.zenoh_router import own_router  # not where rclpy is tested

    with own_router() as port:
        yield port


@pytest.fixture(autouse=True)
def no_loaded_types(monkeypatch: pytest.MonkeyPatch) -> None:
    """Know no types that other tests of the process have loaded, such as those of pages, nor those
    in the folder from which other tests import first.
    """
    monkeypatch.setattr(files, "_KNOWN", {})
    monkeypatch.setattr(files, "_TEXTS", {})
    monkeypatch.setattr(sys, "path", ["", *sys.path])  # as for `python -m`


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let tests with a router have a second try, and run the contract over each way in turn: each
    test on asyncio, and every fourth on trio and through a gateway.
    """
    for item in items:
        if "router" in getattr(item, "fixturenames", ()) and item.path.parent == HERE:
            item.add_marker("processes")  # a router is a broker, which other tests load, too
    if os.environ.get("FIBACTION_CONTRACT") == "whole" or any("::" in one for one in config.args):
        return
    left_out = {item for item in items if not _is_due(item)}
    items[:] = [item for item in items if item not in left_out]
    config.hook.pytest_deselected(items=[*left_out])


def _is_due(item: pytest.Item) -> bool:
    call = getattr(item, "callspec", None)
    if call is None or item.path not in CONTRACTS:
        return True
    scheme = CONTRACTS[item.path]
    way = call.params["anyio_backend"], call.params["reach"]
    gateway = f"gateway to {scheme}"
    ways = [("asyncio", gateway), ("trio", scheme), ("trio", gateway)]
    name = item.name.partition("[")[0]
    return way not in ways or zlib.crc32(name.encode()) % 4 == ways.index(way)
