"""The pages that are followed in terminals, and what follows them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support import node, walks
from tests.support.pages import Block
from tests.support.ros_domain import own_domain
from tests.support.walks import file_of, steps_of, terminal_of, walk
from tests.test_docs import PAGES, ROOT

WALKS = [path for path in PAGES if "<!-- terminal: " in path.read_text(encoding="utf-8")]


@pytest.mark.timeout(180)  # a page starts up to twenty processes, one after another
@pytest.mark.parametrize("path", WALKS, ids=[str(path.relative_to(ROOT)) for path in WALKS])
def test_a_reader_who_types_what_the_page_says_sees_what_it_shows(
    path: Path, tmp_path: Path
) -> None:
    page = path.read_text(encoding="utf-8")
    # Whoever reads that one is in the repository already.
    folder = ROOT if path.name == "README.md" else tmp_path
    if "\n$ node " in page:
        if node.IS_LEFT_OUT:
            pytest.skip(node.MISSING)
        (folder / "node_modules").symlink_to(node.MODULES)  # as by `npm install`

    with own_domain():
        wrong = walk(page, folder)

    assert not wrong, "\n".join(wrong)


def console(code: str, terminal: str = "one") -> str:
    return f"<!-- terminal: {terminal} -->\n```console\n{code}```\n\n"


def test_output_that_the_page_does_not_show_is_found(tmp_path: Path) -> None:
    (wrong,) = walk(console("$ echo 1; echo 2\n1\n"), tmp_path)

    assert wrong == "line 2: `echo 1; echo 2` prints\n1\n2\nand the page says\n1\n"


def test_a_race_of_asyncio_is_not_output_of_the_page(tmp_path: Path) -> None:
    printed = "Unknown child process pid 7, will report returncode 255"

    assert walk(console(f"$ echo 1; echo '{printed}' >&2\n1\n"), tmp_path) == []


def test_dots_stand_for_any_lines(tmp_path: Path) -> None:
    assert walk(console("$ seq 9\n1\n...\n9\n$ seq 2\n1\n...\n2\n"), tmp_path) == []
    assert len(walk(console("$ seq 9\n1\n...\n8\n"), tmp_path)) == 1


def test_a_program_that_does_not_end_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(walks, "ENDING", 0.1)
    program = "trap : TERM; echo ready; while :; do sleep 0.01; done"
    page = f'<!-- terminal: one, runs on -->\n```console\n$ bash -c "{program}"\nready\n```\n'

    assert walk(page, tmp_path) == []  # would not return as long as there is a reader's pipe


def test_a_command_that_says_nothing_for_too_long_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(walks, "PATIENCE", 0.1)

    with pytest.raises(TimeoutError, match="nothing more"):
        walk(console("$ sleep 1000\n"), tmp_path)


def test_the_port_that_pages_name_is_one_that_is_free(tmp_path: Path) -> None:
    page = console("$ echo tcp://127.0.0.1:7400\ntcp://127.0.0.1:7400\n$ echo $FIBACTION_URL\n")

    (wrong,) = walk(page, tmp_path)
    assert "7400" not in wrong


def test_what_needs_ros_is_done_where_ros_is_and_all_else_elsewhere(tmp_path: Path) -> None:
    page = "<!-- terminal: one, where ROS 2 is -->\n```console\n$ echo 1\n2\n```\n"
    other = console("$ echo 3\n4\n")

    assert "echo 3" in "".join(walk(page + other, tmp_path))
    assert "echo 1" not in "".join(walk(page + other, tmp_path))
    assert "echo 1" in "".join(walk(page + other, tmp_path, ros=True))
    assert "echo 3" not in "".join(walk(page + other, tmp_path, ros=True))


def test_a_block_of_commands_does_not_begin_with_output() -> None:
    with pytest.raises(ValueError, match="no command prints '1'"):
        steps_of("1\n$ true\n")


@pytest.mark.parametrize("mark", ["terminal: a b", "terminals: a", "file:"])
def test_a_mark_that_is_misspelt_is_none(mark: str) -> None:
    block = Block("console", "", 0, f"<!-- {mark} -->\n")

    assert terminal_of(block) is None
    assert file_of(block) is None
