"""A set in order of entry that costs nothing while it is empty, and little with one member.

A server has some of these for each goal, and most have one member or none. So it is a tuple with
none or one, and a dictionary from two on. Adding and removing take the same time however many
members there are.

    members = with_member(members, one)

Iterate over `tuple(members)` where the set may change meanwhile; for a tuple this copies nothing.
"""

from __future__ import annotations

from typing import TypeAlias, TypeVar

T = TypeVar("T")

Members: TypeAlias = tuple[T, ...] | dict[T, None]


def with_member(members: Members[T], member: T) -> Members[T]:
    """Return the set with one more member; a dictionary is changed in place."""
    if not members:
        return (member,)
    if isinstance(members, tuple):
        members = dict.fromkeys(members)
    members[member] = None
    return members


def without_member(members: Members[T], member: T) -> Members[T]:
    """Return the set without that member; a dictionary is changed in place."""
    if isinstance(members, tuple):
        return () if member in members else members
    members.pop(member, None)
    return members or ()
