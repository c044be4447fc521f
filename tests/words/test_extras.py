from __future__ import annotations

import pickle

import pytest

from fibaction.words.extras import MissingExtra, NeedsExtra


def missing(error: BaseException) -> MissingExtra:
    with pytest.raises(MissingExtra) as caught, NeedsExtra("a lamp", "lamps[led]"):
        raise error
    assert caught.value.__cause__ is error
    return caught.value


def test_a_missing_module_is_a_sentence_with_the_extra_that_brings_it() -> None:
    told = missing(ModuleNotFoundError("No module named 'led.driver'", name="led.driver"))
    assert str(told) == "a lamp needs led: pip install 'lamps[led]'"
    assert told.name == "led"
    assert told.advice == "led: pip install 'lamps[led]'"


def test_the_sentence_goes_to_another_process_as_it_is() -> None:
    told = missing(ModuleNotFoundError("No module named 'led'", name="led"))
    copy = pickle.loads(pickle.dumps(told))
    assert (str(copy), copy.name, copy.advice) == (str(told), told.name, told.advice)


@pytest.mark.parametrize(
    "error",
    [
        ImportError("cannot import name 'x'", name="fibaction.words"),
        ImportError("partly initialised", name="fibaction_transports"),
        ImportError("a text without a module"),
        ValueError("not about modules"),
        MissingExtra("the inner sentence", name="inner"),
    ],
)
def test_what_no_extra_mends_is_raised_as_it_is(error: Exception) -> None:
    with pytest.raises(type(error)) as caught, NeedsExtra("a lamp", "lamps[led]"):
        raise error
    assert caught.value is error


def test_a_block_whose_modules_are_there_ends_quietly() -> None:
    with NeedsExtra("a lamp", "lamps[led]"):
        import json
    assert json.loads("1") == 1
