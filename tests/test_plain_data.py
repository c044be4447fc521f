import pytest

from fibaction._plain_data import is_list, is_map


@pytest.mark.parametrize("value", [[], (), set(), frozenset(), [1]])
def test_collections_that_json_writes_as_a_list_are_lists(value: object) -> None:
    assert is_list(value)
    assert not is_map(value)


@pytest.mark.parametrize("value", ["text", b"bytes", 5, None])
def test_text_bytes_and_numbers_are_neither_lists_nor_maps(value: object) -> None:
    assert not is_list(value)
    assert not is_map(value)


def test_a_dict_is_a_map() -> None:
    assert is_map({})
    assert not is_list({})
