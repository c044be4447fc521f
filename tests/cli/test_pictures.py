"""The pictures: they show what is in the terminal."""

from __future__ import annotations

from contextlib import closing
from xml.etree import ElementTree

import pytest

from tests.cli.pictures import DARK, FOLDER, LIGHT, WIDTHS, Colors, Drawn

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("colors", [DARK, LIGHT])
def test_what_is_in_the_terminal_is_in_the_picture(tcp: str, colors: Colors) -> None:
    with closing(Drawn("send_goal", "words", "words: a  <b> 鳥", "-f", url=tcp)) as terminal:
        assert terminal.ends() == 0
        drawn = ElementTree.fromstring(terminal.svg(colors))
        shown = [line.split("  ") for line in terminal.screen]

    words = [part.text for part in drawn.iter(f"{SVG}text")]
    assert words == [word.strip() for line in shown for word in line if word.strip()]
    assert {part.get("fill") for part in drawn.iter(f"{SVG}text")} == {colors["text"]}


def test_the_pictures_of_the_documentation_are_of_both_widths() -> None:
    pictures = sorted(path.stem.rpartition("_")[::2] for path in FOLDER.glob("*.svg"))

    assert {name for name, _ in pictures} == {"goals", "send_goal", "send_goal_line", "top"}
    for name, _ in pictures:
        assert [(name, str(columns)) for columns in sorted(WIDTHS, key=str)] == [
            picture for picture in pictures if picture[0] == name
        ]
