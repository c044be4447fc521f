"""`fibaction_transports.web.rest.openapi`: the description is valid, for any schemas."""

from __future__ import annotations

import json
import re
from datetime import datetime, time, timedelta
from decimal import Decimal
from typing import Any

import msgspec
import pytest
from openapi_spec_validator import validate

from fibaction import Action
from fibaction.schema.payload import JsonCodec
from fibaction.types.action import ActionInfo
from fibaction.words.goal_query import cancel_stamp_of
from fibaction_transports.web.rest.goal_list import page_of
from fibaction_transports.web.rest.openapi import describe
from fibaction_transports.web.rest.openapi_schemas import LARGEST_EXAMPLE, PATTERNS
from fibaction_transports.web.rest.routes import METHODS, PARAMETERS, Resource
from tests.support.fibonacci import FIBONACCI
from tests.support.nested_actions import COUNT, FETCH


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
    assert made["security"] == ([{"token": []}] if tokens else [])
    assert made["servers"] == [{"url": "/robot"}]
    assert set(made["paths"]["/actions/fibonacci/goals"]) == {"get", "post", "delete"}
    assert "/actions/%2Fleft%2Farm/goals/{goal_id}/events" in made["paths"]


@pytest.mark.parametrize("names", [("arm", "arm/goals"), ("arm/goals", "arm")], ids=" ".join)
def test_a_list_of_goals_comes_before_an_action_of_the_same_address(names: tuple[str, ...]) -> None:
    paths = described(*map(ActionInfo, names))["paths"]

    assert set(paths["/actions/arm/goals"]) == {"get", "post", "delete"}
    assert paths["/actions/arm/goals"]["get"]["operationId"] == "list.arm"
    assert "post" in paths["/actions/arm/goals/goals"]


def schemas_of(*infos: ActionInfo) -> Any:
    return described(*infos)["components"]["schemas"]


def shared(name: str) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{name}"}


def test_all_references_and_discriminators_lead_to_where_the_definitions_are() -> None:
    schemas = schemas_of(FETCH.info, COUNT.info, ARM.info)
    target = schemas["fetch.goal"]["properties"]["target"]
    variants = [shared("fetch.goal.ToPoint"), shared("fetch.goal.ToShelf")]
    assert target["anyOf"] == variants
    assert target["discriminator"]["mapping"] == {
        "point": variants[0]["$ref"],
        "shelf": variants[1]["$ref"],
    }
    found = re.findall(r'"#/components/schemas/([^"]+)"', json.dumps(schemas))
    assert set(found) <= set(schemas)
    assert schemas["fetch.goal.Part"]["properties"]["parts"]["items"] == shared("fetch.goal.Part")


@pytest.mark.parametrize(
    ("schema", "moved"),
    [
        ({"$ref": "#/$defs/a~1b/items", "$defs": {"a/b": {"items": {}}}}, "odd.goal.a.b/items"),
        ({"$ref": "#/$defs/a%20b/items", "$defs": {"a b": {"items": {}}}}, "odd.goal.a.b/items"),
        ({"$ref": "#/$defs/no", "$defs": {"no": True}}, "odd.goal.no"),
        ({"$ref": "#/$defs/missing"}, None),
        ({"$ref": "https://elsewhere.example/schema"}, None),
        ({"$ref": 7}, None),
        ({"$ref": "#/$defs/missing", "$defs": []}, None),
    ],
)
def test_a_reference_that_leads_nowhere_allows_any_value(schema: Any, moved: str | None) -> None:
    goal = schemas_of(ActionInfo("odd", "", schema, {}, {}))["odd.goal"]
    if moved is None:
        assert goal == {}
    else:
        assert goal["$ref"] == shared(moved)["$ref"]


def test_a_variant_that_leads_nowhere_is_left_out_of_the_mapping() -> None:
    choice = {"discriminator": {"propertyName": "t", "mapping": {"a": "#/$defs/a", "b": "b"}}}
    plain = {"discriminator": {"propertyName": "t"}}
    schema = {"properties": {"choice": choice, "plain": plain}, "$defs": {"a": {}}}
    goal = schemas_of(ActionInfo("odd", "", schema, {}, {}))["odd.goal"]
    mapping = goal["properties"]["choice"]["discriminator"]["mapping"]
    assert mapping == {"a": "#/components/schemas/odd.goal.a"}
    assert goal["properties"]["plain"] == plain


def test_no_two_schemas_or_operations_have_the_same_name_for_a_generator() -> None:
    part = {"$defs": {"Goal": {"title": "Goal"}, "goal": {"title": "Goal"}}, "title": "Goal"}
    infos = [ActionInfo(name, "", part, part, part) for name in ("arm", "/arm", "arm/goal", "Arm")]
    made = described(*infos)
    schemas = made["components"]["schemas"]
    assert not any("title" in schema for schema in schemas.values())
    ids = [one["operationId"] for path in made["paths"].values() for one in path.values()]
    for names in (list(schemas), ids):
        plain = [re.sub("[^a-z0-9]", "", name.lower()) for name in names]
        assert len(plain) == len(set(plain))


def test_a_goal_allows_what_the_server_accepts() -> None:
    goal = schemas_of(FETCH.info)["fetch.goal"]
    assert goal["additionalProperties"] is False
    assert re.fullmatch(goal["properties"]["label"]["pattern"], "AAE=")
    assert not re.fullmatch(goal["properties"]["label"]["pattern"], "AAE")
    number = schemas_of(FETCH.info)["fetch.goal.ToShelf"]["properties"]["number"]
    assert (number["minimum"], number["maximum"]) == (-(2**63), 2**64 - 1)
    result = schemas_of(FETCH.info)["fetch.result"]
    assert "additionalProperties" not in result
    limits = {"type": "integer", "exclusiveMinimum": 0, "exclusiveMaximum": 9}
    limited = schemas_of(ActionInfo("odd", "", limits, {}, {}))["odd.goal"]
    assert limited == limits


@pytest.mark.parametrize(
    "schema",
    [
        {"allOf": [{"properties": {"a": {}}}, {"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "anyOf": [{"properties": {"b": {}}}]},
        {"properties": {"a": {}}, "$ref": "#/$defs/b", "$defs": {"b": {"properties": {"b": {}}}}},
    ],
)
def test_types_that_are_described_in_parts_allow_the_fields_of_each_other(schema: Any) -> None:
    made = schemas_of(ActionInfo("odd", "", schema, {}, {}))
    assert "additionalProperties" not in json.dumps(
        {name: part for name, part in made.items() if name.startswith("odd.goal")}
    )


def test_the_values_of_defaults_are_no_schemas() -> None:
    schema = {"properties": {"a": {"default": [{"$ref": "#", "properties": {}}]}}}
    goal = schemas_of(ActionInfo("odd", "", schema, {}, {}))["odd.goal"]
    assert goal["properties"]["a"] == schema["properties"]["a"]


def test_a_default_that_is_an_object_is_left_out_for_generators_that_take_none() -> None:
    schema = {"properties": {"a": {"default": {}}, "b": {"default": 1}}}
    goal = schemas_of(ActionInfo("odd", "", schema, {}, {}))["odd.goal"]
    assert goal["properties"] == {"a": {}, "b": {"default": 1}}


def test_the_parameters_are_those_that_the_server_takes() -> None:
    paths = described(FETCH.info)["paths"]
    of_goals = "/actions/fetch/goals"
    for resource, path in {
        Resource.GOALS: of_goals,
        Resource.GOAL: f"{of_goals}/{{goal_id}}",
        Resource.EVENTS: f"{of_goals}/{{goal_id}}/events",
    }.items():
        for method in METHODS[resource]:
            parameters = paths[path][method.lower()].get("parameters", [])
            told = [one["name"] for one in parameters if one["in"] == "query"]
            assert sorted(told) == sorted(PARAMETERS.get((resource, method), ()))


def test_parameters_allow_what_the_server_accepts() -> None:
    paths = described(FETCH.info)["paths"]
    goals, events = paths["/actions/fetch/goals"], paths["/actions/fetch/goals/{goal_id}/events"]
    wait, label, key = goals["post"]["parameters"]
    assert (key["name"], key["in"]) == ("Idempotency-Key", "header")
    assert wait["schema"]["maximum"] == 3600
    assert (label["name"], label["schema"]["maxItems"]) == ("label", 8)
    *_, before = goals["delete"]["parameters"]
    date_time, other = before["schema"]["anyOf"]
    assert date_time == {"format": "date-time"}
    for text in ("1", "10m", "1.5h", str(10**30), f"{1:019}"):
        assert re.search(other["pattern"], text)
        assert cancel_stamp_of(text, 10**18, is_local=False)
    assert not any(re.search(other["pattern"], text) for text in ("", "0", "0" * 19, "now"))
    goal_id, after, times = (one["schema"] for one in events["get"]["parameters"])
    assert times == {"type": "boolean"}
    goal_id, after = goal_id["pattern"], after["pattern"]
    assert not re.fullmatch(goal_id, "0" * 32)
    assert re.fullmatch(goal_id, f"{1:032x}")
    assert all(re.fullmatch(after, one) for one in ("17", "2.17", "end"))
    assert not any(re.fullmatch(after, one) for one in ("", "x", "0.1"))


def test_a_choice_of_goals_allows_what_the_server_accepts() -> None:
    listing = described(FETCH.info)["paths"]["/actions/fetch/goals"]["get"]["parameters"]
    schemas = {one["name"]: one["schema"] for one in listing}
    words = schemas["status"]["items"]["enum"]
    assert words[:3] == ["active", "ended", "ACCEPTED"]
    for name in ("since", "until"):
        date_time, other = schemas[name]["anyOf"]
        assert date_time == {"format": "date-time"}
        for text in ("10m", "1.5h", "1769860800000000000", "2026-01-31T12:00:00Z"):
            wanted = page_of({"status": words, "client": ["me"], name: [text]}, 10**18).wanted
            assert getattr(wanted, name) is not None
            assert bool(re.search(other["pattern"], text)) is not ("T" in text)
        assert not any(re.search(other["pattern"], text) for text in ("", "10", "10w", "m"))
    label = schemas["label"]["items"]["pattern"]
    wanted = page_of({"label": ["order=17", "note=", "note="]}, 10**18).wanted
    assert wanted.labels == (("order", "17"), ("note", ""))
    assert all(re.search(label, text) for text in ("order=17", "note=", "steps=3"))
    assert not any(re.search(label, text) for text in ("", "order", "=17", "step=3"))


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


class Span(msgspec.Struct):
    length: timedelta


def test_a_duration_has_the_format_and_the_pattern_that_its_server_reads() -> None:
    span: Action[Any, Any, Any] = Action("span", goal=Span, feedback=int, result=str)
    length = schemas_of(span.info)["span.goal"]["properties"]["length"]
    assert length["format"] == "iso-duration"
    assert length["pattern"] == PATTERNS["iso-duration"]


def example(schema: dict[str, Any]) -> Any:
    made = described(ActionInfo("move", "", schema, {}, {}))
    body = made["paths"]["/actions/move/goals"]["post"]["requestBody"]
    return body["content"]["application/json"].get("example")


def test_the_example_of_a_goal_is_one_that_the_server_accepts() -> None:
    schema = ARM.info.goal
    assert ARM.goal.decode(JsonCodec(schema).encode(example(schema))) == Arm("")


def test_a_goal_has_no_example_if_it_would_be_large_or_cannot_be_made() -> None:
    large = {"default": "x" * (LARGEST_EXAMPLE // 3)}
    fields = {name: {"$ref": "#/$defs/Large"} for name in "abcd"}
    assert example({"properties": fields, "$defs": {"Large": large}}) is None
    assert example({"default": [[0]] * LARGEST_EXAMPLE}) is None
    assert example({"type": "array", "minItems": 10_000}) is None
    assert example({"properties": {"a": {"default": {"b": [1, None]}}}}) == {"a": {"b": [1, None]}}


@pytest.mark.parametrize(
    ("name", "kind", "right", "wrong"),
    [
        (
            *("iso-date-time", datetime),
            ["2024-02-29T23:59:59.5Z", "2026-12-31 00:00:00", "0001-01-01t00:00:00+05:30"],
            ["2026-02-29T00:00:00Z", "2026-04-31T00:00:00Z", "1900-02-29T00:00:00Z", "2026-01-31"],
        ),
        ("date-time-local", datetime, ["2000-02-29T00:00:00"], ["2026-01-31T00:00Z"]),
        ("iso-time", time, ["23:59:59", "00:00:00.25+01:00"], ["24:00:00", "12:00"]),
        ("partial-time", time, ["12:00:00"], ["12:60:00"]),
        (
            "iso-duration",
            timedelta,
            ["P1D", "-P1DT2H", "PT0.5S", "PT1H30M"],
            ["P", "PT", "P1Y", "P2W"],
        ),
        ("decimal", Decimal, ["1", "-1.50", ".5", "1.", "1E+5", "NaN"], ["", ".", "1,5", "1e"]),
    ],
)
def test_the_pattern_of_a_format_fits_what_is_read(
    name: str, kind: Any, right: list[str], wrong: list[str]
) -> None:
    for text in right:
        assert re.search(PATTERNS[name], text)
        msgspec.convert(text, kind)
    for text in wrong:
        assert not re.search(PATTERNS[name], text)
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(text, kind)


def test_the_body_of_an_action_that_needs_no_goal_may_be_null_or_empty() -> None:
    def bodies(goal: Any) -> list[dict[str, Any]]:
        action = Action[Any, Any, Any]("act", goal=goal, feedback=int, result=int)
        paths = describe([action.info], "", asks_for_tokens=False)["paths"]
        at = [paths["/actions/act/goals"]["post"], paths["/actions/act/goals/{goal_id}"]["put"]]
        return [one["requestBody"]["content"]["application/json"]["schema"] for one in at]

    optional = msgspec.defstruct("Optional", [("a", int, 1)])
    needed = msgspec.defstruct("Needed", [("a", int)])
    for schema in bodies(optional):
        _, empty = schema["anyOf"]
        assert (empty["type"], empty["maxProperties"]) == (["null", "object"], 0)
    assert bodies(needed) == [{"$ref": "#/components/schemas/act.goal"}] * 2
