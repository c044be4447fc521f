"""The tests of the contract over a transport of ROS 2, with fibaction at both ends.

What ROS 2 cannot keep is left out by `EXCLUSIONS`. A module of tests takes all names of
`contract_over`.
"""

from __future__ import annotations

import uuid
from importlib import import_module
from typing import Any

import pytest

from fibaction.testing.contract.reach import Reach, directly, through_a_gateway
from tests.contract.conftest import anyio_backend
from tests.support.executors import Form, as_generator
from tests.support.ros_contract import EXCLUSIONS, MODULES

PATIENCE = 45.0
"""Seconds for a thousand goals, which take some 6 s, and several times that on a busy machine."""


def contract_over(scheme: str, more: str = "") -> dict[str, Any]:
    """Return the tests and their fixtures, by the names that a module has them under. `more` is
    what the URL of a server has at its end, and that of a client has not.
    """

    def address() -> str:
        """Return a URL with a namespace of its own."""
        return f"{scheme}://?namespace=/t{uuid.uuid4().hex}{more}"

    ways = {
        scheme: Reach(directly, address, patience=PATIENCE),
        f"gateway to {scheme}": Reach(through_a_gateway, address, patience=PATIENCE),
    }

    @pytest.fixture(params=list(ways))
    def reach(request: pytest.FixtureRequest) -> Reach:
        return ways[request.param]

    tests = {
        name: test
        for module in map(import_module, MODULES)
        for name, test in vars(module).items()
        if name.startswith("test_") and name not in EXCLUSIONS
    }
    return {
        "pytestmark": pytest.mark.anyio,
        "anyio_backend": anyio_backend,
        "form": form,
        "reach": reach,
        **tests,
    }


@pytest.fixture
def form() -> Form:
    """Return the form of the executors: no way can tell it behind the server."""
    return as_generator
