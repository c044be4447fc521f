"""Which writers serve which readers, and the sentences that say why not."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from fibaction_transports.rtps.messages import parameters as pids
from fibaction_transports.rtps.messages.parameters import Parameters, text_value
from fibaction_transports.rtps.qos import (
    Durability,
    Liveliness,
    Qos,
    Reliability,
    mismatches,
    qos_items,
    read_qos,
)

MISMATCHES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "reliability: the writer offers best_effort, the reader requests reliable": (
        {"reliability": Reliability.BEST_EFFORT},
        {},
    ),
    "durability: the writer offers volatile, the reader requests transient_local": (
        {},
        {"durability": Durability.TRANSIENT_LOCAL},
    ),
    "deadline: the writer offers inf s, the reader requests 2 s": ({}, {"deadline": 2.0}),
    "liveliness: the writer offers automatic, the reader requests by_topic": (
        {},
        {"liveliness": Liveliness.BY_TOPIC},
    ),
    "liveliness lease: the writer offers 3 s, the reader requests 1.5 s": (
        {"liveliness_lease": 3.0},
        {"liveliness_lease": 1.5},
    ),
    "destination order: the writer offers 0, the reader requests 1": (
        {},
        {"destination_order": 1},
    ),
    "ownership: one end is shared, the other exclusive": ({"ownership": 1}, {}),
    "partitions: a, b and c have none in common": (
        {"partitions": ("a", "b")},
        {"partitions": ("c",)},
    ),
    "data representation: the reader does not accept the form of the writer": (
        {"representations": (2, 0)},
        {"representations": (0,)},
    ),
}


@pytest.mark.parametrize("reason", MISMATCHES)
def test_a_mismatch_has_its_reason(reason: str) -> None:
    offered, requested = MISMATCHES[reason]
    assert mismatches(Qos(**offered), Qos(**requested)) == [reason]


def test_a_writer_that_offers_more_serves_a_reader_that_requests_less() -> None:
    offered = Qos(
        durability=Durability.TRANSIENT_LOCAL,
        deadline=1.0,
        liveliness=Liveliness.BY_TOPIC,
        liveliness_lease=1.0,
        destination_order=1,
        partitions=("a", "b"),
        depth=1,
    )
    requested = Qos(
        reliability=Reliability.BEST_EFFORT,
        deadline=2.0,
        partitions=("b",),
        depth=None,
        representations=(2, 0),
    )
    assert mismatches(offered, requested) == []
    assert mismatches(Qos(), Qos()) == []


@pytest.mark.parametrize("seconds", [0.1, 0.3, 1 / 3, 2.0])
def test_equal_durations_match_although_they_are_rounded_on_the_wire(seconds: float) -> None:
    qos = Qos(deadline=seconds, liveliness_lease=seconds)
    told = read_qos(Parameters(tuple(qos_items(qos))), is_writer=True)
    assert mismatches(told, qos) == mismatches(qos, told) == []


@pytest.mark.parametrize("depth", [1, None])
def test_what_is_announced_is_read(depth: int | None) -> None:
    qos = Qos(
        reliability=Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL,
        depth=depth,
        deadline=0.5,
        liveliness=Liveliness.BY_TOPIC,
        liveliness_lease=1.25,
        lifespan=10.0,
    )
    assert read_qos(Parameters(tuple(qos_items(qos))), is_writer=True) == qos


def test_the_defaults_of_dds_hold_for_what_is_left_out() -> None:
    writer = read_qos(Parameters(()), is_writer=True)
    reader = read_qos(Parameters(()), is_writer=False)
    assert (writer.reliability, reader.reliability) == (
        Reliability.RELIABLE,
        Reliability.BEST_EFFORT,
    )
    assert (writer.depth, writer.deadline, writer.liveliness_lease) == (1, math.inf, math.inf)
    assert writer.representations == reader.representations == (0,)


def test_partitions_and_representations_are_read() -> None:
    items = (
        (pids.PARTITION, struct.pack("<I", 1) + text_value("a")),
        (pids.DATA_REPRESENTATION, struct.pack("<Ihh", 2, 2, 0)),
    )
    qos = read_qos(Parameters(items), is_writer=True)
    assert (qos.partitions, qos.representations) == (("a",), (2, 0))
    empty = Parameters(((pids.DATA_REPRESENTATION, struct.pack("<I", 0)),))
    assert read_qos(empty, is_writer=True).representations == (0,)


def test_more_representations_than_there_are_is_not_believed() -> None:
    items = ((pids.DATA_REPRESENTATION, struct.pack("<Ihh", 2**32 - 1, 2, 0)),)
    assert read_qos(Parameters(items), is_writer=True).representations == (2, 0)
