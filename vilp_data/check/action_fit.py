"""Which action does the state's motion depend on: a regression on actions before and after the step, for the off-by-one detector. Pure.

At step k a robot's state changes by s_{k+1} - s_k. Most of that change follows from where it was and how it moved before. What tells one
shift from another is the rest: the share of the change that the state and its own past leave open, and that actions explain. How much that
is, is asked of

    a_{k+σ} alone                      `gain`
    all of a_{k-3} … a_{k+σ}           `up_to`
    all of a_{k+σ} … a_{k+3}           `onward`

each by least squares, fitted on four fifths of the steps and judged on the rest, five times. One action alone proves little: where commands
are smooth, the next one says where they go and so explains the motion too; where they answer to what the robot did, the next one even tells
its noise; where they were recorded with noise, every neighbour helps to see through it. So each action is judged by what it adds to the
others (Granger's test of causes, both ways). Rightly stored data needs a_k: what comes later adds nothing to the actions up to it, and
those up to it add much to the later ones. Actions stored one step late need a_{k+1} instead, and it alone: a_k adds nothing to those before
it, all up to a_k add nothing to those after it, and a_{k+2} adds little more.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vilp_data.types import F64, Bool

SHIFTS = tuple(range(-3, 4))
"""More than three steps off is no off-by-one: the clocks are then compared by header lag."""

FOLDS = 5
RIDGE = 1e-9
"""Of the number of steps, on standardised columns: just enough for columns that repeat each other. Smooth commands differ from one step to
the next by a thousandth of their range, and a ridge that hides this finds every smooth robot to be late."""

CLIP = 3.0
"""Changes beyond so many times their 99th percentile are wrapped angles, flipped quaternions and resets, and are cut to it."""

MIN_STEPS = 200
MIN_STEPS_PER_COLUMN = 6
"""Fewer steps fit a regression to noise."""

MAX_STEPS = 20_000
"""More steps tell nothing new about all together; taken evenly from the episodes, so that memory and time stay bounded."""

MARGIN = 0.03
"""Of what the past leaves open: actions that add less than this to the others prove nothing."""

OTHER_WAY = 1 / 3
"""Actions are off only where those on the wrong side add at most this share of what those on the right side add. Rightly stored data
where the next action tells something too (a controller that answers to noise) has this above 0.8; shifted data has it below 0.3."""

SHARP, BEFORE = 2 / 3, 1 / 5
"""Of what the late action and those after it add to those before: it must bring SHARP by itself, and the one just before it no more than
BEFORE. Noise in recorded commands makes each neighbour help in its turn; a shift makes a single one help."""

TELLING = 0.1
"""Of what actions explain: where neither side of a step adds so much to the other, nothing tells one step from the next."""

FOLDS_AGREE = 4
"""Of FOLDS: in so many the later actions must add something."""

MIN_GAIN = 0.05
"""Actions that explain less than this all together do not drive the state."""

EPISODE_MARGIN = 0.15
EPISODE_STEPS = 40
ODD_SHARE = 0.25
"""One episode against the others: fewer steps and smaller differences are chance, and more than a share of odd ones are not odd."""

Steps = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Trajectory:
    """One demonstration on its control clock: state float64 [F,S], action float64 [F,A], and where both may be used, bool [F]."""

    name: str
    state: F64
    action: F64
    valid: Bool


@dataclass(frozen=True)
class ActionFit:
    """How well actions explain the motion, as shares of the change that the state and its own past leave open, on held-out steps: 1 all of
    it, 0 or less nothing.

    gain       shift -> by the action of that step alone
    up_to      shift -> by the actions of that step and of those before it, from -3 on
    onward     shift -> by the actions of that step and of those after it, to +3
    own_past   share of the change that the state and its past explain by themselves
    agreeing   shift -> folds in which actions after it add to those up to it
    odd        (episode, its best shift, gain there, gain at 0): episodes that fit another shift than all together
    """

    gain: Mapping[int, float]
    up_to: Mapping[int, float]
    onward: Mapping[int, float]
    own_past: float
    agreeing: Mapping[int, int]
    n_steps: int
    odd: tuple[tuple[str, int, float, float], ...] = ()

    @property
    def explained(self) -> float:
        """By the actions that do best together."""
        return max(*self.up_to.values(), *self.onward.values())

    def later_add(self, shift: int) -> float:
        """What actions after `shift` add to those up to it. At least 0."""
        return max(share for at, share in self.up_to.items() if at >= shift) - self.up_to[shift]

    def earlier_add(self, shift: int) -> float:
        """What actions up to `shift` add to those after it. At least 0. `shift` is below the largest."""
        return max(share for at, share in self.onward.items() if at <= shift + 1) - self.onward[shift + 1]

    def adds(self, shift: int) -> float:
        """What the action of `shift` adds to those before it. `shift` is above the smallest."""
        return self.up_to[shift] - self.up_to[shift - 1]

    @property
    def best(self) -> int:
        """The shift of the newest action that the motion depends on: the first from which on later actions add less than earlier ones."""
        before = (shift for shift in SHIFTS[:-1] if self.later_add(shift) <= self.earlier_add(shift))
        return next(before, SHIFTS[-1])

    @property
    def is_late(self) -> bool:
        """Whether the motion depends on one action stored after its step, and on none of those up to its own."""
        best = self.best
        if best <= 0 or self.earlier_add(0) > OTHER_WAY * self.later_add(0):
            return False
        later = self.later_add(best - 1)
        told = later >= MARGIN and self.agreeing[best - 1] >= FOLDS_AGREE
        alone = self.adds(best) >= SHARP * later and self.adds(best - 1) <= BEFORE * later
        return told and alone and self.earlier_add(best - 1) <= OTHER_WAY * later

    @property
    def is_early(self) -> bool:
        """Whether the motion depends on actions stored before its step, and not on those from it on."""
        later, earlier = self.later_add(-1), self.earlier_add(-1)
        return self.best < 0 and earlier >= MARGIN and later <= OTHER_WAY * earlier

    @property
    def off(self) -> int:
        """How many steps late the actions are stored (early: below 0); 0 where they are right, or where nothing tells."""
        return self.best if self.is_late or self.is_early else 0

    @property
    def is_untold(self) -> bool:
        """Whether actions up to the step, and those after it, explain the motion equally well: smooth commands, or a slow robot."""
        told = max(self.later_add(0), self.earlier_add(0))
        return self.explained >= MIN_GAIN and not self.is_early and told < TELLING * self.explained


def fit_action(trajectories: Sequence[Trajectory]) -> ActionFit | None:
    """The fit over all trajectories together; None where there are too few steps, or nothing moves."""
    trajectories = _alike(_thinned(trajectories))
    rows = [_rows(one) for one in trajectories]
    episode = np.repeat(np.arange(len(rows)), [len(steps) for steps in rows])
    if len(episode) < MIN_STEPS:
        return None
    used = [(one, k) for one, k in zip(trajectories, rows, strict=True) if len(k)]
    state = np.concatenate([one.state[k] for one, k in used])
    before = np.concatenate([one.state[k] - one.state[k - 1] for one, k in used])
    change = np.concatenate([one.state[k + 1] - one.state[k] for one, k in used])
    actions = {shift: np.concatenate([one.action[k + shift] for one, k in used]) for shift in SHIFTS}
    moving = change.std(axis=0) > 1e-9 * (1e-9 + np.abs(state).max(axis=0))
    n_columns = 2 * state.shape[1] + len(SHIFTS) * actions[0].shape[1]
    if not moving.any() or len(episode) < MIN_STEPS_PER_COLUMN * n_columns:
        return None
    past = np.concatenate([_standard(state), _standard(_clipped(before))], axis=1)
    target = _standard(_clipped(change[:, moving]))
    odd = tuple(_odd_ones(trajectories, episode, past, actions, target))
    if len(odd) > ODD_SHARE * len(trajectories):
        odd = ()  # they are the rule
    return replace(_fitted(past, actions, target), odd=odd)


def _fitted(past: F64, actions: Mapping[int, F64], target: F64) -> ActionFit:
    """The fit but for single episodes. Actions enter as one of them and the steps from each to the next: the span is the same, and smooth
    commands do not drown in what they have in common."""
    first, last = SHIFTS[0], SHIFTS[-1]
    inputs = {"past": past} | {f"a{shift}": _standard(actions[shift]) for shift in SHIFTS}
    inputs |= {f"d{shift}": _standard(actions[shift] - actions[shift - 1]) for shift in SHIFTS[1:]}
    regression = _Regression(inputs, target)
    left_open = regression.errors(["past"])

    def share(names: list[str]) -> float:
        return float(1 - regression.errors(["past", *names]).sum() / left_open.sum())

    up_to = {shift: [f"a{first}", *(f"d{at}" for at in range(first + 1, shift + 1))] for shift in SHIFTS}
    onward = {shift: [f"a{last}", *(f"d{at}" for at in range(shift + 1, last + 1))] for shift in SHIFTS}
    all_errors = regression.errors(["past", *up_to[last]])
    return ActionFit(
        gain={shift: share([f"a{shift}"]) for shift in SHIFTS},
        up_to={shift: share(names) for shift, names in up_to.items()},
        onward={shift: share(names) for shift, names in onward.items()},
        own_past=float(1 - left_open.sum() / np.square(target).sum()),
        agreeing={
            shift: int((all_errors < regression.errors(["past", *names])).sum()) for shift, names in up_to.items()
        },
        n_steps=len(target),
    )


# --- the regression -----------------------------------------------------------------------------------------------------


class _Regression:
    """Least squares of `target` [n,T] on any of several named groups of columns, each group [n,·], judged on held-out folds."""

    def __init__(self, inputs: Mapping[str, F64], target: F64) -> None:
        ends = np.cumsum([values.shape[1] for values in inputs.values()]).tolist()
        self._columns = {
            name: np.arange(end - values.shape[1], end)
            for (name, values), end in zip(inputs.items(), ends, strict=True)
        }
        cuts = np.arange(1, FOLDS) * len(target) // FOLDS
        self._inputs = np.split(np.concatenate(list(inputs.values()), axis=1), cuts)
        self._targets = np.split(target, cuts)
        self._grams = [x.T @ x for x in self._inputs]
        self._products = [x.T @ y for x, y in zip(self._inputs, self._targets, strict=True)]
        self._gram = np.asarray(sum(self._grams))
        self._product = np.asarray(sum(self._products))

    def errors(self, names: Sequence[str]) -> F64:
        """Squared error of each fold, float64 [FOLDS], by the fit of the others to these groups."""
        chosen = np.concatenate([self._columns[name] for name in names])
        n, errors = sum(map(len, self._targets)), []
        for x, y, own_gram, own_product in zip(self._inputs, self._targets, self._grams, self._products, strict=True):
            gram = (self._gram - own_gram)[np.ix_(chosen, chosen)]
            weights = _solved(gram, (self._product - own_product)[chosen], n - len(x))
            errors.append(float(np.square(y - x[:, chosen] @ weights).sum()))
        return np.asarray(np.maximum(errors, 1e-12))


def _solved(gram: F64, product: F64, n: int) -> F64:
    return np.asarray(np.linalg.solve(gram + RIDGE * n * np.eye(len(gram)), product))


def _thinned(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Trajectories, evenly chosen, of about MAX_STEPS steps together; a single longer one is cut."""
    total = sum(len(one.valid) for one in trajectories)
    stride = max(-(-total // MAX_STEPS), 1)
    if stride > 1 and len(trajectories) > stride:
        trajectories = trajectories[::stride]
    return [
        Trajectory(one.name, one.state[:MAX_STEPS], one.action[:MAX_STEPS], one.valid[:MAX_STEPS])
        for one in trajectories
        if len(one.valid)
    ]


def _alike(trajectories: list[Trajectory]) -> list[Trajectory]:
    """Those with as many columns as the first: a topic may grow a joint between two demonstrations."""
    shapes = [(one.state.shape[1], one.action.shape[1]) for one in trajectories]
    return [one for one, shape in zip(trajectories, shapes, strict=True) if shape == shapes[0]]


def _rows(one: Trajectory) -> Steps:
    """Steps k whose neighbours k - 3 … k + 3, and k + 1's state, may all be used."""
    reach = max(abs(shift) for shift in SHIFTS)
    if len(one.valid) <= 2 * reach:
        return np.empty(0, np.int64)
    usable = one.valid & np.isfinite(one.state).all(axis=1) & np.isfinite(one.action).all(axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(usable, 2 * reach + 1).all(axis=1)
    return np.flatnonzero(windows).astype(np.int64) + reach


def _clipped(change: F64) -> F64:
    limit = CLIP * np.quantile(np.abs(change), 0.99, axis=0)
    return np.clip(change, -limit, limit)


def _standard(values: F64) -> F64:
    """Columns of mean 0 and deviation 1; columns that never change are 0."""
    deviation = values.std(axis=0)
    flat = deviation <= 1e-12 * (1e-12 + np.abs(values).max(axis=0))
    return np.asarray((values - values.mean(axis=0)) / np.where(flat, np.inf, deviation))


def _odd_ones(
    trajectories: Sequence[Trajectory], episode: Steps, past: F64, actions: Mapping[int, F64], target: F64
) -> Iterator[tuple[str, int, float, float]]:
    """Episodes whose own actions, shifted, fit the law of all episodes clearly better than unshifted."""
    if len(trajectories) < FOLDS:
        return
    mean, deviation = actions[0].mean(axis=0), actions[0].std(axis=0)
    deviation = np.where(deviation > 0, deviation, np.inf)
    right = np.concatenate([past, (actions[0] - mean) / deviation], axis=1)
    law = _solved(right.T @ right, right.T @ target, len(right))
    without = _solved(past.T @ past, past.T @ target, len(past))
    n = len(trajectories)
    left_open = np.maximum(np.bincount(episode, np.square(target - past @ without).sum(axis=1), n), 1e-12)
    gains = {}
    for shift, values in actions.items():
        inputs = np.concatenate([past, (values - mean) / deviation], axis=1)
        gains[shift] = 1 - np.bincount(episode, np.square(target - inputs @ law).sum(axis=1), n) / left_open
    steps = np.bincount(episode, minlength=n)
    for i in np.flatnonzero(steps >= EPISODE_STEPS).tolist():
        best = max(SHIFTS, key=lambda shift: float(gains[shift][i]))
        if best != 0 and gains[best][i] > MIN_GAIN and gains[best][i] - gains[0][i] >= EPISODE_MARGIN:
            yield trajectories[i].name, best, float(gains[best][i]), float(gains[0][i])
