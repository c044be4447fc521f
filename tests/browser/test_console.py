"""The console in a real browser, with a robot in a process of its own."""

from __future__ import annotations

import re
import signal
import struct
import zlib
from collections.abc import Callable
from contextlib import ExitStack, closing
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
from playwright.sync_api import Browser, BrowserContext, FilePayload, Page, expect

from fibaction.observe.recordings.recording_file import Record
from tests.browser.pages import (
    LONG,
    THEMES,
    NewRobot,
    action,
    fits,
    goal,
    is_accessible,
    open_action,
    row,
    send,
)
from tests.browser.robot import DRIVE
from tests.browser.served import BridgeProcess, ConsoleProcess, RobotProcess

# To send and to follow


def test_a_goal_is_sent_in_three_clicks_and_followed_to_its_result(
    page: Page, robot: RobotProcess
) -> None:
    page.goto(robot.url)
    actions = page.get_by_role("navigation", name="Actions")
    actions.get_by_role("link", name="fibonacci").click()
    page.get_by_label("order").fill("10")
    page.get_by_role("button", name="Send goal").click()
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    expect(goal(page).get_by_label("Result", exact=True)).to_contain_text("34, 55")
    expect(goal(page).get_by_label("Goal", exact=True)).to_contain_text('"order": 10')
    expect(goal(page)).to_contain_text("Feedback: 9 messages")
    expect(page.locator("#connection")).to_have_text("connected")


def test_a_goal_that_fails_shows_its_reason(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot)
    page.get_by_label("order").fill("-1")
    page.get_by_role("button", name="Send goal").click()
    expect(page.get_by_role("alert")).to_have_text("Rejected: the order is negative")
    for name, badge, reason, result in (
        ("break", "✕ aborted", "the arm is stuck", "3"),
        ("odd", "✓ succeeded", "its result cannot be read: ", "none"),
    ):
        open_action(page, robot, name)
        goal_id = send(page, order="3")
        expect(goal(page).locator(".badge")).to_have_text(badge)
        expect(goal(page).locator(".reason")).to_contain_text(reason)
        expect(goal(page).get_by_label("Result", exact=True)).to_contain_text(result)
        expect(row(page, goal_id)).to_contain_text(reason)


def test_the_log_lines_of_a_goal_are_read_when_they_are_opened(
    page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot, "break")
    send(page, order="3")
    expect(goal(page).locator(".badge")).to_have_text("✕ aborted")
    goal(page).get_by_text("Log", exact=True).click()
    lines = goal(page).get_by_label("Log lines")
    expect(lines).to_have_text(re.compile(r"WARNING  arm: joint 3 does not move$"))
    open_action(page, robot)
    send(page, order="3")
    goal(page).get_by_text("Log", exact=True).click()
    expect(goal(page)).to_contain_text("Its server keeps no log lines")
    expect(lines).to_be_hidden()


def test_the_form_has_every_kind_of_field_and_sends_what_was_entered(
    page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot, "arm/drive")
    expect(page.get_by_label("New goal")).to_contain_text("Where to drive, and how.")
    target = page.get_by_role("group", name="target")
    target.get_by_label("x m").fill("4.5")
    page.get_by_label("gear").select_option("fast")
    page.get_by_label("lights").check()
    page.get_by_role("button", name="Add to stops").click()
    page.get_by_role("button", name="Add to stops").click()
    page.get_by_role("group", name="stops[1]").get_by_label("y m").fill("-2")
    page.get_by_role("button", name="Remove stops[0]").click()
    page.get_by_label("set note").check()
    page.get_by_label("note", exact=True).fill("near the wall")
    page.get_by_label("load (JSON)").fill('"heavy"')
    send(page)
    sent = goal(page).get_by_label("Goal", exact=True)
    for text in ('"x": 4.5', '"gear": "fast"', '"lights": true', '"y": -2', '"near the wall"'):
        expect(sent).to_contain_text(text)
    expect(sent).to_contain_text('"load": "heavy"')
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")


def test_a_variant_is_chosen_and_has_its_own_fields(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "fetch")
    source = page.get_by_label("variant of source")
    assert source.locator("option").all_inner_texts() == ["shelf", "point"]
    page.get_by_role("group", name="source").get_by_label("number").fill("9")
    expect(page.get_by_role("group", name="target").get_by_label("number")).to_have_value("7")
    page.get_by_label("variant of target").select_option("point")
    page.get_by_role("group", name="target").get_by_label("x m").fill("1.5")
    page.get_by_label("variant of spare").select_option("shelf")
    page.get_by_label("set fallback").check()
    page.get_by_label("variant of fallback").select_option("shelf")
    send(page)
    expect(goal(page).get_by_label("Result", exact=True)).to_have_text(
        '"Fetch(source=ToShelf(number=9), target=ToPoint(point=Point(x=1.5, y=0.0)),'
        ' spare=ToShelf(number=3), fallback=ToShelf(number=3))"'
    )


def test_a_goal_with_variants_is_edited_as_json_and_back(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "fetch")
    page.get_by_role("button", name="Edit as JSON").click()
    page.get_by_label("goal (JSON)").fill(
        '{"source": {"type": "point", "point": {"x": 4}}, "spare": {"type": "shelf", "number": 8}}'
    )
    page.get_by_role("button", name="Edit as JSON").click()
    expect(page.get_by_label("variant of source")).to_have_value("1")
    expect(page.get_by_role("group", name="spare").get_by_label("number")).to_have_value("8")
    page.get_by_role("button", name="Edit as JSON").click()
    page.get_by_label("goal (JSON)").fill('{"source": {"type": "shelf"}}')
    page.get_by_role("button", name="Edit as JSON").click()
    expect(page.get_by_label("variant of spare")).to_have_value("-1")
    send(page)
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")


@pytest.mark.parametrize(
    ("address", "told"),
    [
        ("nothing", "The server has no action nothing."),
        (f"fibonacci/{'e' * 32}", f"The server knows no goal {'e' * 32} of fibonacci"),
    ],
)
def test_a_link_to_what_the_server_does_not_have_says_so(
    page: Page, robot: RobotProcess, address: str, told: str
) -> None:
    page.goto(f"{robot.url}/#/{address}")
    expect(page.get_by_text(told)).to_be_visible()
    page.goto(f"{robot.url}/#/fibonacci")
    expect(page.get_by_text(told)).to_have_count(0)


@pytest.mark.parametrize(
    ("field", "text", "told"),
    [("speed", "", "enter a number"), ("load (JSON)", "{", "not JSON"), ("speed", "3", "speed")],
)
def test_a_field_that_is_wrong_is_named_and_nothing_is_sent(
    page: Page, robot: RobotProcess, field: str, text: str, told: str
) -> None:
    open_action(page, robot, "arm/drive")
    page.get_by_label(field).fill(text)
    page.get_by_role("button", name="Send goal").click()
    expect(page.get_by_role("alert")).to_contain_text(told)
    assert page.evaluate("document.activeElement.labels[0].textContent") == field
    expect(page.locator(".field").filter(has=page.locator(":focus"))).to_contain_text(told)
    expect(page.locator(":focus")).to_have_attribute("aria-invalid", "true")
    expect(goal(page)).to_have_count(0)


def test_integers_beyond_those_of_javascript_arrive_exactly(
    context: BrowserContext, page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot, "arm/drive")
    page.get_by_label("gear").select_option("slow")  # it is active while the other tab looks
    page.get_by_role("button", name="Edit as JSON").click()
    area = page.get_by_label("goal (JSON)")
    edited = area.input_value().replace('"load": 0', f'"load": {2**60 + 1}')
    area.fill(edited.replace('"note": null', '"note": "12345678901234567890 and 1.50"'))
    goal_id = send(page)
    other = context.new_page()
    other.goto(robot.url)
    other.get_by_role("link", name=goal_id, exact=True).click()
    received = goal(other).get_by_label("Goal", exact=True)
    expect(received).to_contain_text(f'"load": {2**60 + 1}')
    expect(received).to_contain_text('"note": "12345678901234567890 and 1.50"')


def test_no_button_of_a_goal_moves_when_the_goal_ends(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot)
    send(page, order=LONG)
    again = goal(page).get_by_role("button", name="Use as new goal")
    before = again.bounding_box()
    goal(page).get_by_role("button", name="Cancel goal").click()
    page.get_by_role("button", name="Cancel the goal").click()
    expect(goal(page).locator(".badge")).to_have_text("⊘ canceled")
    expect(goal(page).get_by_role("button", name="Cancel goal")).to_have_count(0)
    assert again.bounding_box() == before


def drive(page: Page, robot: RobotProcess) -> None:
    """Send a goal of `arm/drive` that ends soon, and wait until all of it is shown."""
    open_action(page, robot, "arm/drive")
    page.get_by_label("gear").select_option("fast")
    send(page)
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    expect(goal(page).get_by_label("Latest feedback")).to_contain_text('"battery": 60')
    expect(goal(page).get_by_label("Result", exact=True)).to_contain_text('"distance"')


def test_the_feedback_is_drawn_by_the_schema_and_told_as_text(
    page: Page, robot: RobotProcess
) -> None:
    drive(page, robot)
    titles = goal(page).locator("figcaption strong")
    expect(titles).to_have_text(["From above (m)", "position (m)", "battery (%)", "progress"])
    goal(page).get_by_text("Messages", exact=True).click()
    expect(goal(page).get_by_label("Feedback messages")).to_contain_text("battery")
    drawn = "canvas => canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height)"
    some = f"canvas => ({drawn})(canvas).data.some(one => one > 0)"
    assert goal(page).locator("canvas").first.evaluate(some)


def test_a_chart_is_zoomed_by_pointer_wheel_and_keys(page: Page, robot: RobotProcess) -> None:
    drive(page, robot)
    chart = goal(page).get_by_role("img", name="Chart of battery")
    figure = page.locator(".chart").filter(has=page.get_by_role("img", name="Chart of battery"))
    whole = figure.get_by_role("button", name="Show all")
    told, part = (
        page.locator("#announcer"),
        re.compile(r"Chart of battery: [-\d.e]+ s to [\d.e]+ s"),
    )
    expect(whole).to_have_count(0)

    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] * 0.4, middle)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.7, middle, steps=3)
    page.mouse.up()
    expect(told).to_have_text(part)
    expect(whole).to_be_visible()
    chart.dblclick()
    expect(told).to_have_text("Chart of battery: all")
    expect(whole).to_have_count(0)

    page.keyboard.down("Control")
    page.mouse.wheel(0, -100)
    expect(told).to_have_text(part)
    page.keyboard.up("Control")
    whole.click()
    expect(chart).to_be_focused()
    expect(told).to_have_text("Chart of battery: all")

    chart.press("+")
    expect(told).to_have_text(part)
    chart.press("Escape")
    expect(told).to_have_text("Chart of battery: all")
    expect(goal(page)).to_have_count(1)
    chart.press("Escape")
    expect(goal(page)).to_have_count(0)


def test_the_charts_of_a_goal_that_has_ended_follow_the_theme(
    page: Page, robot: RobotProcess
) -> None:
    page.emulate_media(color_scheme="light")
    open_action(page, robot, "break")
    send(page, order="3")
    expect(goal(page).locator(".badge")).to_have_text("✕ aborted")
    canvas = goal(page).locator("canvas").first
    changes: list[Callable[[], object]] = [
        lambda: page.emulate_media(color_scheme="dark"),
        lambda: page.get_by_role("button", name="Theme").click(),
    ]
    for change in changes:
        before = canvas.evaluate("canvas => canvas.toDataURL()")
        change()
        is_new = "([canvas, before]) => canvas.toDataURL() !== before"
        page.wait_for_function(is_new, arg=[canvas.element_handle(), before])


def test_the_places_of_a_goal_are_drawn_from_above(page: Page, robot: RobotProcess) -> None:
    drive(page, robot)
    place = goal(page).get_by_role("img", name="From above (m): position 2, 1; goal target 2, 1")
    expect(place).to_be_visible()
    some = "canvas => canvas.getContext('2d').getImageData(60, 12, 200, 200).data.some(Boolean)"
    assert place.evaluate(some)
    page.reload()
    expect(place).to_be_visible()


def test_a_view_from_above_is_zoomed_by_buttons_wheel_drag_and_keys(
    page: Page, robot: RobotProcess
) -> None:
    drive(page, robot)
    view = goal(page).get_by_role("img", name="From above (m)")
    whole = goal(page).locator(".plane").get_by_role("button", name="Show all")
    told = page.locator("#announcer")
    part = re.compile(r"From above \(m\): [-\d.e]+ to [-\d.e]+, [-\d.e]+ to [-\d.e]+")

    def change(how: Callable[[], object], shown: str | re.Pattern[str]) -> None:
        before = told.inner_text()
        how()
        expect(told).not_to_have_text(before)
        expect(told).to_have_text(shown)

    goal(page).get_by_role("button", name="Zoom out: From above").click()  # of the whole
    expect(told).to_have_text("From above (m): all")
    expect(whole).to_have_count(0)
    change(goal(page).get_by_role("button", name="Zoom in: From above").click, part)
    expect(whole).to_be_visible()
    change(whole.click, "From above (m): all")
    expect(view).to_be_focused()

    view.scroll_into_view_if_needed()
    box = view.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.keyboard.down("Control")
    change(lambda: page.mouse.wheel(0, -100), part)
    page.keyboard.up("Control")
    page.mouse.down()
    change(lambda: page.mouse.move(x + 40, y + 20), part)
    page.mouse.up()
    before = told.inner_text()
    page.mouse.move(x, y)  # the drag is over
    expect(told).to_have_text(before)
    change(lambda: view.press("0"), "From above (m): all")

    change(lambda: view.press("+"), part)
    is_accessible(page)
    change(lambda: view.press("Escape"), "From above (m): all")
    expect(goal(page)).to_have_count(1)


def test_places_on_the_earth_are_drawn_on_a_map(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "fly")
    send(page)
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    name = "Map: position 48.138940, 11.580080; goal route 2 points"
    expect(goal(page).get_by_role("img", name=name)).to_be_visible()


def png(color: tuple[int, int, int], size: int) -> bytes:
    """Return a picture of one color."""
    rows = (b"\0" + bytes(color) * size) * size
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", size, size, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    ]
    body = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


def choose_picture(page: Page, picture: bytes) -> None:
    """Choose a file in the form of `look`."""
    chosen = FilePayload(name="picture.png", mimeType="image/png", buffer=picture)
    page.get_by_label("File for data").set_input_files(chosen)
    expect(page.locator(".goal-form")).to_contain_text(f"{len(picture)} bytes")


def test_a_file_is_sent_as_bytes_and_images_are_drawn(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "look")
    choose_picture(page, png((10, 20, 250), 9))
    send(page, size="5")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    pixel = "[...canvas.getContext('2d').getImageData(2, 2, 1, 1).data, canvas.width]"
    is_drawn = f"([canvas, expected]) => String({pixel}) === String(expected)"
    for name, expected in {
        "Image data of the goal": [10, 20, 250, 255, 9],
        "Image image of the feedback": [50, 200, 0, 255, 5],
        "Image image of the result": [10, 20, 250, 255, 9],
    }.items():
        canvas = goal(page).get_by_role("img", name=name)
        expect(canvas).to_be_visible()
        page.wait_for_function(is_drawn, arg=[canvas.element_handle(), expected])
    expect(goal(page).get_by_label("Result", exact=True)).to_contain_text("iVBORw0KGgo")
    goal(page).get_by_role("button", name="Use as new goal").click()
    goal_id = send(page)
    expect(row(page, goal_id)).to_contain_text("data: iVBORw0KGgo")


def test_bytes_are_entered_as_base64_after_a_file_was_chosen(
    page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot, "look")
    choose_picture(page, png((1, 2, 3), 40))
    page.get_by_label("data", exact=True).fill("b%")
    page.get_by_role("button", name="Send goal").click()
    expect(page.get_by_role("alert")).to_have_text('data: "b%" is not base64')
    page.get_by_label("data", exact=True).fill("AAEC")
    send(page)
    expect(goal(page).get_by_label("Result", exact=True)).to_have_text('"AAEC"')
    expect(goal(page).get_by_role("img", name="Image image of the result")).to_have_count(0)


def test_keys_and_values_are_entered_row_by_row(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "fly")
    labels, areas = (page.get_by_role("group", name=name) for name in ("labels", "areas"))
    expect(areas.get_by_label("key 1")).to_have_value("near")
    areas.get_by_label("radius m").fill("2.5")
    for number, (key, value) in enumerate([("job", "A-7"), ("gone", "x"), ("job", "B")], 1):
        labels.get_by_role("button", name="Add to labels").click()
        expect(labels.get_by_label(f"key {number}")).to_be_focused()
        page.keyboard.type(key)
        labels.get_by_label(f"value {number}", exact=True).fill(value)
    page.get_by_role("button", name="Send goal").click()
    expect(page.get_by_role("alert")).to_have_text('labels: the key "job" is there twice')
    expect(labels.get_by_label("key 3")).to_be_focused()
    labels.get_by_label("key 3").fill("")
    page.get_by_role("button", name="Send goal").click()
    expect(page.get_by_role("alert")).to_have_text("labels: enter a key")
    labels.get_by_label("key 3").fill("by")
    labels.get_by_role("button", name="Remove value 2 of labels").click()
    expect(labels.get_by_role("button", name="Add to labels")).to_be_focused()
    send(page)
    result = goal(page).get_by_label("Result", exact=True)
    expect(result).to_contain_text("labels={'job': 'A-7', 'by': 'B'}")
    expect(result).to_contain_text("areas={'near': Area(radius=2.5)}")
    labels.get_by_role("button", name="Remove value 1 of labels").click()
    goal(page).get_by_role("button", name="Use as new goal").click()
    expect(labels.get_by_label("key 1")).to_have_value("job")


def test_keys_without_names_are_entered_beside_those_with_names(
    page: Page, robot: RobotProcess
) -> None:
    page.goto(robot.url)
    # The first thing that the console does would replace the form.
    expect(page.get_by_role("heading", name="All actions")).to_be_visible()
    page.evaluate(
        """async () => {
            const { GoalForm } = await import("/console/form.js");
            const [integer, text] = [{ type: "integer" }, { type: "string" }];
            const properties = { size: integer };
            const goal = { type: "object", properties, additionalProperties: text };
            window.form = new GoalForm({ goal }, () => {});
            document.getElementById("content").replaceChildren(window.form.element);
            window.form.set({ size: 3, color: "red" });
        }"""
    )
    more = page.get_by_role("group", name="more")
    expect(more.get_by_label("key 1")).to_have_value("color")
    more.get_by_label("value 1", exact=True).fill("blue")
    assert page.evaluate("window.form.field.read()") == {"color": "blue", "size": 3}
    page.evaluate("window.form.set({ size: 4 })")
    expect(more.get_by_label("key 1")).to_have_count(0)
    assert page.evaluate("window.form.field.read()") == {"size": 4}


def test_a_date_and_a_time_are_picked_or_entered(browser: Browser, robot: RobotProcess) -> None:
    context = browser.new_context(timezone_id="Asia/Kolkata")
    there = context.new_page()
    open_action(there, robot, "fly")
    start = there.get_by_label("start", exact=True)
    picker = there.get_by_label("Choose start in the time zone Asia/Calcutta")
    expect(start).to_have_value("2026-01-31T12:00:00Z")
    expect(picker).to_have_value("2026-01-31T17:30")
    picker.fill("2026-02-03T09:05:00")
    expect(start).to_have_value("2026-02-03T09:05:00+05:30")
    there.get_by_label("day").fill("")
    there.get_by_role("button", name="Send goal").click()
    expect(there.get_by_role("alert")).to_have_text("day: enter a date")
    there.get_by_label("day").fill("2026-02-04")
    send(there)
    result = goal(there).get_by_label("Result", exact=True)
    expect(result).to_contain_text("start=datetime.datetime(2026, 2, 3, 9, 5")
    expect(result).to_contain_text("day=datetime.date(2026, 2, 4)")
    start.fill("2026-02-03T03:35:00.123456Z")
    expect(picker).to_have_value(re.compile(r"2026-02-03T09:05"))
    send(there)
    expect(result).to_contain_text("2026, 2, 3, 3, 35, 0, 123456")
    context.close()


def test_feedback_of_text_is_one_text(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "complete")
    send(page, goal="The cup is on  the shelf.")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    text = goal(page).get_by_label("Text of the feedback")
    expect(text).to_have_js_property("textContent", "The cup is on  the shelf.")
    page.reload()
    expect(text).to_have_js_property("textContent", "The cup is on  the shelf.")
    expect(goal(page).get_by_label("Latest feedback")).to_be_hidden()


# To cancel


def test_a_goal_is_canceled_after_a_question(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot)
    goal_id = send(page, order=LONG)
    goal(page).get_by_role("button", name="Cancel goal").click()
    expect(page.get_by_role("button", name="Keep it")).to_be_focused()
    page.keyboard.press("Enter")
    expect(goal(page).locator(".badge")).to_have_text("▶ executing")
    row(page, goal_id).get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Cancel the goal").click()
    expect(goal(page).locator(".badge")).to_have_text("⊘ canceled")


def test_a_cancel_that_is_rejected_shows_the_reason(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "stubborn")
    send(page, order="600")  # seconds, of which it must be active until the cancel
    goal(page).get_by_role("button", name="Cancel goal").click()
    page.get_by_role("button", name="Cancel the goal").click()
    expect(page.get_by_role("alert").first).to_contain_text("the arm must not stop here")


def test_goals_that_wait_show_their_places_and_all_can_be_canceled_at_once(
    page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot, "clean")
    ids = [send(page, room=f"room {number}", minutes="2") for number in range(3)]
    expect(row(page, ids[0]).locator(".badge")).to_have_text("▶ executing")
    expect(row(page, ids[2]).locator(".badge")).to_have_text("◷ waiting, 2 of 2")
    page.get_by_role("button", name="Cancel all").click()
    expect(page.get_by_role("dialog")).to_contain_text("3 active goals")
    expect(page.get_by_role("button", name="Keep them")).to_be_focused()
    page.get_by_role("dialog").get_by_role("button", name="Cancel all").click()
    for goal_id in ids:
        expect(row(page, goal_id).locator(".badge")).to_have_text("⊘ canceled")


# Several pages, and those that come back


def test_another_tab_sees_the_goal_its_sender_and_what_was_sent(
    context: BrowserContext, robot: RobotProcess
) -> None:
    mine, other = context.new_page(), context.new_page()
    open_action(mine, robot)
    goal_id = send(mine, order=LONG)
    other.goto(f"{robot.url}/#/fibonacci/{goal_id}")
    expect(goal(other).get_by_label("Goal", exact=True)).to_contain_text(f'"order": {LONG}')
    expect(goal(other).locator(".facts")).to_contain_text("127.0.0.1")
    expect(goal(other)).to_contain_text(re.compile("Feedback: [1-9]"))
    goal(other).get_by_role("button", name="Cancel goal").click()
    other.get_by_role("button", name="Cancel the goal").click()
    expect(goal(mine).locator(".badge")).to_have_text("⊘ canceled")


def test_a_goal_survives_the_end_of_the_server_and_a_reload_of_the_page(
    page: Page, new_robot: NewRobot
) -> None:
    robot = new_robot()
    open_action(page, robot)
    ended = send(page, order="4")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    active = send(page, order=LONG)
    robot.kill()
    expect(page.locator("#connection")).to_contain_text("lost")
    robot.start()
    expect(page.locator("#connection")).to_have_text("connected")
    expect(row(page, active).locator(".badge")).to_have_text("? unknown")
    send(page, order="5")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    page.goto(f"{robot.url}/#/fibonacci/{ended}")
    page.reload()
    expect(goal(page).get_by_label("Result", exact=True)).to_contain_text("0, 1, 1, 2")
    expect(goal(page)).to_contain_text("Feedback: 3 messages")
    page.get_by_role("button", name="Clear list").click()
    page.get_by_role("button", name="Clear", exact=True).click()
    expect(row(page, ended)).to_have_count(0)


@pytest.mark.parametrize("is_bridged", [False, True], ids=["direct", "bridged"])
def test_the_goals_of_others_are_shown_after_a_stop_in_good_order(
    context: BrowserContext, new_robot: NewRobot, is_bridged: bool
) -> None:
    robot = new_robot()
    page, other = context.new_page(), context.new_page()
    with ExitStack() as stack:
        served = stack.enter_context(BridgeProcess(robot)) if is_bridged else robot
        open_action(page, served)
        before = send(page, order="4")
        robot.end(signal.SIGINT)
        robot.start()
        open_action(other, robot)
        after = send(other, order="5")
        expect(row(page, after).locator(".badge")).to_have_text("✓ succeeded")
        expect(row(page, before)).to_have_count(1)
        expect(page.locator("#connection")).to_have_text("connected")
        send(page, order="6")
        expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")


def test_actions_are_searched(page: Page, robot: RobotProcess) -> None:
    page.goto(robot.url)
    page.get_by_label("Search actions").fill("dri")
    expect(page.get_by_role("navigation").get_by_role("link")).to_have_text(
        ["All actions", "Map", re.compile("arm/drive")]
    )


# A token, a flood, a phone, the keyboard, and everyone


def test_a_token_is_taken_from_the_fragment_or_asked_for(
    context: BrowserContext, new_robot: NewRobot
) -> None:
    robot = new_robot(token="s3cret")
    page = context.new_page()
    page.goto(f"{robot.url}/#token=s3cret")
    expect(page.locator("#connection")).to_have_text("connected")
    expect(page).not_to_have_url(re.compile("s3cret"))
    other = context.new_page()
    other.goto(f"{robot.url}/#token=wrong")
    other.get_by_label("Access token").fill("s3cret")
    other.get_by_role("button", name="Connect").click()
    expect(other.locator("#connection")).to_have_text("connected")
    expect(action(other, "fibonacci")).to_be_visible()


def test_a_flood_of_feedback_leaves_the_page_usable(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot, "flood")
    send(page, **{"rate 1/s": "1000", "seconds": "100"})
    expect(goal(page)).to_contain_text(re.compile(r"Feedback: \d{4}"))
    action(page, "fibonacci").click()
    send(page, order="3")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    action(page, "flood").click()
    page.get_by_role("button", name=re.compile("^Cancel [0-9a-f]{8}$")).click()
    page.get_by_role("button", name="Cancel the goal").click()
    expect(page.locator(".goals .badge").first).to_have_text("⊘ canceled")


def test_the_keyboard_reaches_everything_that_matters(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot)
    page.keyboard.press("n")
    page.keyboard.press("Control+a")
    page.keyboard.type(LONG)
    page.keyboard.press("Control+Enter")
    expect(goal(page).locator(".badge")).to_have_text("▶ executing")
    page.keyboard.press("Escape")
    page.keyboard.press("c")
    page.get_by_role("button", name="Cancel the goal").press("Enter")
    expect(goal(page).locator(".badge")).to_have_text("⊘ canceled")
    page.keyboard.press("Escape")
    expect(goal(page)).to_have_count(0)
    page.keyboard.press("j")
    expect(goal(page)).to_have_count(1)
    page.keyboard.press("/")
    expect(page.get_by_label("Search actions")).to_be_focused()
    page.keyboard.press("Escape")
    page.keyboard.press("?")
    expect(page.get_by_role("dialog")).to_contain_text("Next, previous goal")
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)


# Recordings


def recording(folder: Path) -> Path:
    """Write the recording of two goals, the first of which has driven for three seconds."""
    begin = 1_790_000_000_000_000_000
    ids, second = ["ab" * 16, "cd" * 16], 1_000_000_000
    way = [
        Record(
            begin + step * second,
            "feedback",
            "arm/drive",
            ids[0],
            number=step,
            data={"position": {"x": step, "y": 2 * step}, "battery": 90 - step, "progress": 0.3},
        )
        for step in (1, 2, 3)
    ]
    goal = {"target": {"x": 3, "y": 6}}
    end = begin + 4 * second
    records = [
        Record(begin, "server", "arm/drive", info=DRIVE.info),
        Record(begin, "accepted", "arm/drive", ids[0], client="ann", data=goal),
        Record(begin, "status", "arm/drive", ids[0], "EXECUTING"),
        *way,
        Record(end, "end", "arm/drive", ids[0], "SUCCEEDED", data={"distance": 6.7, "stops": []}),
        Record(end, "rejected", "arm/drive", ids[1], reason="too far", data=goal),
    ]
    file = folder / "today.jsonl"
    file.write_bytes(b"".join(msgspec.json.encode(record) + b"\n" for record in records))
    return file


def test_a_recording_is_shown_in_place_of_the_server(
    page: Page, robot: RobotProcess, tmp_path: Path
) -> None:
    page.goto(robot.url)
    expect(page.locator("#connection")).to_have_text("connected")
    with page.expect_file_chooser() as choosing:
        page.get_by_role("button", name="Open a recording").click()
    choosing.value.set_files(recording(tmp_path))
    expect(page.locator("#connection")).to_have_text("recording today.jsonl")
    rejected = row(page, "cdcdcdcd")
    expect(rejected).to_contain_text("rejected")
    expect(rejected).to_contain_text("too far")
    page.get_by_role("link", name="abababab", exact=True).click()
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    expect(goal(page).locator(".facts")).to_contain_text(re.compile("by ann · 4.0 s"))
    expect(goal(page)).to_contain_text("Feedback: 3 messages")
    expect(goal(page).get_by_label("Result", exact=True)).to_contain_text('"distance": 6.7')
    place = goal(page).get_by_role("img", name="From above (m): position 3, 6; goal target 3, 6")
    expect(place).to_be_visible()
    goal(page).get_by_text("Messages", exact=True).click()
    lines = goal(page).get_by_label("Feedback messages")
    expect(lines).to_contain_text(re.compile(r"3\.000 s.*2\.000 s.*1\.000 s", re.DOTALL))
    for name in ("Send goal", "Use as new goal", "Cancel goal", "Clear list"):
        expect(page.get_by_role("button", name=name)).to_have_count(0)
    is_accessible(page)
    page.get_by_role("button", name="Close", exact=True).click()
    expect(page.locator("#connection")).to_have_text("connected")
    expect(action(page, "fibonacci")).to_be_visible()


def test_a_command_opens_a_recording_in_the_page(page: Page, tmp_path: Path) -> None:
    file = recording(tmp_path)
    with ConsoleProcess(file) as served:
        page.goto(served.address)
        expect(page.locator("#connection")).to_have_text("recording today.jsonl")
        expect(row(page, "cdcdcdcd")).to_contain_text("too far")
        page.get_by_role("link", name="abababab", exact=True).click()
        expect(goal(page)).to_contain_text("Feedback: 3 messages")
        expect(page.get_by_role("button", name="Open a recording")).to_have_count(0)
        page.reload()
        expect(page.locator("#connection")).to_have_text("recording today.jsonl")
        expect(goal(page)).to_contain_text("Feedback: 3 messages")
        file.unlink()
        page.reload()
        expect(page.get_by_role("alert")).to_have_text(
            "today.jsonl cannot be read: the server answers with the status 404"
        )


def test_the_end_of_the_connection_is_not_told_while_a_recording_is_read(
    page: Page, robot: RobotProcess, tmp_path: Path
) -> None:
    file = tmp_path / "notes.jsonl"
    file.write_text(("not JSON".ljust(10_000) + "\n") * 1_000)
    page.goto(robot.url)
    expect(page.locator("#connection")).to_have_text("connected")
    page.evaluate(
        """() => {
            const status = document.getElementById("connection");
            window.told = [];
            const note = () => window.told.push(status.textContent);
            new MutationObserver(note).observe(status, { childList: true });
        }"""
    )
    with page.expect_file_chooser() as choosing:
        page.get_by_role("button", name="Open a recording").click()
    choosing.value.set_files(file)
    expect(page.locator("#connection")).to_have_text("notes.jsonl is not a recording, or is empty")
    *earlier, _ = page.evaluate("window.told")
    assert [text for text in earlier if not text.startswith("recording notes.jsonl, ")] == []


# Parents and children


def test_a_mission_leads_to_its_children_and_they_lead_back(
    context: BrowserContext, page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot, "mission")
    mission = send(page, order="3")
    expect(goal(page).locator(".badge").first).to_have_text("✓ succeeded")
    children = goal(page).get_by_role("list", name="Children").get_by_role("listitem")
    expect(children).to_have_text(
        [
            re.compile(r"the long one: fibonacci [0-9a-f]{8} ✓ succeeded"),
            re.compile(r"the short one: fibonacci [0-9a-f]{8} ✓ succeeded"),
        ]
    )
    children.first.get_by_role("link").click()
    expect(page.get_by_role("heading", name="fibonacci")).to_be_visible()
    facts = goal(page).locator(".family .step")
    expect(facts).to_have_text(f"Step the long one of goal mission {mission}")
    child = goal(page).locator("header code").inner_text()
    expect(row(page, child)).to_contain_text(f"the long one of {mission}")
    page.get_by_label("Search goals").fill(f"{mission} short")
    expect(page.get_by_role("row").filter(has_text="the short one")).to_have_count(1)
    expect(row(page, child)).to_have_count(0)
    facts.get_by_role("link").click()
    expect(page.get_by_role("heading", name="mission")).to_be_visible()
    expect(goal(page).locator("header code")).to_have_text(mission)
    other = context.new_page()
    other.goto(f"{robot.url}/#/fibonacci/{child}")
    expect(goal(other).locator(".family .step")).to_have_text(
        f"Step the long one of goal mission {mission}"
    )


def test_a_parent_that_is_not_known_here_is_no_link_and_a_step_is_text(
    page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot)
    child = page.evaluate(
        """async () => {
            const { Connection } = await import("/fibaction.js");
            const meta = { parent: "ab".repeat(16), step: "<b>lift</b>" };
            const goal = await new Connection("/").sendGoal("fibonacci", { order: 2 }, { meta });
            await goal.outcome;
            return goal.id;
        }"""
    )
    page.get_by_role("link", name=child[:8], exact=True).click()
    family = goal(page).locator(".family")
    expect(family.locator(".step")).to_have_text(
        "Step <b>lift</b> of goal abababab (not known here)"
    )
    expect(family.get_by_role("link")).to_have_count(0)
    expect(family.get_by_role("list")).to_have_count(0)


@pytest.mark.parametrize(
    "name", ["", "fibonacci", "arm/drive", "mission", "look", "complete", "fly"]
)
def test_each_page_is_accessible_and_fits_a_phone(
    page: Page, robot: RobotProcess, name: str
) -> None:
    open_action(page, robot, name or "fibonacci")
    send(page)
    expect(goal(page).locator(".badge").first).to_have_text("✓ succeeded")
    if not name:
        page.goto(f"{robot.url}/#/")
        expect(page.get_by_role("heading", name="All actions")).to_be_visible()
    is_accessible(page)
    fits(page, 360)


def test_a_page_has_the_theme_of_the_system(page: Page, robot: RobotProcess) -> None:
    open_action(page, robot)
    grounds = set[str]()
    for theme in THEMES:
        page.emulate_media(color_scheme=theme, reduced_motion="reduce")
        grounds.add(page.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert len(grounds) == 2


def test_the_theme_can_be_chosen_and_is_remembered(page: Page, robot: RobotProcess) -> None:
    page.emulate_media(color_scheme="light")
    open_action(page, robot)
    button = page.get_by_role("button", name="Theme")
    button.click()
    button.click()
    expect(button).to_have_text("Theme: dark")
    page.reload()
    expect(button).to_have_text("Theme: dark")
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == "rgb(14, 19, 27)"


COUNT_CLOCKS = """
    window.clocks = 0;
    const { get } = Object.getOwnPropertyDescriptor(Intl.DateTimeFormat.prototype, "format");
    Object.defineProperty(Intl.DateTimeFormat.prototype, "format", {
      get() { window.clocks += 1; return get.call(this); },
    });
    const { toLocaleTimeString } = Date.prototype;
    Date.prototype.toLocaleTimeString = function (...given) {
      window.clocks += 1;
      return toLocaleTimeString.apply(this, given);
    };
"""
FRAMES = """
    () => new Promise((done) => {
      let left = 30;
      const next = () => (left-- ? requestAnimationFrame(next) : done(window.clocks));
      next();
    })
"""


def test_a_hundred_active_goals_need_no_clock_for_each_row_and_frame(
    page: Page, new_robot: NewRobot
) -> None:
    robot = new_robot()
    page.add_init_script(COUNT_CLOCKS)
    open_action(page, robot)
    page.evaluate(
        """(body) => {
            const headers = { "Content-Type": "application/json" };
            const send = () => fetch("actions/fibonacci/goals", { method: "POST", headers, body });
            return Promise.all(Array.from({ length: 100 }, send));
        }""",
        f'{{"order": {LONG}}}',
    )
    expect(page.get_by_text("executing").locator("visible=true")).to_have_count(100)
    before = page.evaluate("window.clocks")
    assert page.evaluate(FRAMES) - before < 30


# Feedback that was left, or comes late


def test_a_goal_that_is_left_and_shown_again_has_its_feedback_once(
    context: BrowserContext, robot: RobotProcess
) -> None:
    other, page = context.new_page(), context.new_page()
    open_action(other, robot)
    running = send(other, order=LONG)
    open_action(page, robot)
    for _ in range(3):
        row(page, running).get_by_role("link", name=running, exact=True).click()
        expect(goal(page)).to_contain_text(re.compile("Feedback: [1-9]"))
        action(page, "break").click()
        expect(page.get_by_role("heading", name="break", exact=True)).to_be_visible()
        action(page, "fibonacci").click()
    row(page, running).get_by_role("link", name=running, exact=True).click()
    goal(page).get_by_text("Messages", exact=True).click()
    other.get_by_role("button", name="Cancel goal").click()
    other.get_by_role("button", name="Cancel the goal").click()
    expect(goal(page).locator(".badge")).to_have_text("⊘ canceled")
    expect(goal(page).locator(".reason")).not_to_contain_text("left")
    lines = goal(page).get_by_label("Feedback messages").inner_text().splitlines()
    lengths = [line.count(",") for line in lines]
    assert lengths == sorted(set(lengths), reverse=True)
    times = [float(line.split(" s")[0]) for line in lines]
    assert times == sorted(times, reverse=True)


def test_a_page_that_is_opened_late_has_each_feedback_at_the_time_of_its_report(
    browser: Browser, page: Page, robot: RobotProcess
) -> None:
    open_action(page, robot)
    running = send(page, order="11")
    expect(goal(page).locator(".badge")).to_have_text("✓ succeeded")
    with closing(browser.new_context()) as stranger:
        late = stranger.new_page()
        open_action(late, robot)
        row(late, running).get_by_role("link", name=running, exact=True).click()
        expect(goal(late)).to_contain_text("Feedback: 10 messages")
        goal(late).get_by_text("Messages", exact=True).click()
        lines = goal(late).get_by_label("Feedback messages").inner_text().splitlines()
    times = [float(line.split(" s")[0]) for line in reversed(lines)]
    assert all(after - before > 0.04 for before, after in pairwise(times)), "50 ms, and not at once"
