"""Pages for questions: their messages are those of the code, and what people type finds them."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
TROUBLES = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
MESSAGES = re.findall(r"^### `(.+)`$", TROUBLES, re.MULTILINE)
ANSWERS = {
    "authentication": ["howto/secure.md"],
    "blocking": ["howto/blocking.md"],
    "cancel a goal": ["howto/embed.md"],
    "database connection": ["howto/resources.md"],
    "dependency injection": ["howto/resources.md"],
    "django": ["howto/blocking.md"],
    "humble": ["troubleshooting.md"],
    "jupyter": ["howto/blocking.md"],
    "lifespan": ["howto/resources.md"],
    "limit the goals": ["howto/schedule.md"],
    "methods": ["howto/resources.md"],
    "metrics": ["howto/observe.md"],
    "multiprocessing": ["howto/progress.md"],
    "no feedback": ["troubleshooting.md"],
    "opentelemetry": ["howto/observe.md"],
    "preempt": ["howto/schedule.md"],
    "priority": ["howto/schedule.md"],
    "progress bar": ["howto/progress.md"],
    "pydantic": ["howto/types.md"],
    "restart": ["howto/reconnecting.md"],
    "retry": ["howto/reconnecting.md"],
    "same type": ["howto/generators.md"],
    "serial port": ["howto/progress.md"],
    "several machines": ["howto/fleet.md"],
    "transport": ["howto/write_a_transport.md"],
    "websocket": ["howto/in_a_web_application.md"],
}
"""Words that people type, and the pages that answer them."""
TASKS = {
    "function": "tutorial.md#serve-the-function-and-call-it",
    "cancel": "tutorial.md#async-with-cancels-await-does-not",
    "progress bar": "howto/progress.md#file-copy-with-a-progress-bar",
    "concurrency": "howto/schedule.md#queue-limit-concurrency-preempt",
    "crash": "howto/survive_a_crash.md#survive-a-crash",
    "token": "howto/secure.md#tokens-permissions-and-tls",
    "without ros": "howto/ros2_without_ros.md#a-robot-from-a-laptop-without-ros",
    "fleet": "howto/fleet.md#a-fleet-workers-on-several-machines",
    "test": "testing.md#test-executors-and-clients",
    "browser": "howto/with_curl.md#in-the-browser",
    "mcp": "howto/agents.md#agents-mcp-and-a2a",
    "nav2": "howto/nav2.md#nav2-moveit-ros2_control",
}
"""Tasks of a stranger, as a word that names each, and the headings where they are shown."""


def texts_of(module: Path) -> Iterator[str]:
    """Yield the texts of a module, `{}` for each value in an f-string."""
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        match node:
            case ast.Constant(value=str() as text):
                yield text
            case ast.JoinedStr(values=parts):
                yield "".join(
                    str(part.value) if isinstance(part, ast.Constant) else "{}" for part in parts
                )


def plain(text: str) -> str:
    return re.sub(r"\s+", " ", text.replace("`", ""))


@pytest.fixture(scope="module")
def texts() -> list[str]:
    """Every text of the code, and of the library under it that raises errors of its own."""
    spec = importlib.util.find_spec("anyio")
    assert spec is not None
    assert spec.origin is not None
    folders = [ROOT / "fibaction", ROOT / "transports", Path(spec.origin).parent]
    modules = [module for folder in folders for module in sorted(folder.rglob("*.py"))]
    return [plain(text) for module in modules for text in texts_of(module)]


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_with_an_answer_is_one_of_the_code(message: str, texts: list[str]) -> None:
    parts = [part.strip() for part in plain(message).split("...") if len(part.strip()) > 3]

    assert parts
    # Some messages are put together of several texts, so each part is looked for by itself.
    assert [part for part in parts if not any(part in text for text in texts)] == []


def test_there_are_messages() -> None:
    assert len(MESSAGES) > 30


@pytest.mark.parametrize(("word", "pages"), ANSWERS.items())
def test_a_word_that_people_type_finds_the_page_that_answers_it(
    word: str, pages: list[str]
) -> None:
    for page in pages:
        text = (DOCS / page).read_text(encoding="utf-8").lower()
        assert word in text
        # What is in a title or in a heading comes first in a search.
    headings = " ".join(
        line.lower()
        for page in pages
        for line in (DOCS / page).read_text(encoding="utf-8").splitlines()
        if line.startswith("#")
    )
    assert word in headings


def links_of(page: Path) -> set[str]:
    """The pages that a page leads to, and their headings."""
    targets = re.findall(r"\]\(([^)\s:]+)\)", page.read_text(encoding="utf-8"))
    found = {(page.parent / target).resolve().relative_to(DOCS).as_posix() for target in targets}
    return found | {target.partition("#")[0] for target in found}


@pytest.mark.parametrize(("word", "target"), TASKS.items())
def test_a_task_of_a_stranger_is_two_clicks_from_the_first_page_and_in_a_heading(
    word: str, target: str
) -> None:
    near = links_of(DOCS / "index.md")
    pages = {name for name in near if name.endswith(".md")}
    near = near.union(*(links_of(DOCS / name) for name in pages))
    name, _, anchor = target.partition("#")
    page = (DOCS / name).read_text(encoding="utf-8")
    (heading, *_) = (
        line.lower() for line in page.splitlines() if line.startswith("#") and slug(line) == anchor
    )

    assert word in heading

    assert name in near


def slug(heading: str) -> str:
    """The anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
