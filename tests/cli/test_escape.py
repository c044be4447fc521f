"""Text of a server cannot control the terminal."""

from __future__ import annotations

import json

from fibaction.cli.output.escape import MAX_LINE, clean, clean_json, clean_lines


def test_text_of_others_is_cleaned_once() -> None:
    assert clean("ok\n\x1b[2J\u2028\U000e0001") == "ok\\x0a\\x1b[2J\\u2028\\U000e0001"
    assert clean(clean("\x1b")) == clean("\x1b")
    assert clean("füñf 鳥") == "füñf 鳥"
    assert clean_lines("a\x1b\nb") == "a\\x1b\nb"


def test_a_sentence_is_cut_and_lines_of_a_message_are_not() -> None:
    long = "x" * 5000

    assert clean(long) == "x" * (MAX_LINE - 1) + "…"
    assert clean_lines(f"{long}\na") == f"{long}\na"


def test_json_is_cleaned_in_the_way_of_json() -> None:
    said = "ok \x7f\x9b2J\u202e\U000e0001 füñf 鳥"
    text = json.dumps(said, ensure_ascii=False)

    assert clean_json(text) == r'"ok \u007f\u009b2J\u202e\udb40\udc01 füñf 鳥"'
    assert json.loads(clean_json(text)) == said
