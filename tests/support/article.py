"""Fibonacci of the article, as a function and with its messages in ROS."""

from __future__ import annotations

import msgspec

from fibaction import Report, action


class Progress(msgspec.Struct):
    partial_sequence: list[int]


class Numbers(msgspec.Struct):
    sequence: list[int]


@action("article", type_name="arduinobot_msgs/action/Fibonacci")
async def article(report: Report[Progress], order: int) -> Numbers:
    """Count the numbers of Fibonacci."""
    numbers = [0, 1]
    for _ in range(1, order):
        numbers.append(numbers[-1] + numbers[-2])
        await report(Progress(numbers))
    return Numbers(numbers)
