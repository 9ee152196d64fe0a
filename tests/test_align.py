"""Which value belongs to which step: against slow references, and the traps by name."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data import align
from vilp_data.errors import AlignError
from vilp_data.vector_tracks import FieldsTrack

MS = 1_000_000
stamps = st.lists(st.integers(0, 2000), min_size=1, max_size=40).map(lambda xs: np.sort(np.array(xs, np.int64)) * MS)
ticks = st.integers(2, 20).map(lambda n: np.arange(n, dtype=np.int64) * 100 * MS)


def numbered(stamps_ns: np.ndarray) -> FieldsTrack:
    """A track that says at each stamp which one it is."""
    return FieldsTrack(stamps_ns, np.arange(float(len(stamps_ns)))[:, None])


@given(stamps, ticks)
def test_an_observation_is_the_latest_message_at_or_before_its_tick(
    stamps_ns: np.ndarray, ticks_ns: np.ndarray
) -> None:
    observed = align.observe(stamps_ns, ticks_ns, stale_after_s=0.25)
    for k, tick in enumerate(ticks_ns):
        before = [i for i, stamp in enumerate(stamps_ns) if stamp <= tick]
        assert observed.index[k] == (before[-1] if before else -1)
        age = (tick - stamps_ns[before[-1]]) / 1e9 if before else None
        assert observed.valid[k] == (age is not None and np.float32(age) <= 0.25)


@given(stamps, ticks)
def test_an_absolute_command_is_the_last_issued_before_the_next_tick(
    stamps_ns: np.ndarray, ticks_ns: np.ndarray
) -> None:
    latest = numbered(stamps_ns).at(align.last_instants(ticks_ns, period_ns=100 * MS))
    for k, tick in enumerate(ticks_ns):
        issued = [i for i, stamp in enumerate(stamps_ns) if stamp < tick + 100 * MS]
        np.testing.assert_equal(latest.values[k, 0], issued[-1] if issued else np.nan)


@given(stamps, ticks)
def test_a_vector_is_the_latest_at_or_before_its_tick_and_says_how_old_it_is(
    stamps_ns: np.ndarray, ticks_ns: np.ndarray
) -> None:
    latest = numbered(stamps_ns).at(ticks_ns + align.TOLERANCE_NS)
    observed = align.observe(stamps_ns, ticks_ns, stale_after_s=0.25)
    np.testing.assert_equal(latest.values[:, 0], np.where(observed.index < 0, np.nan, observed.index))
    np.testing.assert_equal(latest.age_s(ticks_ns).astype(np.float32), observed.age_s)


@given(stamps, ticks, st.integers(0, 2**32 - 1))
def test_deltas_are_summed_over_their_interval_and_never_held(
    stamps_ns: np.ndarray, ticks_ns: np.ndarray, seed: int
) -> None:
    values = np.random.default_rng(seed).normal(size=(len(stamps_ns), 2))
    summed = align.sum_deltas(stamps_ns, values, ticks_ns, period_ns=100 * MS)
    for k, tick in enumerate(ticks_ns):
        inside = (stamps_ns >= tick) & (stamps_ns < tick + 100 * MS)
        np.testing.assert_allclose(summed[k], values[inside].sum(axis=0), atol=1e-12)


def test_no_interpolation_looks_past_the_tick() -> None:
    observed = align.observe(np.array([0, 101 * MS]), np.array([0, 100 * MS]), stale_after_s=1.0)
    assert observed.index.tolist() == [0, 0]


def test_rounding_to_nanoseconds_does_not_cost_a_frame() -> None:
    """Thirty images a second have no whole number of nanoseconds between them: tick and stamp may round apart by one."""
    stamps_ns = np.round((7 + np.arange(60)) * 1e9 / 30).astype(np.int64)
    ticks_ns = align.control_ticks({"front": stamps_ns}, 30.0)
    assert align.observe(stamps_ns, ticks_ns, stale_after_s=1.0).index.tolist() == list(range(60))
    in_force = numbered(stamps_ns).at(align.last_instants(ticks_ns, period_ns=33_333_333))
    assert in_force.values[:, 0].tolist() == list(range(60))


def test_one_delta_a_tick_comes_through_bit_for_bit() -> None:
    values = np.random.default_rng(0).normal(size=(50, 3))
    ticks_ns = np.arange(50, dtype=np.int64) * 100 * MS
    assert (align.sum_deltas(ticks_ns, values, ticks_ns, period_ns=100 * MS) == values).all()
    assert (align.compose_rotations(ticks_ns, values, ticks_ns, period_ns=100 * MS, tool_frame=False) == values).all()


def test_rotations_compose_as_rotations_in_the_frame_they_are_given_in() -> None:
    quarter_x, quarter_z = [np.pi / 2, 0, 0], [0, 0, np.pi / 2]
    values = np.array([quarter_x, quarter_z])
    both = align.compose_rotations(np.array([0, 10 * MS]), values, np.array([0]), period_ns=100 * MS, tool_frame=False)
    # A quarter turn about x, then one about the fixed z: a third of a turn about (1, 1, 1); about the tool's z: (1, -1, 1).
    np.testing.assert_allclose(both[0], np.array([1, 1, 1]) / np.sqrt(3) * 2 * np.pi / 3, atol=1e-12)
    tool = align.compose_rotations(np.array([0, 10 * MS]), values, np.array([0]), period_ns=100 * MS, tool_frame=True)
    np.testing.assert_allclose(tool[0], np.array([1, -1, 1]) / np.sqrt(3) * 2 * np.pi / 3, atol=1e-12)


@given(st.lists(st.floats(-1e-3, 1e-3), min_size=3, max_size=3), st.integers(1, 6))
def test_small_rotations_about_one_axis_add_up(axis_angle: list[float], count: int) -> None:
    values = np.tile(np.array(axis_angle), (count, 1))
    total = align.compose_rotations(np.arange(count) * MS, values, np.array([0]), period_ns=100 * MS, tool_frame=False)
    np.testing.assert_allclose(total[0], count * np.array(axis_angle), atol=1e-12)


def test_ticks_begin_when_every_view_has_an_image_and_end_with_the_first_view_to_end() -> None:
    views = {"front": np.array([0, 100, 200, 300]) * MS, "side": np.array([50, 150, 250]) * MS}
    assert (align.control_ticks(views, 10.0) == np.array([50, 150, 250]) * MS).all()


def test_views_that_do_not_overlap_are_refused() -> None:
    with pytest.raises(AlignError, match="do not overlap"):
        align.control_ticks({"front": np.array([0, 100]) * MS, "side": np.array([900, 1000]) * MS}, 10.0)


def test_a_clock_that_was_reset_is_refused_and_jitter_is_sorted() -> None:
    with pytest.raises(AlignError, match="jumps back"):
        align.order_of(np.array([5_000, 6_000, 0]) * MS, topic="/camera")
    assert align.order_of(np.array([10, 30, 20]) * MS, topic="/camera").tolist() == [0, 2, 1]
