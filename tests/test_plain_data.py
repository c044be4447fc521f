import pytest

from fibaction._plain_data import is_list, is_map


@pytest.mark.parametrize(
    ("value", "kinds"),
    [
        ({}, (True, False)),
        *((value, (False, True)) for value in ([1], (), set[int](), frozenset[int]())),
        *((value, (False, False)) for value in ("text", b"bytes", 5, None)),
    ],
)
def test_maps_and_lists_are_told_apart_from_other_values(
    value: object, kinds: tuple[bool, bool]
) -> None:
    assert (is_map(value), is_list(value)) == kinds
