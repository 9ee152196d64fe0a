"""Parts of a stored vector add up to it, whatever their numbers are called."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data.spec import VectorSpec
from vilp_data.types import F32, ColumnNames
from vilp_data.vector_parts import names_that_differ, shared_names, stated_names, vector_parts


@given(widths=st.lists(st.integers(1, 4), max_size=4), n_steps=st.integers(0, 5))
def test_the_parts_of_a_vector_join_to_the_vector(widths: list[int], n_steps: int) -> None:
    total = sum(widths)
    values: F32 = np.arange(n_steps * total, dtype=np.float32).reshape(n_steps, total)
    specs = {f"part{i}": VectorSpec(topic=f"/{i}", fields=[f"data[0:{width}]"]) for i, width in enumerate(widths)}
    parts = vector_parts(values, specs)
    assert list(parts) == list(specs)
    assert [len(labels) for labels, _ in parts.values()] == widths
    if widths:
        assert np.array_equal(np.concatenate([columns for _, columns in parts.values()], axis=1), values)


@given(extra=st.integers(1, 5))
def test_a_vector_whose_widths_are_not_told_stays_in_one_piece(extra: int) -> None:
    values: F32 = np.zeros((2, 2 + extra), np.float32)
    specs = {"xy": VectorSpec(topic="/a", fields=["x", "y"]), "rest": VectorSpec(topic="/b")}
    [(labels, columns)] = vector_parts(values, specs).values()
    assert len(labels) == 2 + extra
    assert columns is values


@pytest.mark.parametrize(
    ("fields", "names", "labels"),
    [
        (["position.x", "position.y"], [], ["x", "y"]),
        (["position[2:4]"], [], ["2", "3"]),
        (["position"], ["elbow", "wrist"], ["elbow", "wrist"]),
    ],
)
def test_columns_are_labelled_by_field_index_or_joint(fields: list[str], names: list[str], labels: list[str]) -> None:
    spec = VectorSpec(topic="/a", fields=fields, names=names)
    [(found, _)] = vector_parts(np.zeros((1, 2), np.float32), {"part": spec}).values()
    assert found == labels


def test_names_from_the_log_tell_the_widths_that_the_task_does_not() -> None:
    values: F32 = np.arange(6, dtype=np.float32).reshape(2, 3)
    specs = {"xy": VectorSpec(topic="/a", fields=["x", "y"]), "rest": VectorSpec(topic="/b")}
    parts = vector_parts(values, specs, {"rest": ["grip"]})
    assert [labels for labels, _ in parts.values()] == [["x", "y"], ["grip"]]
    np.testing.assert_array_equal(parts["rest"][1], [[2], [5]])


def test_names_that_do_not_fit_the_vector_are_not_believed() -> None:
    values: F32 = np.zeros((2, 2), np.float32)
    parts = vector_parts(values, {"xy": VectorSpec(topic="/a", fields=["x", "y"])}, {"xy": ["one", "two", "three"]})
    assert parts["xy"][0] == ["x", "y"]


@pytest.mark.parametrize(
    ("fields", "names", "labels"),
    [
        (["linear.x", "angular.x"], [], ["linear.x", "angular.x"]),
        (["position[0:1]", "velocity[0:1]"], [], ["position.0", "velocity.0"]),
        (["position", "velocity"], ["hip"], ["position.hip", "velocity.hip"]),
        (["msg.position[3:5]"], [], ["3", "4"]),
        (["speed", "speed"], [], ["0", "1"]),
        (["joints[1:2].position", "speed"], [], ["position", "speed"]),
    ],
)
def test_what_a_task_calls_its_numbers_tells_them_apart(fields: list[str], names: list[str], labels: list[str]) -> None:
    assert stated_names(VectorSpec(topic="/a", fields=fields, names=names)) == labels


@pytest.mark.parametrize(
    ("fields", "told", "labels"),
    [
        (["data[2:5]"], ["", "hip", ""], ["2", "hip", "4"]),
        ([], ["", "hip", ""], ["0", "hip", "2"]),
        ([], ["", "0", ""], ["[0]", "0", "[2]"]),
        (["data[2:5]"], ["", "2", ""], ["[0]", "2", "[2]"]),
        (["pose"], ["", "", ""], ["0", "1", "2"]),
    ],
)
def test_a_number_that_its_log_does_not_name_goes_by_what_the_task_says(
    fields: list[str], told: list[str], labels: list[str]
) -> None:
    parts = vector_parts(np.zeros((1, 3), np.float32), {"a": VectorSpec(topic="/a", fields=fields)}, {"a": told})
    assert [found for found, _ in parts.values()] == [labels]


def low_dim(*names: str) -> ColumnNames:
    return {"low_dim": {"arm": list(names)}}


def test_episodes_share_a_name_where_all_that_say_it_agree() -> None:
    one, other, unnamed = low_dim("hip", "knee"), low_dim("hip", "toe"), low_dim("", "")
    assert shared_names([one, {}, one], "low_dim") == {"arm": ["hip", "knee"]}
    assert shared_names([one, other], "low_dim") == {"arm": ["hip", ""]}
    assert shared_names([one, unnamed], "low_dim") == {"arm": ["hip", "knee"]}
    assert shared_names([one, low_dim("hip")], "low_dim") == {}
    assert shared_names([low_dim("hip", ""), low_dim("", "hip")], "low_dim") == {"arm": ["", ""]}


def test_what_episodes_call_differently_is_said() -> None:
    one, other = low_dim("hip", "knee"), low_dim("hip", "toe")
    assert list(names_that_differ([one, {}, one, low_dim("", "")])) == []
    (sentence,) = names_that_differ([one, other])
    assert "low_dim.arm differently" in sentence
    assert list(names_that_differ([low_dim("0", "1"), low_dim("1", "0")]))
    assert list(names_that_differ([low_dim("hip", ""), low_dim("", "hip")]))
    assert list(names_that_differ([one, low_dim("hip")]))
