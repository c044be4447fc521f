"""The contract of all transports, over ROS 2, with fibaction at both ends.

The tests are those of `tests/contract`. What ROS 2 cannot keep is left out by `EXCLUSIONS`.
"""

from __future__ import annotations

import uuid
from importlib import import_module

import pytest

from tests.support.ros_contract import EXCLUSIONS, MODULES

pytest.register_assert_rewrite(*MODULES)

from tests.contract import conftest as contract  # noqa: E402  # rewritten first

pytestmark = pytest.mark.anyio
anyio_backend = contract.anyio_backend


def address() -> str:
    """Return a URL with a namespace of its own."""
    return f"ros2://?namespace=/t{uuid.uuid4().hex}"


WAYS = {
    "ros2": contract.Reach(contract.directly, address),
    "gateway to ros2": contract.Reach(contract.through_a_gateway, address),
}


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allow for a thousand goals, which take some 6 s, and several times that on a busy machine."""
    monkeypatch.setattr(contract, "PATIENCE", 45.0)


@pytest.fixture(params=list(WAYS))
def reach(request: pytest.FixtureRequest) -> contract.Reach:
    return WAYS[request.param]


for module in map(import_module, MODULES):
    globals().update(
        (name, test)
        for name, test in vars(module).items()
        if name.startswith("test_") and name not in EXCLUSIONS
    )
