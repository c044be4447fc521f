"""The tests that cover each module: those of its unit, and those of whole servers and clients."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

SOURCES = {"fibaction": "tests", "transports/fibaction_transports": "tests/transports"}
ELSEWHERE = "transports/fibaction_transports/ros2"  # needs ROS 2: `make test-ros`
NO_ROS = (
    "messaging",
    "on_dds",
    "on_zenoh",
    "without_ros",
    "dds_transport.py",
    "zenoh_transport.py",
)
NOT_ELSEWHERE = [f"{ELSEWHERE}/{one}" for one in NO_ROS]
CONTRACT = "fibaction/testing/contract"
"""The folder of tests that are installed with the product, for others to run."""
SHARED = ("tests/contract", "tests/simulation", "tests/fleet_simulation")
"""The tests of whole servers and clients, which cover every module."""
ALSO = {
    "fibaction/_api": ["tests/test_api.py"],
    "fibaction/_runtime": ["tests/observe", "tests/server"],
    "fibaction/action_files.py": ["tests/interfaces"],
    "fibaction/border": [
        "tests/transports/test_inprocess.py",
        "tests/transports/tcp",
        "tests/wire",
    ],
    "fibaction/client": ["tests/observe"],
    "fibaction/observe": ["tests/transports/mcp"],
    "fibaction/types": ["tests/interfaces"],
    "fibaction/wire": ["tests/transports/tcp"],
    "fibaction/words": ["tests/observe"],
    "transports/fibaction_transports/_agents": ["tests/transports/a2a", "tests/transports/mcp"],
    "transports/fibaction_transports/_command.py": ["tests/cli"],
    "transports/fibaction_transports/_http": ["tests/transports/web", "tests/transports/a2a"],
    "transports/fibaction_transports/_socket_lines": [
        "tests/transports/a2a",
        "tests/transports/tcp",
        "tests/transports/web",
    ],
    "transports/fibaction_transports/tcp.py": ["tests/transports/tcp"],
    "transports/fibaction_transports/keywords.py": ["tests/transports/test_setting_keywords.py"],
    "transports/fibaction_transports/rtps": ["tests/transports/ros2"],
}
"""Other tests of the modules of a folder."""


def tests_of(root: Path, module: Path) -> list[Path]:
    """Return the test files and folders of a module's unit.

    The tests of a package are in a folder of its name, `tests/wire` for `fibaction/wire`, and those
    of a module in a file, `tests/test_main.py` for `fibaction/__main__.py`.
    """
    source, tests = next(pair for pair in SOURCES.items() if module.is_relative_to(root / pair[0]))
    first, *inner = module.relative_to(root / source).parts
    own = root / tests / (first if inner else f"test_{module.stem.strip('_')}.py")
    also = [root / test for one in ALSO if module.is_relative_to(root / one) for test in ALSO[one]]
    return [test for test in [own] if test.exists() or not also] + also


def has_code(module: Path) -> bool:
    """Return whether a module has more than a docstring, and names of other modules."""
    return any(
        not isinstance(each, ast.Expr | ast.ImportFrom)
        and not (isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "__all__")
        for each in ast.parse(module.read_text()).body
    )


def modules(root: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Yield each module that has code of its own, and the tests of its unit."""
    for source in SOURCES:
        for module in sorted((root / source).rglob("*.py")):
            is_elsewhere = module.is_relative_to(root / ELSEWHERE)
            is_here = any(module.is_relative_to(root / one) for one in NOT_ELSEWHERE)
            is_test = module.is_relative_to(root / CONTRACT)
            if not is_test and has_code(module) and (is_here or not is_elsewhere):
                yield module, tests_of(root, module)


def shared(root: Path) -> list[Path]:
    """Return the folders of the tests that cover every module, as far as they exist."""
    return [root / folder for folder in SHARED if (root / folder).exists()]
