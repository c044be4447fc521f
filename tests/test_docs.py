"""The documentation: its examples run, and what it says of the code is true."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import io
import logging
import re
import sys
import tomllib
from collections.abc import Awaitable, Callable, Iterator
from contextlib import redirect_stdout
from importlib.metadata import entry_points
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, get_args
from xml.etree import ElementTree

import anyio
import msgspec
import pytest

import fibaction
import fibaction._runtime.notify
import fibaction.action_files
import fibaction.blocking
import fibaction.border.abc
import fibaction.observe
import fibaction.schema.payload
import fibaction.testing
import fibaction.wire
import fibaction.wire.channel
import fibaction.wire.transport
import fibaction_transports.inprocess
import fibaction_transports.mcp
import fibaction_transports.tcp
from fibaction import CancelCode, GoalStatus, connect, serve
from fibaction.border.urls import GROUP
from fibaction.server.life import LIFE
from fibaction.testing import ScriptedServer
from fibaction.wire import messages
from fibaction.wire.frames import MAX_FRAME
from fibaction.words.statuses import TRANSITIONS
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.golden import GOLDEN
from tests.support.pages import FENCED, NOT_RUN, Block
from tests.support.pages import blocks_of as blocks_of  # for the tests with ROS 2, too
from tests.support.ros_domain import own_domain
from tests.support.walks import file_of, terminal_of

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = [
    *sorted(ROOT.glob("*.md")),
    ROOT / "transports" / "README.md",
    *sorted(DOCS.rglob("*.md")),
]
LANGUAGES = {
    "cmake",
    "console",
    "html",
    "ini",
    "javascript",
    "json",
    "python",
    "text",
    "toml",
    "typescript",
    "xml",
}
WITH_ROS = "it needs ROS 2, and is run where that is"
"""Why a block is not run here: tests/ros2/test_docs_ros.py runs it."""

SHELLS_ELSEWHERE = {
    "CONTRIBUTING.md": "its commands are those that make the checks, this one among them",
    "docs/cli.md": "tests/cli runs each verb as a process, and looks at what it prints",
    "docs/comparisons.md": "measuring takes minutes; the tests compare the page with what came out",
    "docs/contributing.md": "as for CONTRIBUTING.md",
    "docs/shown_to_hold.md": "as for docs/comparisons.md",
}
"""Pages whose shell commands are not run by `tests.support.walks`, and who runs them."""


@pytest.fixture(scope="module", autouse=True)
def ros_domain() -> Iterator[None]:
    """Keep the nodes of pages apart from those of others."""
    with own_domain():
        yield


_LINK = re.compile(r"\]\((?P<target>[^)\s]+)\)")
_NAME = re.compile(r"`(fibaction(?:_transports)?(?:\.[A-Za-z_]\w*)+)`")
_DIRECTIVE = re.compile(r"^::: (\S+)$", re.MULTILINE)


def run_page(page: str, name: str, *, ros: bool = False) -> list[str]:
    """Run a page's Python blocks in order, and say where the page is wrong.

    A ```text block right after a Python block is what that prints; a block without one prints
    nothing. A block under `<!-- not run: reason -->` is left out; with `ros`, one that needs ROS 2
    is not. A file that the reader is to write is left to `tests.support.walks`.
    """
    blocks = blocks_of(page)
    module = ModuleType(f"page_{name}")
    sys.modules[module.__name__] = module  # where msgspec looks names up
    wrong: list[str] = []
    before = _loggers()
    try:
        for block, following in pairwise([*blocks, Block("", "", 0, "the end")]):
            marked = NOT_RUN.search(block.before)
            if marked is not None and len(marked["reason"].split()) < 3:
                wrong.append(f"{name}:{block.line}: no reason is given why it is not run")
            left_out = marked is not None and not (ros and marked["reason"] == WITH_ROS)
            if block.language != "python" or left_out or file_of(block):
                continue
            shown = ""
            if following.language == "text" and not following.before.strip():
                shown = following.code
            printed = _printed_by(block, module, name)
            if printed != shown:
                wrong.append(f"{name}:{block.line}: it prints\n{printed}and the page says\n{shown}")
        for test in _tests_in(module):
            anyio.run(test)
    finally:
        del sys.modules[module.__name__]
        for logger in _loggers():  # other tests have loggers of the same names
            level, handlers = before.get(logger, (logging.NOTSET, []))
            logger.setLevel(level)
            logger.handlers[:] = handlers
    return wrong


def _loggers() -> dict[logging.Logger, tuple[int, list[logging.Handler]]]:
    """Return the level and the handlers of each logger."""
    known = [logging.root, *logging.root.manager.loggerDict.values()]
    return {one: (one.level, one.handlers[:]) for one in known if isinstance(one, logging.Logger)}


def _printed_by(block: Block, module: ModuleType, name: str) -> str:
    # Empty lines in front, so that a traceback has the line numbers of the page.
    code = compile("\n" * block.line + block.code, name, "exec")
    output = io.StringIO()
    with redirect_stdout(output):
        exec(code, module.__dict__)
    return output.getvalue()


def _tests_in(module: ModuleType) -> Iterator[Callable[[], Awaitable[object]]]:
    for name, thing in vars(module).items():
        if name.startswith("test_") and inspect.iscoroutinefunction(thing):
            yield thing


def slugs_of(page: str) -> set[str]:
    """The anchors of a page's headings, as GitHub and the site both make them."""
    prose = FENCED.sub("", page)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
        for heading in re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    }


def load(path: Path) -> ModuleType:
    """A Python file that is in no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


sys.path.insert(0, str(DOCS))  # as Python does for a script that is run
build = load(DOCS / "build.py")
life_picture = load(DOCS / "life_picture.py")

every_page = pytest.mark.parametrize(
    "path", PAGES, ids=[str(path.relative_to(ROOT)) for path in PAGES]
)


# The examples


@every_page
def test_every_example_runs_and_prints_what_the_page_shows(path: Path) -> None:
    wrong = run_page(path.read_text(encoding="utf-8"), str(path.relative_to(ROOT)))

    assert not wrong, "\n".join(wrong)


@every_page
def test_every_fence_says_which_known_language_it_holds(path: Path) -> None:
    page = path.read_text(encoding="utf-8")

    # A fence with an indent or of another kind would be passed over by the runner of examples.
    assert len(blocks_of(page)) * 2 == len(re.findall(r"^\s*(?:```|~~~)", page, re.MULTILINE))
    assert {block.language for block in blocks_of(page)} <= LANGUAGES


@every_page
def test_every_shell_command_is_run_or_says_why_not(path: Path) -> None:
    name = str(path.relative_to(ROOT))
    unmarked = [
        f"{name}:{block.line}"
        for block in blocks_of(path.read_text(encoding="utf-8"))
        if block.language == "console" and not (terminal_of(block) or NOT_RUN.search(block.before))
    ]

    assert not unmarked or name in SHELLS_ELSEWHERE


PRINTS = "```python\nx = 1\n```\n\n```python\nprint(x)\n```\n"
NEEDS_ROS = f"<!-- not run: {WITH_ROS} -->\n```python\nprint(1)\n```\n\n```text\n2\n```\n"
WRONG = "```python\n1 / 0\n```\n"


@pytest.mark.parametrize(
    ("page", "wrong"),
    [
        (f"{PRINTS}```text\n1\n```\n", []),
        (f"{PRINTS}```text\n2\n```\n", ["page:5: it prints\n1\nand the page says\n2\n"]),
        (f"{PRINTS}It prints:\n```text\n1\n```\n", ["page:5: it prints\n1\nand the page says\n"]),
        (f"<!-- not run: it needs a robot -->\n{WRONG}", []),
        (f"<!-- not run:  -->\n{WRONG}", ["page:2: no reason is given why it is not run"]),
        (NEEDS_ROS, []),
    ],
)
def test_a_page_that_shows_something_else_than_its_examples_is_found(
    page: str, wrong: list[str]
) -> None:
    assert run_page(page, "page") == wrong


def test_an_example_that_needs_ros_is_run_where_that_is() -> None:
    assert len(run_page(NEEDS_ROS, "page", ros=True)) == 1


def test_an_error_in_an_example_is_not_swallowed() -> None:
    with pytest.raises(ZeroDivisionError):
        run_page("```python\n1 / 0\n```\n", "page")


def test_the_transport_that_the_guide_for_authors_shows_works() -> None:
    page = (ROOT / "transports" / "README.md").read_text(encoding="utf-8")
    shown: dict[str, Any] = {}
    for block in blocks_of(page):
        if block.language == "python":
            exec(block.code, shown)

    async def use() -> None:
        transport = shown["HouseTransport"]()
        server = ScriptedServer(FIBONACCI, [Feedback([1]), Feedback([2]), Result([3])])
        with anyio.fail_after(30):
            async with serve(server, transport), connect(transport, FIBONACCI) as client:
                async with client.send_goal(Goal(1)) as goal:
                    seen = [feedback async for feedback in goal.feedback]
                    assert seen == [Feedback([1]), Feedback([2])]
                    assert await goal.result() == Result([3])

    anyio.run(use)


def test_the_tests_that_a_page_shows_are_run() -> None:
    with pytest.raises(AssertionError):
        run_page("```python\nasync def test_it() -> None:\n    assert False\n```\n", "page")


# What is made from the code


@pytest.mark.parametrize("name", build.PICTURES)
def test_a_picture_is_the_one_that_its_table_makes(name: str) -> None:
    assert (DOCS / name).read_text(encoding="utf-8") == build.PICTURES[name]()


def test_the_picture_of_the_parts_has_every_transport() -> None:
    picture = ElementTree.parse(DOCS / "architecture.svg")

    texts = " ".join(picture.getroot().itertext())
    assert {entry.name for entry in entry_points(group=GROUP)} == set(
        re.findall(r"([\w+]+)://", texts)
    )


def test_the_picture_of_a_life_has_an_arrow_for_every_event_that_changes_the_phase() -> None:
    drawn = [
        (phase, arrow.event, arrow.target)
        for arrow in life_picture.arrows()
        for phase in arrow.sources
    ]

    assert sorted(drawn) == sorted(
        (phase, event, step.phase)
        for (phase, event), step in LIFE.items()
        if step.phase is not phase
    )


def test_the_picture_has_an_arrow_for_every_transition() -> None:
    labels = re.findall(r'class="event"[^>]*>(\w+)<', build.diagram())

    assert sorted(labels) == sorted(event.name for _, event in TRANSITIONS)


@pytest.mark.parametrize("name", build.PARTS)
def test_the_generated_parts_of_a_page_are_as_the_code_makes_them(name: str) -> None:
    page = (DOCS / name).read_text(encoding="utf-8")

    assert build.with_parts(page, build.PARTS[name]) == page


# The protocol

MESSAGES = sorted(
    {*get_args(messages.FromClient), *get_args(messages.FromServer)},
    key=lambda kind: kind.__struct_config__.tag,
)


def section_of(kind: type) -> str:
    """What the page on the protocol says of a message."""
    page = (DOCS / "protocol.md").read_text(encoding="utf-8")
    _, found, section = page.partition(f"\n#### {kind.__name__}\n")
    assert found, f"{kind.__name__} is not on the page"
    return re.split(r"^(?:#+ |<!-- end)", section, maxsplit=1, flags=re.MULTILINE)[0]


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
def test_the_protocol_page_says_what_each_message_consists_of(kind: type[msgspec.Struct]) -> None:
    section = section_of(kind)

    tag, *fields = kind.__struct_config__.tag, *kind.__struct_fields__
    assert f"`[{', '.join((str(tag), *fields))}]`" in section
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \| ([^|]*)\| ([^|]+) \|$", section, re.MULTILINE)
    assert [name for name, *_ in rows] == fields


@pytest.mark.parametrize(("message", "digits"), GOLDEN, ids=lambda one: type(one).__name__)
def test_the_protocol_page_has_the_bytes_that_are_pinned(
    message: msgspec.Struct, digits: str
) -> None:
    assert f"\n{digits}\n" in section_of(type(message))


def test_every_message_has_bytes_that_are_pinned() -> None:
    assert {type(message) for message, _ in GOLDEN} == set(MESSAGES)


@pytest.mark.parametrize(
    ("heading", "numbers"),
    [
        ("Statuses", {status.value: status.name for status in GoalStatus}),
        ("Return codes", {code.value: code.name for code in CancelCode}),
        (
            "Why",
            {number: name for name, number in vars(messages.Why).items() if name.isupper()},
        ),
    ],
)
def test_the_protocol_page_has_every_number(heading: str, numbers: dict[int, str]) -> None:
    page = (DOCS / "protocol.md").read_text(encoding="utf-8")
    section = page.partition(f"\n### {heading}\n")[2].partition("\n#")[0]

    rows = re.findall(r"^\| (\d+) \| (\w+)", section, re.MULTILINE)
    assert {int(number): name for number, name in rows} == numbers


def test_the_protocol_page_says_the_version_and_the_longest_frame() -> None:
    page = (DOCS / "protocol.md").read_text(encoding="utf-8")

    assert f", version {messages.VERSION}.\n" in page
    assert f"\nA side that does not send this field accepts {MAX_FRAME // 2**20} MiB.\n" in page


# What the pages speak of


def public_names(module: ModuleType) -> set[str]:
    """The names that a module offers: `__all__`, or else what it defines without an underscore."""
    names = set(getattr(module, "__all__", ()))
    if not names:
        for node in ast.parse(inspect.getsource(module)).body:
            match node:
                case (
                    ast.ClassDef(name=name)
                    | ast.FunctionDef(name=name)
                    | ast.AsyncFunctionDef(name=name)
                    | ast.AnnAssign(target=ast.Name(id=name))
                ):
                    names.add(name)
                case _:
                    pass
    return {name for name in names if not name.startswith("_")}


def needs_ros(dotted: str) -> bool:
    """Whether it can be imported only where ROS 2 is; tests/ros2/test_docs_ros.py looks there."""
    return dotted.startswith("fibaction_transports.ros2")


def resolve(dotted: str) -> object:
    """The object of that name, whose first parts are modules."""
    first, *parts = dotted.split(".")
    found: object = importlib.import_module(first)
    path = first
    for part in parts:
        path += f".{part}"
        found = getattr(found, part) if hasattr(found, part) else importlib.import_module(path)
    return found


@pytest.mark.parametrize(
    ("module", "known"),
    [
        (fibaction, "connect"),
        (fibaction.action_files, "load_action"),
        (fibaction.blocking, "BlockingGoal"),
        (fibaction.schema.payload, "JsonCodec"),
        (fibaction.observe, "Metrics"),
        (fibaction.border.abc, "GoalStream"),
        (fibaction.testing, "Step"),
        (fibaction._runtime.notify, "Notifier"),
        (fibaction.wire, "Permission"),
        (fibaction.wire.transport, "WireTransport"),
        (fibaction.wire.channel, "Channel"),
        (fibaction_transports.inprocess, "InProcessTransport"),
        (fibaction_transports.mcp, "McpBridge"),
        (fibaction_transports.tcp, "TcpTransport"),
    ],
)
def test_every_public_name_is_in_the_reference(module: ModuleType, known: str) -> None:
    pages = [path.read_text(encoding="utf-8") for path in (DOCS / "reference").iterdir()]
    directives = [name for page in pages for name in _DIRECTIVE.findall(page)]
    documented = [resolve(name) for name in directives if not needs_ros(name)]
    names = public_names(module)

    missing = {
        name for name in names if not any(getattr(module, name) is thing for thing in documented)
    }

    assert known in names
    assert missing == set()


@every_page
def test_every_dotted_name_in_the_prose_exists(path: Path) -> None:
    for dotted in _NAME.findall(FENCED.sub("", path.read_text(encoding="utf-8"))):
        # GROUP is the one name of this form that is not Python's.
        if dotted != GROUP and not needs_ros(dotted):
            resolve(dotted)


# Links: those within the site are checked again on the built pages, by docs/build.py


@every_page
def test_every_link_leads_to_a_file_and_a_heading(path: Path) -> None:
    prose = FENCED.sub("", path.read_text(encoding="utf-8"))
    assert "]()" not in prose
    for target in _LINK.findall(prose):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        file = path.parent / name if name else path
        assert file.is_file(), f"{target} leads to no file"
        if anchor and not anchor.startswith("fibaction"):
            assert anchor in slugs_of(file.read_text(encoding="utf-8")), f"{target} has no place"


def pages_in(nav: Any) -> Iterator[str]:
    """The files that a navigation leads to."""
    match nav:
        case str(page):
            yield page
        case dict() as titled:
            yield from pages_in(list(titled.values()))
        case list() as several:
            for one in several:
                yield from pages_in(one)


def test_the_navigation_leads_to_every_page() -> None:
    settings = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))

    found = sorted(pages_in(settings["project"]["nav"]))
    assert found == sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))
    assert len(found) <= 50, "a reader finds nothing among more: join the page with another"


def test_a_search_does_not_find_the_pages_about_the_project() -> None:
    settings = tomllib.loads((ROOT / "zensical.toml").read_text(encoding="utf-8"))
    (project,) = (part["Project"] for part in settings["project"]["nav"] if "Project" in part)

    found = {
        page
        for page in pages_in(project)
        if not (DOCS / page).read_text("utf-8").startswith("---\nsearch:\n  exclude: true\n---\n")
    }
    assert not found


def test_the_page_of_tasks_leads_to_every_page_about_one() -> None:
    page = (DOCS / "howto" / "index.md").read_text(encoding="utf-8")

    named = {target.partition("#")[0] for target in _LINK.findall(page)}
    assert {path.name for path in (DOCS / "howto").glob("*.md")} - {"index.md"} <= named


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "index.html").write_text('<h1 id="top">Folder</h1>', encoding="utf-8")
    (tmp_path / "picture.svg").write_text("<svg/>", encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(
    "tag",
    [
        '<a href="folder/index.html#top">',
        '<a href="/folder/#top">',
        '<a href="#here">',
        '<a href="https://example.org/">',
        '<img src="picture.svg">',
        '<img src="data:image/png;base64,AAAA">',
        "<a>",
        "<input disabled>",
    ],
)
def test_a_link_that_leads_somewhere_is_no_problem(site: Path, tag: str) -> None:
    (site / "index.html").write_text(f'<p id="here">{tag}', encoding="utf-8")

    assert build.problems(site) == []


@pytest.mark.parametrize(
    ("tag", "problem"),
    [
        ('<a href="nobody.html">', "index.html:2: 'nobody.html' leads to no file"),
        ('<img src="nothing.svg">', "index.html:2: 'nothing.svg' leads to no file"),
        ('<a href="#nowhere">', "index.html:2: '#nowhere' leads to no place in index.html"),
        (
            '<a href="folder/index.html#x">',
            "index.html:2: 'folder/index.html#x' leads to no place in folder/index.html",
        ),
        (
            '<script src="https://example.org/x.js">',
            "index.html:2: 'https://example.org/x.js' is loaded from elsewhere",
        ),
        (
            '<link href="//example.org/x.css">',
            "index.html:2: '//example.org/x.css' is loaded from elsewhere",
        ),
    ],
)
def test_a_link_that_leads_nowhere_is_named_with_its_place(
    site: Path, tag: str, problem: str
) -> None:
    (site / "index.html").write_text(f"<p>\n{tag}", encoding="utf-8")

    assert build.problems(site) == [problem]
