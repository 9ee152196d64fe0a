"""Plots keep every value at its place, whatever series come and go; parts of a stored vector add up to it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vilp_data.plots import Plot, frame_psnr, panel_rank, vector_parts
from vilp_data.spec import VectorSpec
from vilp_data.types import F32, U8

VALUES = st.dictionaries(st.sampled_from("abcde"), st.floats(-1e6, 1e6), max_size=5)
FRAMES = hnp.arrays(np.uint8, (2, 3, 4, 3))


@given(rows=st.lists(VALUES, min_size=1, max_size=8))
def test_every_value_lies_in_its_series_at_its_time_and_nothing_else_does(rows: list[dict[str, float]]) -> None:
    plot = Plot("title", "entity")
    for time_ns, values in enumerate(rows):
        plot.add(time_ns, values)
    assert plot.times_ns == list(range(len(rows)))
    assert sorted(plot.names) == sorted(set().union(*rows))
    for row, values in zip(plot.table(), rows, strict=True):
        shown = {name: value for name, value in zip(plot.names, row.tolist(), strict=True) if not np.isnan(value)}
        assert shown == values


@given(real=FRAMES, rebuilt=FRAMES)
def test_psnr_of_a_frame_is_that_of_the_formula_and_the_same_both_ways(real: U8, rebuilt: U8) -> None:
    errors = [float(np.mean((a.astype(float) - b.astype(float)) ** 2)) for a, b in zip(real, rebuilt, strict=True)]
    expected = [20 * np.log10(255) - 10 * np.log10(error) if error else np.nan for error in errors]
    np.testing.assert_allclose(frame_psnr(real, rebuilt), expected, rtol=1e-5)
    np.testing.assert_array_equal(frame_psnr(real, rebuilt), frame_psnr(rebuilt, real))


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


@given(topics=st.lists(st.text("acdeginopst/_", max_size=12), max_size=6), command=st.text("abc/", max_size=6))
def test_what_the_task_calls_an_action_comes_before_everything_else(topics: list[str], command: str) -> None:
    ranked = sorted({*topics, command}, key=lambda topic: panel_rank(topic, {command}))
    assert ranked[0] == command
