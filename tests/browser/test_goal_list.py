"""The list of goals: many at once, on each width, and what is done with those that are chosen."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Page, expect

from tests.browser.pages import (
    LONG,
    NewRobot,
    chosen,
    fits,
    is_accessible,
    open_action,
    rows,
)
from tests.browser.served import RobotProcess

GOALS = 300
FRAMES = 60
SEND = """
    ([action, count, body]) => {
        const headers = { "Content-Type": "application/json" };
        const path = `actions/${action}/goals?label=site=north`;
        const send = () => fetch(path, { method: "POST", headers, body });
        return Promise.all(Array.from({ length: count }, send));
    }
"""
COUNT_CHANGES = """
    (left) => new Promise((done) => {
        let changes = 0;
        const began = performance.now();
        const observer = new MutationObserver((records) => (changes += records.length));
        const parts = { subtree: true, childList: true, characterData: true, attributes: true };
        observer.observe(document.querySelector(".goals tbody"), parts);
        const next = () => {
            if (left--) {
                requestAnimationFrame(next);
            } else {
                done(changes / (performance.now() - began) * 1000);
            }
        };
        next();
    })
"""


def test_of_three_hundred_active_goals_a_frame_lays_out_once_and_writes_little(
    page: Page, new_robot: NewRobot
) -> None:
    """So there is time for 55 frames a second, which a busy machine may not have for any page."""
    page.goto(f"{new_robot().url}/#/fibonacci?rows=300")
    expect(page.get_by_role("heading", name="fibonacci")).to_be_visible()
    page.evaluate(SEND, ["fibonacci", GOALS, f'{{"order": {LONG}}}'])
    expect(rows(page)).to_have_count(GOALS)
    expect(rows(page).get_by_text("executing")).to_have_count(GOALS)
    expect(rows(page).locator(".request").get_by_text(LONG)).to_have_count(GOALS)  # all was read
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")

    def layouts() -> float:
        metrics = session.send("Performance.getMetrics")["metrics"]
        return float(next(one["value"] for one in metrics if one["name"] == "LayoutCount"))

    before = layouts()
    changes = page.evaluate(COUNT_CHANGES, FRAMES)
    assert (layouts() - before) / FRAMES < 1.5
    assert changes < GOALS  # in a second, in which those in view run for one second more

    last = rows(page).last
    before_view = last.locator(".time").inner_text()
    last.scroll_into_view_if_needed()
    expect(last.locator(".time")).not_to_have_text(before_view)
    page.get_by_role("button", name="Cancel all").click()
    page.get_by_role("dialog").get_by_role("button", name="Cancel all").click()
    expect(rows(page).get_by_text("canceled")).to_have_count(GOALS)  # those out of view, too


def test_chosen_goals_are_canceled_and_the_others_go_on(page: Page, new_robot: NewRobot) -> None:
    open_action(page, new_robot())
    page.evaluate(SEND, ["fibonacci", 3, f'{{"order": {LONG}}}'])
    expect(rows(page)).to_have_count(3)
    for place in (0, 2):
        rows(page).nth(place).get_by_role("checkbox").check()
    expect(chosen(page)).to_contain_text("2 goals chosen")
    chosen(page).get_by_role("button", name="Cancel").click()
    page.get_by_role("dialog").get_by_role("button", name="Cancel them").click()
    expect(chosen(page)).to_be_hidden()
    expect(rows(page).get_by_text("canceled")).to_have_count(2)
    expect(rows(page).get_by_text("executing")).to_have_count(1)
    for state, count in (("active", 1), ("waiting", 0)):
        page.get_by_label("Filter goals").select_option(state)
        expect(rows(page)).to_have_count(count)


@pytest.mark.parametrize("width", [390, 801, 900, 1150, 1440])
def test_the_list_has_the_action_and_the_request_on_each_width(
    page: Page, robot: RobotProcess, width: int
) -> None:
    page.emulate_media(reduced_motion="reduce")
    page.set_viewport_size({"width": width, "height": 900})
    page.goto(f"{robot.url}/#/?search=drive")
    page.evaluate(SEND, ["arm/drive", 1, "{}"])
    first = rows(page).first
    expect(first).to_contain_text("site=north")
    assert first.locator(".request").evaluate("(one) => one.clientWidth > 100")
    for part in (first.locator(".action"), first.locator(".id")):
        assert part.evaluate("(one) => one.scrollWidth <= one.clientWidth && one.clientWidth > 60")
    fits(page, width)
    page.get_by_text("Columns and order").click()
    page.get_by_text("Views", exact=True).click()
    first.get_by_role("checkbox").check()
    is_accessible(page)


def test_a_family_is_a_tree_with_the_goals_that_the_history_alone_has(
    page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot)
    ids = page.evaluate(
        """async () => {
            const { Connection } = await import("/fibaction.js");
            const connection = new Connection("/");
            const ids = [];
            for (const step of ["lift", "grip", "close"]) {
                const meta = ids.length ? { parent: ids.at(-1), step } : {};
                const goal = await connection.sendGoal("fibonacci", { order: 2 }, { meta });
                await goal.outcome;
                ids.push(goal.id);
            }
            return ids;
        }"""
    )
    page.goto(f"{robot.url}/#/fibonacci/{ids[0]}")
    family = page.locator(".goal .family")
    expect(family.get_by_role("list", name="Children", exact=True)).to_contain_text(
        re.compile(f"grip: fibonacci {ids[1][:8]}.*close: fibonacci {ids[2][:8]}")
    )
    page.goto(f"{robot.url}/#/fibonacci/{ids[2]}")
    expect(family.locator(".step")).to_have_text(
        [f"Step close of goal fibonacci {ids[1][:8]}", f"Step grip of goal fibonacci {ids[0][:8]}"]
    )
