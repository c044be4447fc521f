"""The tests that each transport passes: a module of tests imports `*`. See the package."""

from __future__ import annotations

from importlib import import_module

import pytest

from fibaction.testing.contract import TRANSPORTS

pytestmark = pytest.mark.anyio
__all__ = ["pytestmark"]

for _module in map(import_module, TRANSPORTS):
    for _name, _test in vars(_module).items():
        if _name.startswith("test_"):
            globals()[_name] = _test
            __all__ += [_name]
