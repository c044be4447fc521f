"""Where `make test-wheel` put what it built. Without that there is nothing to look into."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

collect_ignore_glob = [] if "FIBACTION_BUILT" in os.environ else ["test_*.py"]


@pytest.fixture(scope="session")
def wheel() -> Path:
    """The wheel that is to be published: the one made of the sdist."""
    (found,) = ROOT.glob("dist/*.whl")
    return found


@pytest.fixture(scope="session")
def sdist() -> Path:
    (found,) = ROOT.glob("dist/*.tar.gz")
    return found


@pytest.fixture(scope="session")
def consumer() -> Path:
    """The programs of an environment with the wheel, what it requires, and nothing else."""
    return ROOT / "build" / "consumer" / "bin"
