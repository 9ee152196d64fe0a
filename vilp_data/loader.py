"""The order in which a training run sees samples, and a loader that follows it.

The order is a function of (seed, epoch, step) and of nothing else: no generator is carried along, so the same batches
come for any number of ranks and any depth of prefetching, and a run resumes at the very sample it stopped before.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from vilp_data.errors import UsageError, nearest
from vilp_data.types import I64

U64 = npt.NDArray[np.uint64]
Batch = TypeVar("Batch")
Batch_co = TypeVar("Batch_co", covariant=True)

_ROUNDS = 8  # of the Feistel network; four of full mixing already pass for random (Luby and Rackoff 1988)


class BatchReader(Protocol[Batch_co]):
    """What a loader reads from; `dataset.WindowDataset` is one."""

    def __len__(self) -> int: ...

    def read(self, numbers: I64, *, pin_memory: bool = False) -> Batch_co: ...


def shuffled(positions: I64, n: int, *, seed: int, epoch: int) -> I64:
    """The samples at `positions` int64 [B] of the permutation of 0 … n - 1 that belongs to (seed, epoch).

    A Feistel network whose round keys come from Philox (Salmon et al. 2011) under the key (seed, epoch), so that any
    stretch of the order is computed by itself, in memory of its own size. Its domain is a near-square a x b >= n;
    values past n - 1 go through it again until they fall inside, which leaves a permutation.
    """
    left_size = math.isqrt(n - 1) + 1 if n > 1 else 1
    right_size = -(-n // left_size)
    keys = np.random.Philox(key=np.array([seed, epoch], np.uint64)).random_raw(_ROUNDS)
    out: U64 = _feistel(positions.astype(np.uint64), left_size, right_size, keys)
    while (outside := out >= np.uint64(n)).any():
        out[outside] = _feistel(out[outside], left_size, right_size, keys)
    return out.astype(np.int64)


def batch_numbers(
    n: int, *, batch_size: int, seed: int, epoch: int, step: int, rank: int = 0, n_ranks: int = 1, shuffle: bool = True
) -> I64:
    """Samples of batch `step` of an epoch over n samples: one rank's contiguous part of the batch that all share."""
    begin = step * batch_size
    share = batch_size // n_ranks
    positions = np.arange(begin + rank * share, min(begin + (rank + 1) * share, n), dtype=np.int64)
    return shuffled(positions, n, seed=seed, epoch=epoch) if shuffle else positions


class Loader(Generic[Batch]):
    """Batches of a dataset, one epoch at a time, read ahead by one thread.

    for batch in loader: …      the rest of the current epoch; the next loop is the next epoch
    loader.state_dict()         three integers: where the batch after the last one handed out lies

    A batch of `batch_size` is shared by `n_ranks`, each reading its part. What reading raises is raised in the loop;
    leaving the loop by any way (break, exception, Ctrl-C) ends the thread.
    """

    def __init__(
        self,
        dataset: BatchReader[Batch],
        *,
        batch_size: int,
        seed: int = 0,
        rank: int = 0,
        n_ranks: int = 1,
        shuffle: bool = True,
        drop_last: bool = True,
        read_ahead: int = 2,
        pin_memory: bool | None = None,
    ) -> None:
        """`read_ahead` batches are kept ready; 0 reads in the caller's thread. `pin_memory` None means: with CUDA only.

        Raises UsageError for numbers that contradict each other, and where no whole batch fits the dataset."""
        _require_sharing(batch_size, rank=rank, n_ranks=n_ranks, drop_last=drop_last)
        self._dataset = dataset
        self._batch_size = batch_size
        self._rank, self._n_ranks = rank, n_ranks
        self._shuffle = shuffle
        self._read_ahead = read_ahead
        self._pin_memory = torch.cuda.is_available() if pin_memory is None else pin_memory
        self._state = _checked_state({"seed": seed, "epoch": 0, "step": 0})
        whole, rest = divmod(len(dataset), batch_size)
        self.steps_per_epoch = whole + (rest > 0 and not drop_last)
        if self.steps_per_epoch == 0:
            raise UsageError(
                "not one whole batch",
                found=f"{len(dataset)} samples for batches of {batch_size}",
                remedy="lower the recipe's batch_size (--preset tiny is for so little data); in code, drop_last=False keeps the last one",
            )

    def __len__(self) -> int:
        """Batches in an epoch."""
        return self.steps_per_epoch

    def __iter__(self) -> Iterator[Batch]:
        seed, epoch, first = (self._state[name] for name in ("seed", "epoch", "step"))
        batches = self._batches(seed, epoch, first)
        with contextlib.closing(batches):
            for step, batch in enumerate(batches, first + 1):
                over = step == self.steps_per_epoch
                self._state = {"seed": seed, "epoch": epoch + over, "step": 0 if over else step}
                yield batch

    def state_dict(self) -> dict[str, int]:
        """{"seed", "epoch", "step"} of the next batch. Batches read ahead but not handed out do not count."""
        return dict(self._state)

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Go on from `state`, in loops that begin after this; exact for the same dataset and batch_size, any n_ranks.

        Raises UsageError for what is no state, or lies past the end of this loader's epoch."""
        checked = _checked_state(state)
        if checked["step"] >= self.steps_per_epoch:
            raise UsageError(
                "the loader's state lies past the end of the epoch",
                found=f"step {checked['step']} of {self.steps_per_epoch}",
                remedy="resume with the dataset, split and batch_size that the run began with",
            )
        self._state = checked

    def _batches(self, seed: int, epoch: int, first: int) -> Generator[Batch]:
        def read(step: int) -> Batch:
            numbers = batch_numbers(
                len(self._dataset),
                batch_size=self._batch_size,
                seed=seed,
                epoch=epoch,
                step=step,
                rank=self._rank,
                n_ranks=self._n_ranks,
                shuffle=self._shuffle,
            )
            return self._dataset.read(numbers, pin_memory=self._pin_memory)

        steps = range(first, self.steps_per_epoch)
        if self._read_ahead == 0:
            yield from map(read, steps)
            return
        pool = ThreadPoolExecutor(1, thread_name_prefix="vilp-loader")
        ahead: deque[Future[Batch]] = deque()
        try:
            for step in steps:
                ahead.append(pool.submit(read, step))
                if len(ahead) > self._read_ahead:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _feistel(values: U64, left_size: int, right_size: int, keys: U64) -> U64:
    """A permutation of 0 … left_size * right_size - 1: each half in turn is shifted by a hash of the other."""
    sizes = (np.uint64(left_size), np.uint64(right_size))
    halves = [values // sizes[1], values % sizes[1]]
    for turn, key in enumerate(keys):
        moved, other = turn % 2, 1 - turn % 2
        halves[moved] = (halves[moved] + _mixed(halves[other] ^ key) % sizes[moved]) % sizes[moved]
    return halves[0] * sizes[1] + halves[1]


def _mixed(values: U64) -> U64:
    """The finaliser of SplitMix64 (Steele, Lea and Flood 2014): every input bit reaches every output bit."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def _require_sharing(batch_size: int, *, rank: int, n_ranks: int, drop_last: bool) -> None:
    found = f"batch_size={batch_size}, rank={rank}, n_ranks={n_ranks}, drop_last={drop_last}"
    if batch_size < 1 or not 0 <= rank < n_ranks or batch_size % n_ranks:
        raise UsageError(
            "a batch cannot be shared like that", found=found, remedy="batch_size must be a multiple of n_ranks"
        )
    if n_ranks > 1 and not drop_last:
        raise UsageError(
            "the last batch cannot be shared evenly", found=found, remedy="use drop_last=True with several ranks"
        )


def _checked_state(state: Mapping[str, int]) -> dict[str, int]:
    names = ("seed", "epoch", "step")
    for name in names:
        if name not in state:
            raise UsageError(f"no loader state: it lacks {name!r}", found=sorted(state), remedy=nearest(name, names))
        if not 0 <= state[name] < 2**63:
            raise UsageError(
                f"the loader's {name} must be an integer from 0 on", found=state[name], remedy="use another seed"
            )
    return {name: int(state[name]) for name in names}
