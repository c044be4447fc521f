"""The tests that belong to each module: of its own, or of the unit that it is part of."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

SOURCES = {"fibaction": "tests", "transports/fibaction_transports": "tests/transports"}
ELSEWHERE = "transports/fibaction_transports/ros2"  # needs ROS 2: `make test-ros`
NOT_ELSEWHERE = [f"{ELSEWHERE}/on_dds", f"{ELSEWHERE}/dds_transport.py"]  # needs none
UNITS = {
    "fibaction/_api": ["tests/test_api.py"],
    "fibaction/words/action_error.py": ["tests/words/test_errors.py"],
    "fibaction/_runtime/connection_counts.py": ["tests/observe/test_metrics.py"],
    "fibaction/words/current_goal.py": ["tests/observe/test_log_records.py"],
    "fibaction/types/base.py": [
        "tests/types/test_action.py",
        "tests/types/test_pydantic_codec.py",
    ],
    "fibaction/types/action.py": [
        "tests/types/test_action.py",
        "tests/types/test_ros_messages.py",
    ],
    "fibaction/types/encodings.py": [
        "tests/types/test_action.py",
        "tests/types/test_pydantic_codec.py",
        "tests/types/test_ros_messages.py",
    ],
    "fibaction/types/ros_classes.py": [
        "tests/types/test_action.py",
        "tests/types/test_ros_messages.py",
    ],
    "fibaction/client/client.py": ["tests/client/test_client.py", "tests/client/test_goal_step.py"],
    "fibaction/client/goal_span.py": ["tests/observe/test_otel.py"],
    "fibaction/client/goal_step.py": [
        "tests/client/test_goal_step.py",
        "tests/contract/test_children.py",
    ],
    "fibaction/observe/monitor_records.py": ["tests/observe/test_monitor.py"],
    "fibaction/client/feedback_reader.py": [
        "tests/client/test_client.py",
        "tests/client/test_attempts.py",
    ],
    "fibaction/client/goal.py": ["tests/client/test_client.py", "tests/client/test_attempts.py"],
    "fibaction/observe/followed_servers.py": ["tests/transports/mcp"],
    "fibaction/border/streams.py": ["tests/border/test_abc.py"],
    "fibaction/blocking": ["tests/blocking"],
    "fibaction/border": ["tests/border"],
    "fibaction/cli": ["tests/cli"],
    "fibaction/feeds": ["tests/feeds"],
    "transports/fibaction_transports/_command.py": ["tests/cli"],
    "fibaction/schema/shapes": ["tests/schema/shapes"],
    "fibaction/server": ["tests/server"],
    "fibaction/stores": ["tests/stores"],
    # The rules without I/O.
    "fibaction/server/registry/cancellation.py": ["tests/server/test_registry.py"],
    "fibaction/server/registry/expiry.py": ["tests/server/test_registry.py"],
    "fibaction/server/registry/goal_record.py": ["tests/server/test_registry.py"],
    "fibaction/server/registry/registry.py": ["tests/server/test_registry.py"],
    "fibaction/server/execution/fair_queue.py": ["tests/server/test_fair_queue.py"],
    "fibaction/server/scheduling/group.py": ["tests/server/test_scheduler.py"],
    "fibaction/server/scheduling/scheduler.py": ["tests/server/test_scheduler.py"],
    "fibaction/stores/_journal_file.py": ["tests/stores/test_journal_file.py"],
    "fibaction/server/durability/readable.py": [
        "tests/server/test_keeping.py",
        "tests/server/test_readable.py",
    ],
    "fibaction/stores/_log_mark.py": ["tests/stores/test_log_mark.py"],
    "fibaction/stores/_sqlite_journal.py": ["tests/stores/test_sqlite_store.py"],
    "fibaction/stores/_wal.py": ["tests/stores/test_journal_file.py"],
    "fibaction/stores/_writer.py": ["tests/stores/test_sqlite_store.py"],
    "fibaction/stores/journal_rows.py": ["tests/stores/test_journal_rows.py"],
    "fibaction/stores/sqlite_store.py": ["tests/stores/test_sqlite_store.py"],
    "fibaction/wire/codec.py": ["tests/wire/test_messages.py"],
    "fibaction/wire/messages": ["tests/wire/test_messages.py"],
    "fibaction/wire": ["tests/wire"],
    "fibaction/wire/settings.py": ["tests/wire", "tests/transports/tcp"],
    "fibaction/wire/tls_files.py": ["tests/transports/tcp"],
    "fibaction/wire/transport.py": ["tests/transports/tcp"],
    "transports/fibaction_transports/a2a": ["tests/transports/a2a"],
    "transports/fibaction_transports/cdr": ["tests/transports/cdr"],
    "transports/fibaction_transports/_agents": [
        "tests/transports/a2a",
        "tests/transports/mcp",
    ],
    "transports/fibaction_transports/mcp": ["tests/transports/mcp"],
    "transports/fibaction_transports/nats": ["tests/transports/nats"],
    "transports/fibaction_transports/_socket_lines": [
        "tests/transports/tcp",
        "tests/transports/web",
    ],
    "transports/fibaction_transports/ros2/dds_transport.py": ["tests/transports/ros2"],
    "transports/fibaction_transports/ros2/on_dds": ["tests/transports/ros2"],
    "transports/fibaction_transports/rtps": ["tests/transports/rtps"],
    "transports/fibaction_transports/tcp": ["tests/transports/tcp"],
    "transports/fibaction_transports/web": ["tests/transports/web"],
}
"""The tests that cover a module, or all modules of a folder together; the longest path counts.
Every other module, so each public one, is covered by a test file of its own."""


def tests_of(root: Path, module: Path) -> list[Path]:
    """Return the test files or folders that cover a module."""
    units = [unit for unit in UNITS if module.is_relative_to(root / unit)]
    if units:
        return [root / test for test in UNITS[max(units, key=len)]]
    source, tests = next(pair for pair in SOURCES.items() if module.is_relative_to(root / pair[0]))
    name = f"test_{module.stem.strip('_')}.py"
    return [root / tests / module.relative_to(root / source).with_name(name)]


def has_code(module: Path) -> bool:
    """Return whether a module has more than a docstring, and names of other modules."""
    return any(
        not isinstance(each, ast.Expr | ast.ImportFrom)
        and not (isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "__all__")
        for each in ast.parse(module.read_text()).body
    )


def modules(root: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Yield each module that has code of its own, and the tests that cover it."""
    for source in SOURCES:
        for module in sorted((root / source).rglob("*.py")):
            is_elsewhere = module.is_relative_to(root / ELSEWHERE)
            is_here = any(module.is_relative_to(root / one) for one in NOT_ELSEWHERE)
            if has_code(module) and (is_here or not is_elsewhere):
                yield module, tests_of(root, module)
