"""The official tests of JSON Schema (draft 2020-12), with each exclusion and its reason.

`data/json_schema_2020_12.json.gz` has the files of `tests/draft2020-12` of
https://github.com/json-schema-org/JSON-Schema-Test-Suite at commit 44401e0c, each with its groups:
the description, the schema, and the tests (description, data, whether it is valid). The license of
the suite is next to it.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from fibaction.schema.check import Check, JsonSchema, SchemaError
from fibaction.schema.parts import SchemaParts

DATA = Path(__file__).with_name("data") / "json_schema_2020_12.json.gz"
LEFT_TO_THE_SERVER = {
    **dict.fromkeys(("pattern", "patternProperties"), "a short regular expression can take years"),
    **dict.fromkeys(("contains", "minContains", "maxContains"), "no type has it"),
    **dict.fromkeys(("dependentRequired", "dependentSchemas", "dependencies"), "no type has it"),
    **dict.fromkeys(("if", "unevaluatedItems", "unevaluatedProperties"), "no type has it"),
    "$dynamicRef": "only a schema that others extend has it",
}
"""Keywords that are not compared, so that data may pass that is not valid."""
FORMATS = {
    **dict.fromkeys(
        ("date", "date-time", "duration", "time", "uuid"),
        "what msgspec or pydantic reads passes, and is more than RFC 3339 and RFC 9562 allow",
    ),
    **dict.fromkeys(("email", "idn-email", "hostname", "idn-hostname"), "not a type of msgspec"),
    **dict.fromkeys(("ipv4", "ipv6", "json-pointer"), "not a type of msgspec"),
    **dict.fromkeys(("iri", "iri-reference", "uri", "uri-reference"), "not a type of msgspec"),
    **dict.fromkeys(("relative-json-pointer", "uri-template", "regex"), "not a type of msgspec"),
}
"""Formats of which data may pass that is not valid."""
UNKNOWN_FIELD = "a schema with fields allows no others: the author of one expects an effect"
DEFAULT = "a default that is missing is filled in, and then checked"
BASE64 = "text in base64 is sent as bytes, so it has to be base64"
FORMAT = "a format is checked, as the types of servers check it"
LEAP = "neither Python nor msgspec has leap seconds"
TOO_STRICT = {
    ("additionalProperties", "additional properties are allowed"): UNKNOWN_FIELD,
    ("anyOf", "both anyOf valid (complex)"): UNKNOWN_FIELD,
    ("not", "property absent"): UNKNOWN_FIELD,
    ("properties", "doesn't invalidate other properties"): UNKNOWN_FIELD,
    ("not", "unevaluated property"): "`unevaluatedProperties` is not compared, and here in a `not`",
    ("unevaluatedProperties", "no extra properties"): "two places describe the fields of a field",
    (
        "vocabulary",
        "no validation: invalid number, but it still validates",
    ): "no vocabulary is read",
    ("default", "still valid when the invalid default is used"): DEFAULT,
    ("default", "missing properties are not filled in with the default"): DEFAULT,
    ("content", "an invalid base64 string (% is not a valid character); validates true"): BASE64,
    ("content", "an invalid base64 string that is valid JSON; validates true"): BASE64,
    **{
        ("format", f"invalid {kind} string is only an annotation by default"): FORMAT
        for kind in ("date", "date-time", "time", "uuid", "duration")
    },
    ("optional/format/date-time", "a valid date-time with a leap second, UTC"): LEAP,
    ("optional/format/date-time", "a valid date-time with a leap second, with minus offset"): LEAP,
    ("optional/format/time", "a valid time string with leap second, Zulu"): LEAP,
    **{
        ("optional/format/time", f"valid leap second, {offset} time-offset"): LEAP
        for offset in ("zero", "positive", "large positive", "negative", "large negative")
    },
}
"""Tests with data that is valid and does not pass, with the reason."""


class Case(NamedTuple):
    """One test of the suite."""

    file: str
    name: str
    schema: Any
    data: Any
    is_valid: bool

    def __hash__(self) -> int:
        return id(self)

    @property
    def is_left_to_the_server(self) -> bool:
        """True if the schema has something that is not compared."""
        whole = isinstance(self.schema, dict) and self.schema.get("format") in FORMATS
        return whole or not LEFT_TO_THE_SERVER.keys().isdisjoint(words(self.schema))


def words(schema: Any) -> Iterator[str]:
    """Yield all keys in a schema."""
    inner = schema.values() if isinstance(schema, dict) else schema
    if isinstance(schema, dict):
        yield from schema
    if isinstance(schema, (dict, list)):
        for part in inner:
            yield from words(part)


def cases() -> Iterator[Case]:
    for file, groups in json.loads(gzip.decompress(DATA.read_bytes())).items():
        for _, schema, tests in groups:
            for name, data, is_valid in tests:
                yield Case(file, name, schema, data, is_valid)


def passes(case: Case) -> bool | None:
    """Return whether the data of a test passes; None if its schema refers to something else."""
    try:
        root = SchemaParts(JsonSchema(case.schema)).root
        return not root.tried(Check(1000), case.data)[1]
    except SchemaError as exc:
        return None if "only references such as" in str(exc) else False


def test_data_passes_that_the_official_tests_call_valid_and_only_that() -> None:
    found = {case: passes(case) for case in cases()}
    strict = [one for one, fits in found.items() if fits is False and one.is_valid]
    lenient = [one for one, fits in found.items() if fits and not one.is_valid]
    assert {(one.file, one.name) for one in strict} == TOO_STRICT.keys()
    assert [one for one in lenient if not one.is_left_to_the_server] == []
    agreed = sum(fits is one.is_valid for one, fits in found.items())
    assert (agreed > 1500, list(found.values()).count(None) < 150) == (True, True)


def test_a_reference_of_the_suite_that_leaves_the_schema_is_refused_and_not_fetched() -> None:
    remote = [case for case in cases() if case.file == "refRemote"]
    assert remote
    for case in remote:
        with pytest.raises(SchemaError, match="nothing is fetched"):
            SchemaParts(JsonSchema(case.schema)).root.tried(Check(1000), case.data)
