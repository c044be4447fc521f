"""Descriptions of types: those that a node gives, and those that it takes from others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fibaction.interfaces.files import ActionFile, read_action_texts, read_message_texts
from fibaction_transports.cdr.standard_messages import MESSAGES, action_interface
from fibaction_transports.cdr.type_hashes import type_hash
from fibaction_transports.ros2.without_ros.descriptions import described_types
from fibaction_transports.ros2.without_ros.descriptions.described_types import (
    GET_TYPE_DESCRIPTION,
    DescriptionRequest,
    DescriptionResponse,
    FieldDescription,
    FieldTypeDescription,
    IndividualTypeDescription,
    TypeDescription,
    TypeSource,
    UnusableDescription,
    described_action,
    described_message,
)
from fibaction_transports.ros2.without_ros.messages.action_types import CANCEL_GOAL, action_of
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.ros2.without_ros.messages.message_type import TypeHashes, read_hashes
from fibaction_transports.ros2.without_ros.own_node import TypeRegistry

ALL = "near_msgs/action/All"
TEXTS = {
    ALL: (
        "bool flag\nbyte raw\nuint8 small\nint8 tiny\nuint16 a\nint16 b\nuint32 c\nint32 d 7\n"
        "uint64 e\nint64 f\nfloat32 single 0.5\nfloat64 double\nstring text\nwstring wide\n"
        "string<=3 short\nwstring<=4 shorts\n---\nPart[] parts\nPart[2] two\nPart[<=3] few\n"
        "string<=3[<=2] words\nother_msgs/Thing thing\n---\nuint8[16] octets\nint32[] numbers\n"
    ),
    "near_msgs/msg/Part": "int32 x 5  # from the left\n",
    "other_msgs/msg/Thing": "",
}


def used(texts: dict[str, str] = TEXTS, type_name: str = ALL) -> tuple[TypeRegistry, ActionFile]:
    """Return the registry of a node that uses an action, and the action."""
    file = read_action_texts(type_name, texts)
    registry = TypeRegistry()
    registry.add_messages(action_of(file).impl.FeedbackMessage)
    return registry, file


def hashes(file: ActionFile) -> TypeHashes:
    whole = action_interface(file)
    return TypeHashes(type_hash(whole.nested["feedback_message"]), type_hash(whole))


def plain(file: ActionFile) -> list[Any]:
    """Return the fields of all messages, without where they come from."""
    return [
        (
            one.type_name,
            [(field.type._replace(package=""), field.name) for field in one.definition.fields],
        )
        for one in file.messages()
    ]


@pytest.mark.parametrize("with_sources", [True, False])
def test_an_action_is_described_by_its_hash_and_read_again(with_sources: bool) -> None:
    registry, file = used()
    request = DescriptionRequest(ALL, hashes(file).of_action, with_sources)
    response = registry.answer(request)
    found = described_action(response, ALL, action=hashes(file).of_action)
    assert plain(found) == plain(file)
    (x,) = found.result.nested["parts"].definition.fields
    assert (x.default, x.comment) == ((5, "from the left") if with_sources else (None, ""))
    assert bool(response.type_sources) is with_sources


def test_a_node_describes_what_it_uses_by_hash() -> None:
    registry, file = used()
    whole = action_interface(file)
    registry.add_service(CANCEL_GOAL)
    services = [whole.nested["send_goal_service"], CANCEL_GOAL.definition]
    for one in (whole, whole.nested["feedback_message"], *services):
        response = registry.answer(DescriptionRequest(one.type_name, type_hash(one)))
        assert response.type_description.type_description.type_name == one.type_name
        sources = {source.type_name: source for source in response.type_sources}
        assert sources.keys() == {
            one.type_name,
            *(each.type_name for each in response.type_description.referenced_type_descriptions),
        }
    assert (sources["builtin_interfaces/msg/Time"].encoding) == "implicit"
    for asked, reason in (
        (type_hash(MESSAGES["Gid"]), "Type not currently in use by this node"),
        ("", "Failed to parse type hash"),
    ):
        response = registry.answer(DescriptionRequest(ALL, asked))
        assert (response.successful, response.failure_reason) == (False, reason)


def test_a_type_that_is_not_wholly_known_is_not_described() -> None:
    file = read_action_texts(ALL, TEXTS)
    impl = action_of(file, "find it").impl
    registry = TypeRegistry()
    for end in (impl.SendGoalService, impl.GetResultService):
        registry.add_service(end)
        registry.add_messages(end.Request)
        registry.add_messages(end.Response)
    registry.add_messages(impl.FeedbackMessage)
    interface = action_interface(file)
    for name in ("send_goal_service", "get_result_service"):
        asked = type_hash(interface.nested[name])
        assert not registry.answer(DescriptionRequest(ALL, asked)).successful
    assert impl.SendGoalService.Request.user_data == b""
    assert read_hashes(impl.FeedbackMessage.user_data) == TypeHashes(hashes(file).of_type, "")


def described(*fields: FieldDescription, name: str = f"{ALL}_Feedback") -> DescriptionResponse:
    """Return the description of feedback with these fields."""
    return DescriptionResponse(
        successful=True,
        type_description=TypeDescription(
            IndividualTypeDescription(f"{ALL}_FeedbackMessage"),
            [IndividualTypeDescription(name, list(fields))],
        ),
    )


def field(
    number: int, name: str = "x", default: str = "", nested: str = "", capacity: int = 0
) -> FieldDescription:
    return FieldDescription(name, FieldTypeDescription(number, capacity, 0, nested), default)


def feedback_hash(text: str) -> str:
    return hashes(read_action_texts(ALL, {ALL: f"---\n---\n{text}"})).of_type


@pytest.mark.parametrize(
    ("default", "value"), [("7", 7), ("seven", None), ("7\nint32 y", None), ("=3", None)]
)
def test_a_default_that_is_not_one_is_left_out(default: str, value: int | None) -> None:
    response = described(field(6, default=default))
    found = described_action(response, ALL, feedback=feedback_hash("int32 x\n"))
    assert [one.default for one in found.feedback.definition.fields] == [value]


@pytest.mark.parametrize("text", ["int33 x\n---\n", "---\n---\nint64 x\n"])
def test_sources_that_do_not_fit_are_left_out(text: str) -> None:
    response = described(field(6))
    response.type_sources = [
        TypeSource(ALL, "action", text),
        TypeSource("else_msgs/msg/Where", "msg", "int33 x"),
    ]
    found = described_action(response, ALL, feedback=feedback_hash("int32 x\n"))
    assert plain(found)[-1][1][0][0].base == "int32"


@pytest.mark.parametrize(
    ("response", "problem"),
    [
        (DescriptionResponse(failure_reason="not today"), "not today"),
        (described(field(7)), "it has another hash"),
        (described(field(6), name="else_msgs/action/All_Feedback"), "it has another hash"),
        (described(field(13)), "it has a field of the type 13, which files cannot have"),
        (described(field(255)), "it has a field of the type 255, which files cannot have"),
        (described(field(6, name="X")), "expected a field's name"),
        (described(field(6), field(6)), "expected a unique name"),
        (described(field(54, capacity=10**18)), "expected a type like"),
        (described(field(54, capacity=10**6)), "it has more than 100,000 values"),
        (described(field(1, nested="far_msgs/msg/Gone")), "expected 'far_msgs/Gone'"),
        (described(field(1, nested="../../etc/passwd")), "expected a type like"),
        (described(field(6, name="x\n---\nint32 y")), "expected two lines '---'"),
    ],
)
def test_a_description_that_cannot_be_used_is_an_error(
    response: DescriptionResponse, problem: str
) -> None:
    with pytest.raises(UnusableDescription) as caught:
        described_action(response, ALL, feedback=feedback_hash("int32 x\n"))
    assert problem in str(caught.value)


def test_a_name_that_is_not_that_of_an_action_is_an_error() -> None:
    with pytest.raises(UnusableDescription, match="expected a type like"):
        described_action(described(field(6)), "All", feedback=feedback_hash("int32 x\n"))


def test_the_hashes_of_an_endpoint_are_read_whatever_else_it_announces(tmp_path: Path) -> None:
    one, other = (f"RIHS01_{digit * 64}" for digit in "ab")
    data = f"serviceid= 1.10;typehash={one};actionhash={other};".encode()
    assert read_hashes(data) == TypeHashes(one, other)
    assert read_hashes(b"\xff;typehash=RIHS01_12;") == TypeHashes()
    assert FileTypes([tmp_path]).has_file("std_msgs/msg/String")
    assert GET_TYPE_DESCRIPTION.definition.type_name.endswith("/GetTypeDescription")


def test_a_message_counts_if_it_has_the_announced_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    name, texts = "near_msgs/msg/Part", {"near_msgs/msg/Part": "int32 x 5\n"}
    wanted = type_hash(read_message_texts(name, texts))
    registry, _ = used()
    part = registry.answer(DescriptionRequest(ALL, hashes(used()[1]).of_action))
    # What an action nests is described with it; a message of its own is the first of a response.
    individual = next(
        one for one in part.type_description.referenced_type_descriptions if one.type_name == name
    )

    def told(*sources: TypeSource) -> DescriptionResponse:
        return DescriptionResponse(
            successful=True,
            type_description=TypeDescription(individual),
            type_sources=list(sources),
        )

    source = TypeSource(name, "msg", "int32 x 5  # from the left\n")
    assert described_message(told(source), name, wanted).definition.fields[0].default == 5
    malformed = TypeSource(name, "msg", "int32\n")
    assert described_message(told(malformed), name, wanted).type_name == name
    with pytest.raises(UnusableDescription, match="it has another hash"):
        described_message(told(), name, wanted[:-1])
    with pytest.raises(UnusableDescription, match="not in use"):
        described_message(DescriptionResponse(failure_reason="not in use"), name, wanted)
    monkeypatch.setattr(described_types, "MOST_VALUES", 1)
    with pytest.raises(UnusableDescription, match="it has more than 1 values"):
        described_message(told(), name, wanted)
