"""Channel statistics, against numpy over everything at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vilp_data.errors import StoreError, VilpDataError
from vilp_data.stats import ChannelStats

finite = st.floats(-1e4, 1e4, width=32)
tables = hnp.arrays(np.float32, st.tuples(st.integers(1, 30), st.just(3)), elements=finite)


@given(st.lists(tables, min_size=1, max_size=6))
def test_a_stream_gives_what_the_whole_gives(parts: list[np.ndarray]) -> None:
    whole = np.concatenate(parts).astype(np.float64)
    stats = ChannelStats.over(parts)
    assert stats.count == len(whole)
    np.testing.assert_allclose(stats.mean, whole.mean(0), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(stats.std, whole.std(0), rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(stats.min, whole.min(0))
    np.testing.assert_array_equal(stats.max, whole.max(0))


def test_a_large_mean_does_not_eat_the_deviation() -> None:
    values = np.random.default_rng(0).normal(1e6, 0.01, (200, 50, 1))
    stats = ChannelStats.over(values)
    np.testing.assert_allclose(stats.std, values.std(), rtol=1e-6)


def test_a_channel_that_never_changes_has_no_deviation() -> None:
    stats = ChannelStats.over([np.full((7, 1), 0.1, np.float32), np.full((5, 1), 0.1, np.float32)])
    assert stats.std.tolist() == [0.0]


def test_latent_channels_are_kept_and_frames_and_places_go() -> None:
    latents = np.random.default_rng(0).normal(size=(4, 3, 5, 6)).astype(np.float16)
    stats = ChannelStats.of(latents, channel_axis=1)
    assert stats.count == 4 * 5 * 6
    np.testing.assert_allclose(stats.mean, latents.astype(np.float64).mean((0, 2, 3)), rtol=1e-12)


def test_half_precision_is_summed_in_double() -> None:
    stats = ChannelStats.of(np.full((100_000, 1), 3, np.float16))
    assert stats.mean.tolist() == [3.0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_name_their_channel(value: float) -> None:
    table = np.zeros((5, 3), np.float32)
    table[2, 1] = value
    with pytest.raises(VilpDataError, match="channel 1"):
        ChannelStats.over([np.zeros((2, 3), np.float32), table])


def test_nothing_has_no_statistics() -> None:
    for arrays in ([], [np.empty((0, 3), np.float32)]):
        with pytest.raises(VilpDataError, match="no values"):
            ChannelStats.over(arrays)


@given(tables)
def test_statistics_survive_their_file(table: np.ndarray) -> None:
    stats = ChannelStats.of(table)
    back, labels = ChannelStats.from_json(stats.to_json(split_hash="abc", key="k"))
    assert labels == {"split_hash": "abc", "key": "k"}
    assert back.to_json(**labels) == stats.to_json(**labels)
    np.testing.assert_array_equal(back.std, stats.std)


@pytest.mark.parametrize("data", [b"", b"[]", b"{}", b'{"format": 9}', b'{"format": 1, "count": 3}'])
def test_what_is_no_statistics_file_is_refused(data: bytes) -> None:
    with pytest.raises(StoreError, match="delete it"):
        ChannelStats.from_json(data)
