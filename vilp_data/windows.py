"""Which windows an episode has, and which steps each one reads: index arithmetic alone.

A planner window begins at step t and spans the observation at t, the frames at t+Δt … t+NΔt and the actions at
t … t+NΔt-1, for N = n_plan_frames and Δt = frame_stride. Past the end of the episode the last frame repeats: the goal
absorbs, so that a planner learns to stay there, while a mask tells which frames and actions were not recorded. A pair,
for the low-level policy, is steps k and k+Δt with the actions between, all recorded. Neither crosses an invalid step or
an episode.

Windows are numbered through a dataset without listing them: an episode's first steps are a few runs of consecutive
integers (one, where every step is valid), so memory is O(episodes + interruptions).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vilp_data.types import I64, Bool


def valid_runs(valid: Bool) -> I64:
    """Maximal runs of valid steps, int64 [R,2]: first step, and one past the last."""
    edges = np.diff(np.concatenate([[False], valid, [False]]).astype(np.int8))
    return np.stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)], axis=1).astype(np.int64)


def plan_windows(runs: I64, n_steps: I64 | int, *, n_plan_frames: int, frame_stride: int, max_goal_frames: int) -> I64:
    """First steps of the planner's windows in each run of valid steps, as int64 [R,2] (first, one past the last).

    `runs` int64 [R,2] may belong to several episodes; `n_steps` is the length of each one's episode, [R] or one for
    all. A window needs every step from t to t+NΔt, or to the end of the episode where that comes first, and then at
    most `max_goal_frames` of its N frames may repeat the last one. A run too short for a window gives an empty range.
    """
    recorded = max(n_plan_frames - max_goal_frames, 0)
    first, end = runs[:, 0], runs[:, 1]
    span = np.where(end == n_steps, recorded, n_plan_frames) * frame_stride
    return np.stack([first, np.maximum(end - span, first)], axis=1)


def pair_windows(runs: I64, *, frame_stride: int) -> I64:
    """Steps k with k … k+Δt all valid and in the episode, in each run: int64 [R,2] (first, one past the last)."""
    first, end = runs[:, 0], runs[:, 1]
    return np.stack([first, np.maximum(end - frame_stride, first)], axis=1)


def plan_steps(start: I64, n_steps: I64, *, n_plan_frames: int, frame_stride: int) -> tuple[I64, Bool]:
    """Steps of the planned frames of windows at `start` [B] in episodes of `n_steps` [B].

    Returns int64 [B,N], t+Δt … t+NΔt held at the last step, and bool [B,N], False where held."""
    return _held(start[:, None] + np.arange(1, n_plan_frames + 1) * frame_stride, n_steps)


def action_steps(start: I64, n_steps: I64, *, n_plan_frames: int, frame_stride: int) -> tuple[I64, Bool]:
    """Steps of the actions of windows at `start` [B] in episodes of `n_steps` [B].

    Returns int64 [B,NΔt], t … t+NΔt-1 held at the last step, and bool [B,NΔt], False where held."""
    return _held(start[:, None] + np.arange(n_plan_frames * frame_stride), n_steps)


def pair_steps(start: I64, *, frame_stride: int) -> tuple[I64, I64]:
    """For pairs at `start` [B]: the goal's steps k+Δt int64 [B], and the actions' k … k+Δt-1 int64 [B,Δt]."""
    return start + frame_stride, start[:, None] + np.arange(frame_stride)


def repeated(episode: I64, starts: I64, times: I64) -> tuple[I64, I64]:
    """Ranges of first steps int64 [R,2] and the episode [R] of each, those of episode e `times[e]` times one after another."""
    count = times[episode]
    return np.repeat(episode, count), np.repeat(starts, count, axis=0)


@dataclass(frozen=True)
class WindowIndex:
    """Windows of many episodes under consecutive numbers, ordered by episode and step. A window may have several numbers.

    episode, first  int64 [R]: the episode of each run of windows, and the step where its first window begins
    end             int64 [R]: number of windows up to and including each run
    """

    episode: I64
    first: I64
    end: I64

    @classmethod
    def of(cls, episode: I64, starts: I64) -> WindowIndex:
        """From ranges of first steps ([R,2]) and the episode of each ([R]), in the order of the numbers to come."""
        return cls(episode, starts[:, 0], np.cumsum(starts[:, 1] - starts[:, 0]))

    def __len__(self) -> int:
        return int(self.end[-1]) if len(self.end) else 0

    def per_episode(self, n_episodes: int) -> I64:
        """int64 [E]: how many numbers each episode has."""
        sizes = np.diff(self.end, prepend=0)
        return np.bincount(self.episode, sizes, n_episodes).astype(np.int64)

    def locate(self, number: I64) -> tuple[I64, I64]:
        """Episode and first step, int64 [B] each, of windows `number` int64 [B]. IndexError outside 0 … len - 1."""
        if number.size and (number.min() < 0 or number.max() >= len(self)):
            raise IndexError(f"windows are numbered 0 to {len(self) - 1}, got {number.min()} to {number.max()}")
        run = np.searchsorted(self.end, number, side="right")
        begin = np.concatenate([[0], self.end])[run]
        return self.episode[run], self.first[run] + number - begin


def _held(steps: I64, n_steps: I64) -> tuple[I64, Bool]:
    last = n_steps[:, None] - 1
    return np.minimum(steps, last), steps <= last
