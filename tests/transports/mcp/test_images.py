"""Images in feedback and results: a model gets them as images."""

from __future__ import annotations

import base64
from collections.abc import AsyncGenerator
from typing import Annotated, Any

import anyio
import msgspec
import pytest
from mcp import Client
from mcp_types import ImageContent

from fibaction import Action, ActionServer, GoalHandle, serve
from fibaction_transports.inprocess import InProcessTransport
from fibaction_transports.mcp import McpBridge, answers
from fibaction_transports.mcp.answers import Images
from tests.support.processes import PATIENCE
from tests.transports.mcp.robot import UNASKED

PNG = b"\x89PNG\r\n\x1a\n and so on"
JPEG = b"\xff\xd8\xff\xe0 and so on"
WEBP = b"RIFF\x10\x00\x00\x00WEBPVP8 "
SVG = msgspec.Meta(extra_json_schema={"contentMediaType": "image/svg+xml"})


class View(msgspec.Struct):
    """What a camera sees."""

    picture: bytes
    drawing: Annotated[bytes, SVG] = b""


class Seen(msgspec.Struct):
    views: list[View]
    raw: bytes


LOOK = Action("look", goal=int, feedback=View, result=Seen)


def taken(message: Any) -> tuple[Any, list[ImageContent]]:
    found = Images()
    return found.take(message, LOOK.info.result), found.found


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (PNG, "image/png"),
        (JPEG, "image/jpeg"),
        (b"GIF89a..", "image/gif"),
        (b"GIF87a..", "image/gif"),
        (WEBP, "image/webp"),
    ],
)
def test_an_image_is_known_by_its_beginning(data: bytes, kind: str) -> None:
    view = {"picture": data, "drawing": b""}
    message, (image,) = taken({"views": [view], "raw": b"RIFF1234WAVE"})
    assert (image.mime_type, base64.b64decode(image.data)) == (kind, data)
    name = f"image 1: {kind}, {len(data)} bytes"
    assert message == {"views": [view | {"picture": name}], "raw": b"RIFF1234WAVE"}


def test_an_image_is_known_by_the_content_type_of_its_field() -> None:
    message, found = taken({"views": [{"picture": b"<svg/>", "drawing": b"<svg/>"}]})
    assert [one.mime_type for one in found] == ["image/svg+xml"]
    assert message["views"][0]["picture"] == b"<svg/>"


def test_images_that_are_too_many_or_too_large_stay_as_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(answers, "LARGEST_IMAGE", len(PNG))
    monkeypatch.setattr(answers, "MOST_IMAGES", 1)
    message, found = taken([PNG + b"!", PNG, PNG])
    assert len(found) == 1
    assert (message[0], message[2]) == (PNG + b"!", PNG)


def test_images_are_looked_for_to_a_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers, "DEEPEST", 2)
    message, found = taken([[PNG], [[PNG]]])
    assert len(found) == 1
    assert message[1] == [[PNG]]


@pytest.mark.asyncio
async def test_a_model_gets_the_images_of_a_goal() -> None:
    go_on = anyio.Event()

    async def look(goal: GoalHandle[int]) -> AsyncGenerator[View | Seen, None]:
        yield View(PNG)
        await go_on.wait()
        yield Seen([View(JPEG)], b"raw")

    here = InProcessTransport()
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(LOOK, look), here),
            McpBridge(here, UNASKED) as bridge,
            Client(bridge.server) as client,
        ):
            sent: Any = await client.call_tool("send_goal", {"tool": "look", "goal": {"goal": 1}})
            about = {"goal_id": sent.structured_content["goal_id"]}
            seen: Any = sent
            while len(seen.content) == 1:
                seen = await client.call_tool("goal_status", about | {"wait": 0.1})
            assert seen.content[1].mime_type == "image/png"
            assert seen.structured_content["feedback"]["picture"].startswith("image 1: ")
            go_on.set()
            ended: Any = await client.call_tool("goal_status", about | {"wait": 20})
            assert base64.b64decode(ended.content[1].data) == JPEG
            again: Any = await client.call_tool("look", {"goal": 2})
            assert again.content[1].mime_type == "image/jpeg"
            assert again.structured_content["result"]["raw"] == "cmF3"
