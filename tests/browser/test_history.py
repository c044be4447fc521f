"""The console with the goals that only the history of the server has."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Generator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from playwright.sync_api import Browser, BrowserContext, Locator, Page, expect

from fibaction.observe.recordings.recording_file import Record
from tests.browser.archive import GOALS, PAINT
from tests.browser.pages import chosen, goal, is_accessible, open_action, rows, send
from tests.browser.served import ArchiveProcess, RobotProcess


@pytest.fixture(scope="module")
def archive(
    browser: Browser, tmp_path_factory: pytest.TempPathFactory
) -> Generator[RobotProcess, None, None]:
    """Start one server with a past for all tests, which do not change it."""
    with ArchiveProcess(tmp_path_factory.mktemp("archive")) as running:
        yield running


def choose_label(page: Page, label: str) -> None:
    """Let the list have the goals of a label, those of the history included."""
    filters = page.get_by_text("Client, label and time")
    if not page.get_by_role("searchbox", name="Label", exact=True).is_visible():
        filters.click()
    page.get_by_role("searchbox", name="Label", exact=True).fill(label)


def open_order(page: Page, number: int) -> None:
    """Open the goal of an order."""
    choose_label(page, f"order={number}")
    expect(rows(page)).to_have_count(1)
    rows(page).get_by_role("link").click()
    expect(goal(page).get_by_label("Goal", exact=True)).to_contain_text(f'"order": {number}')


def test_a_goal_that_has_just_ended_is_shown_with_what_was_sent(
    page: Page, archive: RobotProcess
) -> None:
    address = f"{archive.url}/actions/varnish/goals?wait=20"
    assert page.request.post(address, data={"order": 7}).ok
    open_action(page, archive, "varnish")
    rows(page).get_by_role("link").click()
    expect(goal(page).get_by_label("Goal", exact=True)).to_contain_text('"order": 7')
    expect(goal(page).get_by_label("Result", exact=True)).to_contain_text('"liters": 1.75')


def found(page: Page) -> Locator:
    """What the list says of the goals that were found."""
    return page.get_by_role("region", name="Goals").locator(".note")


def test_the_history_is_there_at_once_page_by_page_with_the_number_of_goals(
    page: Page, archive: RobotProcess
) -> None:
    open_action(page, archive, "paint")
    expect(found(page)).to_have_text(f"1 to 100 of {GOALS} goals.")
    expect(rows(page)).to_have_count(100)
    expect(rows(page).first).to_contain_text(f"order: {GOALS}, color: red")  # as it was sent
    page.get_by_role("button", name="Next goals").click()
    page.get_by_role("button", name="Next goals").click()
    expect(found(page)).to_have_text(f"201 to {GOALS} of {GOALS} goals.")
    expect(rows(page)).to_have_count(GOALS - 200)
    expect(page.get_by_role("button", name="Next goals")).to_be_hidden()
    page.get_by_label("Filter goals").select_option("not succeeded")
    expect(found(page)).to_have_text(f"{GOALS // 10} goals.")
    expect(rows(page).first).to_contain_text("the can is empty")
    page.get_by_label("Search goals").fill("CAN order=150")
    expect(rows(page)).to_have_count(1)
    page.get_by_label("Search goals").fill("nothing like it")
    expect(found(page)).to_have_text("No goal is found.")


def box(page: Page, name: str) -> Locator:
    return page.get_by_label(f"Column {name}", exact=True)


def test_columns_and_the_order_are_chosen_and_stay_in_the_address(
    page: Page, context: BrowserContext, archive: RobotProcess
) -> None:
    open_action(page, archive, "paint")
    page.get_by_text("Columns and order").click()
    for name in ("Request", "Client", "Time"):
        box(page, name).uncheck()
    for name in ("Labels", "Ran", "color"):
        box(page, name).check()
    head = page.get_by_role("columnheader")
    names = ["Goal", "State", "Labels", "Ran", "color", "Cancel"]
    expect(head).to_have_text(names)
    page.get_by_role("button", name="State", exact=True).click()
    expect(rows(page).first).to_contain_text("aborted")
    expect(page).to_have_url(
        re.compile("sort=-status&columns=state%2Clabels%2Cran%2Crequest.color")
    )
    expect(page.get_by_role("columnheader", name="State")).to_have_attribute(
        "aria-sort", "descending"
    )
    page.get_by_role("button", name="State", exact=True).click()
    expect(rows(page).first).to_contain_text("succeeded")
    page.get_by_role("combobox", name="Order").select_option("accepted")
    page.get_by_label("Goals on a page").select_option("20")
    expect(rows(page)).to_have_count(20)
    expect(rows(page).first).to_contain_text("order=1 wall=north")
    expect(rows(page).first).to_contain_text("red")
    other = context.new_page()
    other.goto(page.url)
    expect(rows(other)).to_have_count(20)
    expect(other.get_by_role("columnheader").nth(4)).to_have_text("color")


def test_a_view_is_saved_and_opened_again(page: Page, archive: RobotProcess) -> None:
    open_action(page, archive, "paint")
    page.get_by_label("Filter goals").select_option("not succeeded")
    page.get_by_text("Views", exact=True).click()
    page.get_by_label("Name of the view").fill("Empty cans")
    page.get_by_role("button", name="Save this view").click()
    page.goto(f"{archive.url}/#/varnish")
    page.reload()
    page.get_by_text("Views", exact=True).click()
    page.get_by_role("link", name="Empty cans").click()
    expect(page.get_by_role("heading", name="paint")).to_be_visible()
    expect(found(page)).to_have_text(f"{GOALS // 10} goals.")
    page.get_by_text("Views", exact=True).click()
    page.get_by_role("button", name="Remove the view Empty cans").click()
    expect(page.get_by_role("link", name="Empty cans")).to_have_count(0)


def test_goals_are_chosen_and_sent_again_canceled_and_saved(
    page: Page, browser: Browser, tmp_path: Path
) -> None:
    with ArchiveProcess(tmp_path) as own:
        open_action(page, own, "paint")
        page.get_by_label("Filter goals").select_option("not succeeded")
        expect(found(page)).to_have_text(f"{GOALS // 10} goals.")
        page.get_by_label("Choose all goals of this page").check()
        expect(chosen(page)).to_contain_text(f"{GOALS // 10} goals chosen")
        goals = json.loads(saved(page, "Save as JSON"))
        assert {one["goal"]["order"] % 10 for one in goals} == {0}  # with what was sent
        chosen(page).get_by_role("button", name="Send again").click()
        page.get_by_role("dialog").get_by_role("button", name="Send them again").click()
        expect(found(page)).to_have_text(f"{2 * (GOALS // 10)} goals.")
        expect(chosen(page)).to_be_hidden()
        page.get_by_label("Filter goals").select_option("all")
        expect(found(page)).to_contain_text(f"of {GOALS + GOALS // 10} goals.")
        rows(page).first.get_by_role("checkbox").check()
        chosen(page).get_by_role("button", name="Choose all").click()
        expect(chosen(page)).to_contain_text(f"{GOALS + GOALS // 10} goals chosen")
        assert len(json.loads(saved(page, "Save as JSON"))) == GOALS + GOALS // 10
        chosen(page).get_by_role("button", name="Choose none").click()
        expect(chosen(page)).to_be_hidden()


def test_goals_are_chosen_by_client_label_and_time(page: Page, archive: RobotProcess) -> None:
    open_action(page, archive, "paint")
    choose_label(page, "wall=south")
    expect(found(page)).to_have_text(f"1 to 100 of {GOALS // 2} goals.")
    page.get_by_label("Since", exact=True).fill("2020-01-01T00:00")
    expect(found(page)).to_have_text(f"1 to 100 of {GOALS // 2} goals.")
    page.get_by_label("Until", exact=True).fill("2020-01-02T00:00")
    expect(rows(page)).to_have_count(0)
    page.get_by_label("Until", exact=True).fill("")
    page.get_by_role("searchbox", name="Client", exact=True).fill("nobody like it")
    expect(rows(page)).to_have_count(0)
    page.get_by_role("searchbox", name="Client", exact=True).fill("")
    page.get_by_role("searchbox", name="Label", exact=True).fill("wall")
    expect(found(page)).to_have_text(f"1 to 100 of {GOALS} goals.")


def test_the_address_has_the_choice_and_another_page_reads_it(
    page: Page, context: BrowserContext, archive: RobotProcess
) -> None:
    open_action(page, archive, "paint")
    choose_label(page, "order=12")
    page.get_by_label("Search goals").fill("south")
    page.get_by_label("Since", exact=True).fill("2020-01-01T00:00")
    expect(page).to_have_url(re.compile(r"/#/paint\?search=south&label=order%3D12&since=20"))
    other = context.new_page()
    other.goto(page.url)
    expect(other.get_by_label("Search goals")).to_have_value("south")
    expect(other.get_by_role("searchbox", name="Label", exact=True)).to_have_value("order=12")
    expect(other.get_by_label("Since", exact=True)).to_have_value("2020-01-01T00:00")
    expect(rows(other)).to_have_count(1)
    rows(other).get_by_role("link").click()
    expect(other).to_have_url(re.compile(r"/#/paint/[0-9a-f]{32}\?search=south&"))
    other.get_by_role("link", name="paint", exact=True).first.click()
    expect(other.get_by_label("Search goals")).to_have_value("")


def test_a_link_to_a_goal_stays_true_when_the_server_has_forgotten_it(
    page: Page, browser: Browser, archive: RobotProcess
) -> None:
    open_action(page, archive, "paint")
    open_order(page, 17)
    address = page.url
    other = browser.new_page()
    other.goto(address.split("?")[0])
    expect(goal(other).locator(".badge")).to_have_text("✓ succeeded")
    expect(goal(other).get_by_label("Result", exact=True)).to_contain_text('"liters": 4.25')
    expect(goal(other)).to_contain_text("Labels: order=17")
    expect(goal(other)).to_contain_text("Feedback: 1 message, not in the history")
    other.goto(f"{archive.url}/#/paint/{'ab' * 16}")
    expect(other.get_by_text("it may have forgotten it")).to_be_visible()
    other.close()


def test_two_goals_are_compared(page: Page, archive: RobotProcess) -> None:
    open_action(page, archive, "paint")
    open_order(page, GOALS - 1)
    goal(page).get_by_role("button", name="Compare", exact=True).click()
    comparison = page.get_by_role("region", name="Comparison")
    expect(comparison).to_contain_text("Open the other goal.")
    open_order(page, GOALS)
    for text in ("result.liters", "goal.color", "succeeded", "aborted", "the can is empty"):
        expect(comparison).to_contain_text(text)
    expect(comparison).to_contain_text(re.compile(r"goal\.order\s*229\s*230"))
    expect(comparison).not_to_contain_text("goal.spots[0].y")
    is_accessible(page)
    open_action(page, archive, "varnish")
    send(page, order="1")
    expect(comparison).to_contain_text("Only goals of one action are compared")
    expect(comparison.get_by_role("table")).to_be_hidden()
    comparison.get_by_role("button", name="Stop comparing").click()
    expect(comparison).to_be_hidden()


def test_a_goal_of_the_past_is_sent_again_with_its_labels(
    page: Page, browser: Browser, tmp_path: Path
) -> None:
    with ArchiveProcess(tmp_path) as own:
        open_action(page, own, "paint")
        open_order(page, 21)
        before = goal(page).locator("header code").inner_text()
        goal(page).get_by_role("button", name="Send again").click()
        page.get_by_role("dialog").get_by_role("button", name="Send again").click()
        expect(goal(page).locator("header code")).not_to_have_text(before)
        expect(goal(page).locator(".facts")).to_contain_text("by this page")
        expect(goal(page).get_by_label("Result", exact=True)).to_contain_text('"liters": 5.25')
        expect(goal(page)).to_contain_text("Labels: order=21")


def saved(page: Page, name: str) -> str:
    with page.expect_download() as download:
        page.get_by_role("button", name=name).click()
    return download.value.path().read_text()


def test_the_list_is_saved_as_json_and_csv(page: Page, archive: RobotProcess) -> None:
    open_action(page, archive, "paint")
    choose_label(page, "wall=south")
    expect(found(page)).to_have_text(f"1 to 100 of {GOALS // 2} goals.")
    goals = json.loads(saved(page, "Save as JSON"))
    assert len(goals) == GOALS // 2
    assert {one["labels"]["wall"] for one in goals} == {"south"}
    lines = list(csv.DictReader(saved(page, "Save as CSV").splitlines()))
    assert [line["goal_id"] for line in lines] == [one["goal_id"] for one in goals]


def recording_of(goal_id: str, folder: Path) -> Path:
    """Write a recording of one goal of the past, with its feedback."""
    begin = 1_790_000_000_000_000_000
    fields: list[dict[str, Any]] = [
        {"event": "server", "info": PAINT.info},
        {"event": "accepted", "goal_id": goal_id, "client": "ann", "data": {"order": 30}},
        {"event": "feedback", "goal_id": goal_id, "number": 1, "data": 1},
        {"event": "end", "goal_id": goal_id, "status": "SUCCEEDED", "data": {"liters": 7}},
    ]
    records = [Record(begin, action="paint", **one) for one in fields]
    file = folder / "painted.jsonl"
    file.write_bytes(b"".join(msgspec.json.encode(record) + b"\n" for record in records))
    return file


def test_a_goal_of_the_past_is_found_in_a_recording(
    page: Page, archive: RobotProcess, tmp_path: Path
) -> None:
    open_action(page, archive, "paint")
    open_order(page, 31)
    found = re.search("[0-9a-f]{32}", page.url)
    assert found is not None
    for goal_id, text in ((found[0], "by ann"), ("cd" * 16, "The recording has no goal")):
        with page.expect_file_chooser() as choosing:
            goal(page).get_by_role("button", name="Find in a recording").click()
        choosing.value.set_files(recording_of(goal_id, tmp_path))
        expect(page.locator("#connection")).to_have_text("recording painted.jsonl")
        expect(page.locator("#content")).to_contain_text(text)
        page.get_by_role("button", name="Close", exact=True).click()
        expect(goal(page).get_by_label("Goal", exact=True)).to_contain_text('"order": 31')
