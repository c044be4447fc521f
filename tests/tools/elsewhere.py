"""The tests that are not run again with the wheel, another Python or the lowest versions.

What differs between versions of Python is its event loop, its sockets, TLS, SQLite, typing and
tracebacks; between those of libraries, what they are called with. So each part that uses one of
these is tested with it, and what would be the same again is left to `make test`. With
FIBACTION_ELSEWHERE in the environment, `tests/conftest.py` registers this as a plugin of pytest. A
file that the command line names is run.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
LEFT_OUT = {
    "trials, attacks and floods, browsers and Node, which load what is tested already": (
        "browser fleet fleet_simulation fuzz hostile javascript kills simulation soak"
        " cli/test_console.py cli/test_hostile.py"
        " transports/cdr/test_hostile.py transports/mcp/test_page.py"
    ),
    "rules without I/O": (
        "interfaces/test_parser.py schema/test_check.py"
        " schema/test_keywords.py schema/test_steps.py server/test_turns.py"
        " server/test_registry.py server/test_scheduler.py transports/cdr/test_codec.py"
        " transports/cdr/test_type_hashes.py words/test_goals.py words/test_statuses.py"
        " transports/rtps"
    ),
    "programs of others, which get the same bytes": (
        "transports/cyclone transports/web/rosbridge/test_libraries.py"
    ),
    "verbs that put together what is tested by itself": (
        "cli/test_bridge.py cli/test_fleet_commands.py cli/test_recording_verbs.py"
        " transports/test_forged_lines.py"
    ),
    "a system that is not Unix, which Linux plays by taking modules away": "test_without_unix.py",
    "pages, pictures, examples, the tests' own support, and the project itself": (
        "packaging support tools cli/test_pictures.py test_answers.py test_contributing.py"
        " test_docs.py test_examples.py test_guarantees.py"
        " test_notebook_page.py test_project.py test_stories.py test_structure.py test_style.py"
        " test_trials.py test_way_of_a_goal.py transports/test_setting_keywords.py"
        " transports/web/test_assets.py transports/web/test_openapi.py"
    ),
}
"""The files and folders, by the reasons."""

KEPT = ("transports/rtps/test_network.py",)
"""Files in these folders that use sockets."""

WAYS = re.compile(r"\btrio(?!-tcp)|asyncio-(gateway|unix|wss|asgi)|[\[-]virtual")
"""The ways of tests that combine parts which have tests of their own, and virtual time."""

OF_THE_CONTRACT = re.compile(r"contract.*(asyncio-(tls|ws)|store\])")
"""More ways of the contract, which is run in one process, over TCP, HTTP and NATS only."""


class Elsewhere:
    """Leaves these tests out."""

    def __init__(self, config: pytest.Config) -> None:
        self._named = {
            (config.invocation_params.dir / each.partition("::")[0]).resolve()
            for each in config.args
        }
        self._left_out = {TESTS / name for names in LEFT_OUT.values() for name in names.split()}
        self._kept = {TESTS / name for name in KEPT}

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """Leave a file out, unless it is named, and a folder that has no such file."""
        is_left_out = not self._left_out.isdisjoint((collection_path, *collection_path.parents))
        is_needed = any(one.is_relative_to(collection_path) for one in self._kept | self._named)
        return True if is_left_out and not is_needed else None

    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        """Leave single tests out."""
        left_out = {item for item in items if self._is_left_out(item)}
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=[*left_out])

    def _is_left_out(self, item: pytest.Item) -> bool:
        if WAYS.search(item.nodeid):
            return True
        return item.path not in self._named and (
            OF_THE_CONTRACT.search(item.nodeid) is not None
            or item.get_closest_marker("load") is not None
        )
