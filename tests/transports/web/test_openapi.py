"""`fibaction_transports.web.rest.openapi`: the description is valid, for any schemas."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from openapi_spec_validator import validate

from fibaction import Action
from fibaction.types.action import ActionInfo
from fibaction_transports.web.rest.openapi import describe
from tests.support.fibonacci import FIBONACCI


class Arm(msgspec.Struct):
    name: str
    parts: list[Arm] = []


ARM: Action[Any, Any, Any] = Action("/left/arm", goal=Arm, feedback=int, result=str)


def described(*infos: ActionInfo, tokens: bool = False) -> Any:
    made = msgspec.json.decode(
        msgspec.json.encode(describe(infos, "/robot", asks_for_tokens=tokens))
    )
    validate(made)
    return made


@pytest.mark.parametrize("tokens", [False, True])
def test_it_is_valid_openapi(tokens: bool) -> None:
    made = described(FIBONACCI.info, ARM.info, tokens=tokens)
    assert ("security" in made) is tokens
    assert made["servers"] == [{"url": "/robot"}]
    assert set(made["paths"]["/actions/fibonacci/goals"]) == {"get", "post", "delete"}
    assert "/actions/%2Fleft%2Farm/goals/{goal_id}/events" in made["paths"]


@pytest.mark.parametrize("names", [("arm", "arm/goals"), ("arm/goals", "arm")], ids=" ".join)
def test_a_list_of_goals_comes_before_an_action_of_the_same_address(names: tuple[str, ...]) -> None:
    paths = described(*map(ActionInfo, names))["paths"]

    assert set(paths["/actions/arm/goals"]) == {"get", "post", "delete"}
    assert paths["/actions/arm/goals"]["get"]["operationId"] == "list.arm"
    assert "post" in paths["/actions/arm/goals/goals"]


def test_references_lead_to_where_the_definitions_are() -> None:
    schemas = described(ARM.info)["components"]["schemas"]
    assert schemas[".left.arm.goal"] == {"$ref": "#/components/schemas/.left.arm.goal.Arm"}
    parts = schemas[".left.arm.goal.Arm"]["properties"]["parts"]
    assert parts["items"] == {"$ref": "#/components/schemas/.left.arm.goal.Arm"}


def test_a_schema_of_itself_refers_to_itself() -> None:
    tree = {"type": "object", "properties": {"next": {"$ref": "#"}}}
    made = described(ActionInfo("tree", "", tree, {}, {}))
    moved = made["components"]["schemas"]["tree.goal"]
    assert moved["properties"]["next"] == {"$ref": "#/components/schemas/tree.goal"}


def test_a_schema_that_is_too_deep_is_left_out() -> None:
    deep: dict[str, Any] = {}
    for _ in range(100_000):
        deep = {"items": deep}
    made = described(ActionInfo("deep", "", deep, {}, {}))
    assert made["components"]["schemas"]["deep.goal"] == {}
