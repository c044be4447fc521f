"""Settings of a transport that is written elsewhere."""

# No deferred annotations: a module of others may have none.

from collections.abc import Sequence

import pytest

from fibaction.wire.settings import WireSettings


class RoomSettings(WireSettings, frozen=True, kw_only=True):
    """The settings of a transport in rooms."""

    room: str = ""
    doors: Sequence[int] = ()
    seats: int | None = None


def test_types_are_read_also_where_annotations_are_not_text() -> None:
    readers = RoomSettings.in_urls()
    assert readers["room"]("hall") == "hall"
    assert readers["doors"]("1, 2") == (1, 2)
    assert readers["seats"]("3") == 3
    with pytest.raises(ValueError, match="it has no items"):
        readers["doors"](" ,")
