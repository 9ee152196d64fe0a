"""Names are as short as keeps them apart, printable, and never two alike."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data.short_names import LONGEST_NAME, clean_name, short_names


@pytest.mark.parametrize(
    ("places", "names"),
    [
        ([], ()),
        ([("pose", "x"), ("pose", "y")], ("x", "y")),
        ([("a", "pose", "x"), ("a", "pose", "y"), ("a", "turn", "x")], ("pose.x", "pose.y", "turn.x")),
        ([("a", "x"), ("b", "x"), ("b", 1)], ("a.x", "b.x", "")),
        ([("a", 0, "x"), ("a", 1, "x")], ("0.x", "1.x")),
        ([("a", "x"), ("a", "x"), ("a", "y")], ("", "", "y")),
        ([("", "x"), ("a", "y"), ("b", ""), ()], ("", "y", "", "")),
        ([("x" * 150 + "1",), ("x" * 150 + "2",), ("hip",)], ("", "", "hip")),
    ],
)
def test_as_many_tokens_are_kept_as_tell_the_names_apart(
    places: list[tuple[str | int, ...]], names: tuple[str, ...]
) -> None:
    assert short_names(places) == names


@given(places=st.lists(st.lists(st.one_of(st.integers(-1, 2), st.text("ab.\x1b", max_size=2)), max_size=3), max_size=6))
def test_no_two_names_are_alike(places: list[list[str | int]]) -> None:
    names = short_names(places)
    assert len(names) == len(places)
    told = [name for name in names if name]
    assert len(set(told)) == len(told)


@given(text=st.text())
def test_whatever_is_in_a_name_it_can_be_printed_and_stored(text: str) -> None:
    name = clean_name(text * 50)
    assert name.isprintable()
    assert len(name.encode()) <= 4 * LONGEST_NAME
    assert clean_name(name) == name
