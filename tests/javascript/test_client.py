"""The client for JavaScript: its tests run in Node, and its size and its types are checked."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import subprocess
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fibaction.action_files import load_action
from fibaction.schema.typescript import typescript_source
from tests.support.fibonacci import FIBONACCI
from tests.support.golden import GOLDEN
from tests.support.node import IS_LEFT_OUT, MISSING, MODULES, PROGRAM
from tests.support.progress_cases import CASES

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CLIENT = Path(str(files("fibaction_transports.web"))) / "javascript"
CONSOLE = CLIENT.parent / "console"
MOST_BYTES = 6_650
"""README.md says 6 kB, of 1,024 bytes each; what it is rounded from includes all that keeps a page
alive."""
PATIENCE = 110.0
PICK_UP = load_action(ROOT / "tests/action_files/robot_msgs/action/PickUp.action")
needs_node = pytest.mark.skipif(IS_LEFT_OUT, reason=MISSING)


def as_json(value: Any) -> Any:
    """Return a value as JSON that says of which type it is, where JSON has no such type."""
    if isinstance(value, bytes):
        return {"hex": value.hex()}
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 2**53 - 1:
        return {"bigint": str(value)}
    if isinstance(value, list):
        return [as_json(item) for item in value]
    if isinstance(value, dict):
        return {"pairs": [[as_json(key), as_json(item)] for key, item in value.items()]}
    return value


def cases() -> list[tuple[str, Any]]:
    """Return bytes of msgpack and their values: all messages, and each form of each type."""
    values: list[Any] = [None, True, False, 0.5, -1e300, "", "ä€𝄞", b"", [], {}, {"__proto__": 1}]
    for bits in (5, 7, 8, 15, 16, 31, 32, 53, 63):
        edges = (2**bits - 1, 2**bits, -(2**bits), -(2**bits) - 1)
        values += [edge for edge in edges if -(2**63) <= edge < 2**64]
    values.append(2**64 - 1)
    for length in (15, 16, 31, 32, 255, 256, 65535, 65536):
        values += ["a" * length, b"\xff" * length, [None] * length]
        values.append({f"{number}": number for number in range(length)})
    values += [{1: "one", -1: "minus one"}, {"deep": [{"deeper": [1, {"list": [[]]}]}]}]
    encoded = [msgspec.msgpack.encode(value).hex() for value in values]
    messages = [hexadecimal for _, hexadecimal in GOLDEN]
    return [
        (hexadecimal, as_json(msgspec.msgpack.decode(bytes.fromhex(hexadecimal), strict=False)))
        for hexadecimal in encoded + messages
    ]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the client, the modules of the console, their tests and their libraries."""
    client = [CLIENT / name for name in ("fibaction.js", "fibaction.d.ts", "package.json")]
    for file in (*client, *CONSOLE.glob("*.js"), *HERE.glob("*.*ts"), *HERE.glob("*.mjs")):
        shutil.copy(file, tmp_path)
    (tmp_path / "node_modules").symlink_to(MODULES)
    return tmp_path


def run(folder: Path, *command: str) -> str:
    """Run a program of Node, which must succeed, and return what it prints."""
    assert PROGRAM is not None, MISSING
    assert not MISSING, MISSING
    env = os.environ | {"FIBACTION_PYTHON": sys.executable, "FIBACTION_ROOT": str(ROOT)}
    with subprocess.Popen(
        [PROGRAM, *command],
        cwd=folder,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            out, _ = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert process.returncode == 0, out
    return out


@needs_node
@pytest.mark.timeout(120)
@pytest.mark.parametrize("name", sorted(path.name for path in HERE.glob("*.test.mjs")))
def test_in_node(name: str, folder: Path) -> None:
    (folder / "cases.json").write_text(json.dumps(cases()))
    (folder / "progress.json").write_text(json.dumps(CASES))
    run(folder, "--test", "--test-timeout=100000", name)


@needs_node
def test_the_types_describe_the_client(folder: Path) -> None:
    (folder / "tsconfig.json").write_text((HERE / "tsconfig.json").read_text())
    run(folder, "node_modules/typescript/bin/tsc", "--noEmit", "-p", ".")


@needs_node
def test_a_program_is_checked_by_the_types_that_are_written_for_it(folder: Path) -> None:
    (folder / "tsconfig.json").write_text((HERE / "tsconfig.json").read_text())
    (folder / "robot_types.ts").write_text(typescript_source([PICK_UP.info, FIBONACCI.info]))
    shutil.copy(HERE / "typed/program.ts", folder)
    run(folder, "node_modules/typescript/bin/tsc", "--noEmit", "-p", ".")


def test_the_client_is_small() -> None:
    source = (CLIENT / "fibaction.js").read_bytes()
    assert len(gzip.compress(source, 9, mtime=0)) <= MOST_BYTES


def test_the_package_has_the_version_of_the_project() -> None:
    package = json.loads((CLIENT / "package.json").read_text(encoding="utf-8"))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f'version = "{package["version"]}"' in project
    assert all((CLIENT / name).is_file() for name in package["files"])
