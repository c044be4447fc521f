"""The sentence of each door of the library about an extra that is not installed.

A door is a URL, an import, a class or a verb of the command line. Each is tried in a process from
which the modules of extras are hidden.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

MODULES = {
    "a2a": ("a2a",),
    "cli": ("click", "rich", "yaml"),
    "mcap": ("mcap",),
    "mcp": ("mcp",),
    "metrics": ("prometheus_client",),
    "nats": ("cryptography",),
    "otel": ("opentelemetry",),
    "reload": ("watchfiles",),
    "ros-types": ("rosbags",),
    "tui": ("textual",),
    "web": ("h11", "wsproto"),
    "zenoh": ("xxhash", "zenoh"),
}
"""The modules that each extra brings."""

NO_DOOR = {
    "broker": "it brings a program and no module; test_brokers hides the program",
    "progress": "without tqdm and rich, `track` prints lines of text",
    "pydantic": "whoever has a model of pydantic has pydantic",
    "uvloop": "without it, the event loop is that of asyncio",
}

ALL = ("rclpy", *(name for names in MODULES.values() for name in names))
"""The modules that are hidden; rclpy is not brought by an extra."""

RCLPY = (
    "ros2:// needs rclpy, which this Python does not find: source the setup.bash of a ROS 2"
    " installation, or, to try it out on Linux, use the wheels of a third party"
)

WEB = [
    (f"transport_for('{scheme}://127.0.0.1:1')", f"{scheme}:// needs h11: {{web}}")
    for scheme in ("http", "https", "ws", "wss", "rosbridge", "rosbridges")
]
MCP = [
    (f"transport_for('{scheme}://127.0.0.1:1')", f"{scheme}:// needs mcp: {{mcp}}")
    for scheme in ("mcp+http", "mcp+https", "mcp+stdio")
]
A2A = [
    (f"transport_for('{scheme}://127.0.0.1:1')", f"{scheme}:// needs a2a: {{a2a}}")
    for scheme in ("a2a+http", "a2a+https")
]
IN_PYTHON = [
    ("transport_for('zenoh://')", "zenoh:// needs zenoh: {zenoh}"),
    *WEB,
    *MCP,
    *A2A,
    ("import_module('fibaction_transports.web')", "fibaction_transports.web needs h11: {web}"),
    (
        "import_module('fibaction_transports.web.rest.openapi')",
        "fibaction_transports.web needs h11: {web}",
    ),
    ("import_module('fibaction_transports.a2a')", "fibaction_transports.a2a needs a2a: {a2a}"),
    ("import_module('fibaction_transports.mcp')", "fibaction_transports.mcp needs mcp: {mcp}"),
    ("Tracing()", "Tracing needs opentelemetry: {otel}"),
    ("Metrics()", "Metrics needs prometheus_client: {metrics}"),
    ("export_mcap('a.jsonl', 'a.mcap')", "an MCAP file needs mcap: {mcap}"),
    (
        "NatsCredentials.read('robot.creds')",
        "a credentials file of NATS needs cryptography: {nats}",
    ),
    (
        "import_module('fibaction_transports.ros2.on_rclpy')",
        f"{RCLPY}: pip install 'ros-rclpy[fastrtps]'",
    ),
    (
        "load_action('Drive.action')",
        (
            "Drive.action:1: expected 'geometry_msgs/Pose' on the search path, found no"
            " geometry_msgs/msg/Pose.msg and no Pose.msg in {folder}; to get the messages of ROS's"
            " common packages: {ros-types}"
        ),
    ),
]
"""The calls, each with its error; `{web}` is the command that installs the extra."""

PAGES = [
    path
    for path in sorted((ROOT / "docs").rglob("*.md"))
    if path.name not in ("changelog.md", "index.md") and "reference" not in path.parts
]
USES = {
    "cli": r"^\$ fibaction ",
    "fastapi": r"^(from|import) fastapi\b",
    "pydantic": r"^(from|import) pydantic\b",
    "tqdm": r"^(from|import) tqdm\b",
    "web": r"^from fibaction_transports\.web\b",
    "metrics": r"^from fibaction\.metrics\b",
    "otel": r"^from fibaction\.otel\b",
    "a2a": r"^from fibaction_transports\.a2a\b",
    "mcp": r"^from fibaction_transports\.mcp\b",
}
"""The text of a page by which it needs an extra, or a library."""
NAMED = re.compile(r"(?:pip install|extras?) (.*)$", re.MULTILINE)
"""The installing of extras and of libraries, or the names of extras."""

PRELUDE = """
import json, sys
from importlib import import_module
from tests.support.hidden_modules import hide
hide(*json.loads(sys.argv[1]))
"""

CALLS = """
from fibaction.border.urls import transport_for
from fibaction.action_files import load_action
from fibaction.observe import export_mcap
from fibaction.observe import Metrics
from fibaction.observe import Tracing
from fibaction_transports.nats.broker.login import NatsCredentials
told = []
for call in json.loads(sys.argv[2]):
    try:
        eval(call)
    except Exception as exc:
        told.append(str(exc))
    else:
        told.append(f"{call} needs nothing")
print(json.dumps(told))
"""

IN_A_SHELL = [
    (("top",), "fibaction top needs textual: {tui}"),
    (("router",), "fibaction router needs zenoh: {zenoh}"),
    (("mcp", "tcp://127.0.0.1:1"), "fibaction mcp needs mcp: {mcp}"),
    (("console",), "http:// needs h11: {web}"),
    (("list", "-u", "http://127.0.0.1:1"), "http:// needs h11: {web}"),
    (("bridge", "tcp://127.0.0.1:1", "ws://127.0.0.1:1"), "ws:// needs h11: {web}"),
    (("serve", "robot:drive", "http://127.0.0.1:1"), "http:// needs h11: {web}"),
    (("serve", "robot:drive", "--reload"), "--reload needs watchfiles: {reload}"),
    (
        ("serve", "robot:drive", "tcp://127.0.0.1:0", "--metrics", ":0"),
        "--metrics needs prometheus_client: {metrics}",
    ),
    (("export", "robot.py", "robot.mcap"), "an MCAP file needs mcap: {mcap}"),
]
"""The words after `fibaction`, and the sentence on stderr."""

VERBS = """
from click.testing import CliRunner
from fibaction.cli.app import cli
told = []
for words in json.loads(sys.argv[2]):
    result = CliRunner().invoke(cli, words)
    told.append([result.exit_code, result.stderr])
print(json.dumps(told))
"""


def run(code: str, hidden: Sequence[str], tried: Sequence[object], folder: Path) -> str:
    """Run a program from which these modules are hidden, and return its output."""
    path = f"import sys; sys.path[:0] = [{str(ROOT)!r}, {str(ROOT / 'transports')!r}]"
    done = subprocess.run(
        [sys.executable, "-c", path + PRELUDE + code, json.dumps(hidden), json.dumps(tried)],
        capture_output=True,
        text=True,
        cwd=folder,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def expected(sentence: str, folder: Path) -> str:
    commands = {extra: f"pip install 'fibaction[{extra}]'" for extra in MODULES}
    return sentence.format(folder=folder, **commands)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the files that the doors are given."""
    (tmp_path / "robot.creds").write_text("SU" + "A" * 56)
    (tmp_path / "Drive.action").write_text("geometry_msgs/Pose pose\n---\n---\n")
    (tmp_path / "robot.py").write_text(
        "from fibaction import action\n\n\n"
        "@action('drive')\nasync def drive(meters: int) -> str:\n    return ''\n"
    )
    return tmp_path


def test_a_missing_extra_is_a_sentence_with_its_name_at_every_door_in_python(folder: Path) -> None:
    told = run(CALLS, ALL, [call for call, _ in IN_PYTHON], folder)
    assert json.loads(told) == [expected(sentence, folder) for _, sentence in IN_PYTHON]


def test_a_missing_extra_is_a_sentence_with_its_name_at_every_verb(folder: Path) -> None:
    hidden = [name for name in ALL if name not in MODULES["cli"]]
    told = run(VERBS, hidden, [words for words, _ in IN_A_SHELL], folder)
    assert json.loads(told) == [
        [2, f"Error: {expected(sentence, folder)}\n"] for _, sentence in IN_A_SHELL
    ]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_a_page_that_uses_an_extra_says_how_to_install_it(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    used = {extra for extra, use in USES.items() if re.search(use, page, re.MULTILINE)}
    named = {name for names in NAMED.findall(page) for name in re.split(r"[^a-z]+", names)}
    assert used <= named


def test_each_extra_has_a_door_here() -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        extras = tomllib.load(file)["project"]["optional-dependencies"]
    assert {*MODULES, *NO_DOOR} == {*extras}
    sentences = " ".join(sentence for _, sentence in (*IN_PYTHON, *IN_A_SHELL))
    without = [extra for extra in MODULES if f"{{{extra}}}" not in sentences]
    assert without == ["cli"]  # `test_app` of the command line has its sentence
