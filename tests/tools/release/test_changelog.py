"""The section of a release: what was new, under the version and its date."""

from __future__ import annotations

from datetime import date

import pytest

from tests.tools.release.changelog import date_of, with_section

DAY = date(2026, 12, 1)
HEAD = "# Changelog\n\nThe form.\n\n"
NEWS = "\n### Added\n\n- News.\n"
FIRST = f"{HEAD}## [Unreleased]\n{NEWS}"
RELEASED = f"{HEAD}## [Unreleased]\n\n## [0.1.0] - 2026-12-01\n{NEWS}"


def test_what_is_new_becomes_the_section_of_the_version() -> None:
    assert with_section(FIRST, "0.1.0", DAY) == RELEASED


def test_older_sections_stay_below() -> None:
    old = "\n## [0.0.9] - 2026-01-01\n\n- Old.\n"

    assert with_section(FIRST + old, "0.1.0", DAY) == RELEASED + old


def test_a_second_run_sets_the_date() -> None:
    later = with_section(RELEASED, "0.1.0", date(2026, 12, 2))

    assert later == RELEASED.replace("12-01", "12-02")


@pytest.mark.parametrize(
    ("text", "version", "wrong"),
    [
        (HEAD, "0.1.0", "has to have the line"),
        (FIRST + FIRST, "0.1.0", "has to have the line"),
        (f"{HEAD}## [Unreleased]\n\n", "0.1.0", "has nothing under"),
        (RELEASED, "0.2.0", "has nothing under"),
        (RELEASED.replace("[Unreleased]\n", "[Unreleased]\n\n- More.\n"), "0.1.0", "take the next"),
        (f"{RELEASED}\n## [0.0.9] - 2026-01-01\n\n- Old.\n", "0.0.9", "take the next"),
    ],
)
def test_what_cannot_be_released_is_an_error(text: str, version: str, wrong: str) -> None:
    with pytest.raises(ValueError, match=wrong):
        with_section(text, version, DAY)


def test_the_date_of_a_section_is_found() -> None:
    assert date_of(RELEASED, "0.1.0") == "2026-12-01"
    assert date_of(RELEASED, "0.2.0") is None
    assert date_of(RELEASED, "Unreleased") is None
