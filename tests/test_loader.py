"""The order of samples, resuming, and what happens when a loop ends early."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable
from itertools import chain
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vilp_data.errors import StoreError, UsageError
from vilp_data.loader import Loader, batch_numbers, shuffled

seeds = st.integers(0, 2**62)


class Numbers:
    """A dataset whose batches are the sample numbers themselves; it can break at one of its reads."""

    def __init__(self, n: int, *, breaks_at: int | None = None) -> None:
        self.n, self.breaks_at, self.reads, self.pinned = n, breaks_at, 0, False

    def __len__(self) -> int:
        return self.n

    def read(self, numbers: np.ndarray, *, pin_memory: bool = False) -> list[int]:
        self.reads += 1
        self.pinned = pin_memory
        if self.reads == self.breaks_at:
            raise StoreError("damaged", where="shard")
        return numbers.tolist()


def epochs(loader: Loader[list[int]], count: int) -> list[list[list[int]]]:
    return [list(loader) for _ in range(count)]


def joined(lists: Iterable[list[Any]]) -> list[Any]:
    return list(chain.from_iterable(lists))


def loader_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("vilp-loader")]


# --- order


@given(st.integers(1, 3000), seeds, st.integers(0, 1000))
def test_an_epoch_is_a_permutation(n: int, seed: int, epoch: int) -> None:
    order = shuffled(np.arange(n), n, seed=seed, epoch=epoch)
    assert np.array_equal(np.sort(order), np.arange(n))


@given(st.integers(1, 10**15), seeds, st.data())
def test_a_stretch_of_a_huge_epoch_costs_its_own_size(n: int, seed: int, data: st.DataObject) -> None:
    positions = np.array(data.draw(st.lists(st.integers(0, n - 1), unique=True, min_size=1, max_size=20)))
    order = shuffled(positions, n, seed=seed, epoch=0)
    assert len(set(order.tolist())) == len(positions)
    assert 0 <= order.min() <= order.max() < n
    assert shuffled(positions[::-1], n, seed=seed, epoch=0).tolist() == order[::-1].tolist()


def test_seeds_and_epochs_give_unrelated_orders() -> None:
    n = 1000
    orders = [shuffled(np.arange(n), n, seed=seed, epoch=epoch) for seed in range(3) for epoch in range(3)]
    for i, a in enumerate(orders):
        for b in [np.arange(n), *orders[:i]]:
            assert abs(np.corrcoef(a, b)[0, 1]) < 0.13  # 4 standard deviations
            assert np.count_nonzero(a == b) < 8  # one is expected


def test_every_sample_is_as_likely_at_every_place() -> None:
    n, draws = 12, 3000
    counts = np.zeros((n, n))
    for epoch in range(draws):
        counts[np.arange(n), shuffled(np.arange(n), n, seed=1, epoch=epoch)] += 1
    chi2 = ((counts - draws / n) ** 2 / (draws / n)).sum()
    assert chi2 < 121 + 4 * np.sqrt(2 * 121)  # (n - 1)^2 degrees of freedom


def test_neighbours_in_the_order_are_no_neighbours_in_the_episode() -> None:
    n = 9000
    order = shuffled(np.arange(n), n, seed=0, epoch=0)
    steps = np.abs(np.diff(order))
    assert abs(steps.mean() - n / 3) < n / 30
    assert np.count_nonzero(steps == 1) < 12  # two are expected


def test_the_order_is_the_same_on_every_machine_and_version() -> None:
    # A checkpoint stores (seed, epoch, step) alone: change this order and every run resumes at other samples.
    assert shuffled(np.arange(8), 1000, seed=42, epoch=3).tolist() == [945, 973, 274, 523, 546, 108, 386, 56]


@given(st.integers(8, 300), st.sampled_from([1, 2, 4]), seeds)
def test_ranks_share_the_batch_that_one_rank_would_read(n: int, n_ranks: int, seed: int) -> None:
    for step in range(n // 8):
        whole = batch_numbers(n, batch_size=8, seed=seed, epoch=2, step=step)
        parts = [
            batch_numbers(n, batch_size=8, seed=seed, epoch=2, step=step, rank=rank, n_ranks=n_ranks)
            for rank in range(n_ranks)
        ]
        assert np.concatenate(parts).tolist() == whole.tolist()


# --- loading


def test_an_epoch_hands_out_every_sample_once_but_the_last_few() -> None:
    loader = Loader(Numbers(103), batch_size=10, seed=5)
    batches = list(loader)
    assert len(batches) == len(loader) == 10
    assert max(Counter(joined(batches)).values()) == 1


def test_the_last_few_can_be_kept() -> None:
    batches = list(Loader(Numbers(103), batch_size=10, drop_last=False))
    assert [len(batch) for batch in batches] == [10] * 10 + [3]
    assert sorted(joined(batches)) == list(range(103))


def test_without_shuffling_samples_come_in_order() -> None:
    assert joined(Loader(Numbers(12), batch_size=4, shuffle=False)) == list(range(12))


def test_epochs_differ_and_seeds_differ() -> None:
    first, second = epochs(Loader(Numbers(50), batch_size=10, seed=1), 2)
    other = list(Loader(Numbers(50), batch_size=10, seed=2))
    assert first != second
    assert first != other


@pytest.mark.parametrize("read_ahead", [0, 1, 2, 7, 100])
def test_reading_ahead_changes_nothing(read_ahead: int) -> None:
    expected = epochs(Loader(Numbers(64), batch_size=8, seed=3, read_ahead=0), 3)
    assert epochs(Loader(Numbers(64), batch_size=8, seed=3, read_ahead=read_ahead), 3) == expected


@given(st.integers(0, 29), seeds)
def test_resuming_goes_on_at_the_very_next_sample(stop: int, seed: int) -> None:
    dataset = Numbers(83)
    expected = joined(epochs(Loader(dataset, batch_size=8, seed=seed), 4))

    loader = Loader(dataset, batch_size=8, seed=seed)
    seen: list[list[int]] = []
    while len(seen) < stop:
        for batch in loader:
            seen.append(batch)
            if len(seen) == stop:
                break
    state = loader.state_dict()
    assert all(type(value) is int for value in state.values())

    resumed = Loader(dataset, batch_size=8, seed=0)
    resumed.load_state_dict(state)
    while len(seen) < len(expected):
        seen += list(resumed)
    assert seen == expected


def test_state_counts_batches_handed_out_not_those_read_ahead() -> None:
    loader = Loader(Numbers(80), batch_size=8, seed=9, read_ahead=4)
    batches = iter(loader)
    next(batches)
    next(batches)
    assert loader.state_dict() == {"seed": 9, "epoch": 0, "step": 2}


def test_the_last_batch_of_an_epoch_leads_to_the_next_one() -> None:
    loader = Loader(Numbers(16), batch_size=8, seed=9)
    for _ in loader:
        state = loader.state_dict()
    assert state == {"seed": 9, "epoch": 1, "step": 0}


@pytest.mark.parametrize("pin_memory", [False, True])
def test_pinning_is_asked_of_the_dataset(pin_memory: bool) -> None:
    dataset = Numbers(64)
    list(Loader(dataset, batch_size=8, pin_memory=pin_memory))
    assert dataset.pinned is pin_memory


def test_several_ranks_read_what_one_would() -> None:
    alone = list(Loader(Numbers(64), batch_size=8, seed=3))
    ranks = [list(Loader(Numbers(64), batch_size=8, seed=3, rank=rank, n_ranks=4)) for rank in range(4)]
    assert [joined(parts) for parts in zip(*ranks, strict=True)] == alone


# --- ending


@pytest.mark.parametrize("read_ahead", [0, 2])
def test_what_reading_raises_is_raised_in_the_loop(read_ahead: int) -> None:
    seen = []
    with pytest.raises(StoreError, match="shard: damaged"):
        for batch in Loader(Numbers(80, breaks_at=4), batch_size=8, read_ahead=read_ahead):
            seen.append(batch)
    assert seen == list(Loader(Numbers(80), batch_size=8))[:3]
    assert loader_threads() == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_leaving_the_loop_ends_the_thread(error: type[BaseException]) -> None:
    def train() -> None:
        for _ in Loader(Numbers(800), batch_size=8):
            assert loader_threads()
            raise error

    with pytest.raises(error):
        train()
    assert loader_threads() == []


def test_breaking_out_ends_the_thread_and_the_next_loop_goes_on() -> None:
    expected = list(Loader(Numbers(80), batch_size=8))
    loader = Loader(Numbers(80), batch_size=8)
    seen = []
    for batch in loader:
        seen.append(batch)
        if len(seen) == 4:
            break
    assert loader_threads() == []
    assert seen + list(loader) == expected


def test_reading_ahead_stops_at_its_depth() -> None:
    dataset = Numbers(8000)
    batches = iter(Loader(dataset, batch_size=8, read_ahead=3))
    next(batches)
    batches.close()  # type: ignore[attr-defined]
    assert dataset.reads <= 4


# --- wrong use


@pytest.mark.parametrize(
    "options",
    [
        {"batch_size": 0},
        {"batch_size": 8, "n_ranks": 3},
        {"batch_size": 8, "rank": 2, "n_ranks": 2},
        {"batch_size": 8, "n_ranks": 2, "drop_last": False},
        {"batch_size": 200},
        {"batch_size": 8, "seed": -1},
    ],
)
def test_contradictions_are_refused_with_a_remedy(options: dict[str, int]) -> None:
    with pytest.raises(UsageError) as caught:
        Loader(Numbers(100), **options)  # type: ignore[arg-type]
    assert caught.value.remedy


@pytest.mark.parametrize(
    "state", [{"epoch": 0, "step": 0}, {"seed": 0, "epoch": 0, "step": 10}, {"seed": 0, "epoch": -1, "step": 0}]
)
def test_a_state_that_does_not_fit_is_refused(state: dict[str, int]) -> None:
    loader = Loader(Numbers(80), batch_size=8)
    with pytest.raises(UsageError):
        loader.load_state_dict(state)
