"""Does the action explain how the state moves, and at which shift does it do so best: the off-by-one detector. Pure.

At step k a robot's state changes by s_{k+1} - s_k. Most of that change follows from where it was and how it moved before, so a smooth
robot is well predicted by any action near the right one. What tells shifts apart is what remains: the share of the change
that the state and its own past leave open, and that the action a_{k+σ} explains. Each σ in SHIFTS gets a ridge regression

    s_{k+1} - s_k  from  [s_k, s_k - s_{k-1}, a_{k+σ}]

fitted on four fifths of the steps and judged on the rest, five times. Rightly stored data is best at σ = 0. The best at σ = 1 means that
the action of a step is stored one step late.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vilp_data.check.findings import Finding, Place
from vilp_data.types import F64, Bool

SHIFTS = tuple(range(-3, 4))
"""More than three steps off is no off-by-one: the clocks are then compared by header lag."""

FOLDS = 5
RIDGE = 1e-3
"""Of the number of steps, on standardised columns: enough for columns that repeat each other, too little to bias the rest."""

CLIP = 3.0
"""Changes beyond so many times their 99th percentile are wrapped angles, flipped quaternions and resets, and are cut to it."""

MIN_STEPS = 200
MIN_STEPS_PER_COLUMN = 4
"""Fewer steps fit a regression to noise."""

MAX_STEPS = 50_000
"""More steps tell nothing new about all together; taken evenly from the episodes, so that memory and time stay bounded."""

MARGIN = 0.05
"""The best shift must explain so much more than shift 0 does, as a share of what the past leaves open."""

MIN_GAIN = 0.05
"""An action that explains less than this at every shift does not drive the state."""

FOLDS_AGREE = 4
"""Of FOLDS: in so many the best shift must beat shift 0."""

EPISODE_MARGIN = 0.15
EPISODE_STEPS = 40
"""One episode against the others: fewer steps and smaller differences are chance."""


@dataclass(frozen=True)
class Stretch:
    """One demonstration's steps: state float64 [F,S], action float64 [F,A], and where both may be used, bool [F]."""

    name: str
    state: F64
    action: F64
    valid: Bool


@dataclass(frozen=True)
class ActionFit:
    """How well the action explains the motion, by shift.

    gain       shift -> share of the change, left open by the state and its own past, that the action explains on held-out steps: 1 all
               of it, 0 or less nothing
    own_past   share of the change that the state and its past explain by themselves
    agreeing   shift -> folds in which it beats shift 0
    odd        (episode, its best shift, gain there, gain at 0): episodes that fit another shift than all together
    """

    gain: dict[int, float]
    own_past: float
    agreeing: dict[int, int]
    n_steps: int
    odd: tuple[tuple[str, int, float, float], ...] = ()

    @property
    def best(self) -> int:
        """The shift that explains most."""
        return max(self.gain, key=lambda shift: (self.gain[shift], -abs(shift)))

    @property
    def shifted(self) -> bool:
        """Whether another shift than 0 is clearly better."""
        best = self.best
        return best != 0 and self.gain[best] - self.gain[0] >= MARGIN and self.agreeing[best] >= FOLDS_AGREE


def fit_action(stretches: Sequence[Stretch]) -> ActionFit | None:
    """The fit over all stretches together; None where there are too few steps, or nothing moves."""
    stretches = _alike(_thinned(stretches))
    rows = [_rows(stretch) for stretch in stretches]
    episode = np.repeat(np.arange(len(rows)), [len(steps) for steps in rows])
    n = len(episode)
    if n < MIN_STEPS:
        return None
    change = np.concatenate([s.state[k + 1] - s.state[k] for s, k in zip(stretches, rows, strict=True)])
    past = np.concatenate(
        [
            np.concatenate([s.state[k], s.state[k] - s.state[k - 1]], axis=1)
            for s, k in zip(stretches, rows, strict=True)
        ]
    )
    actions = {
        shift: np.concatenate([s.action[k + shift] for s, k in zip(stretches, rows, strict=True)]) for shift in SHIFTS
    }
    moving = change.std(axis=0) > 1e-9 * (1e-9 + np.abs(past[:, : change.shape[1]]).max(axis=0))
    if not moving.any() or n < MIN_STEPS_PER_COLUMN * (past.shape[1] + actions[0].shape[1]):
        return None
    target = _standard(_clipped(change[:, moving]))
    past = _standard(_clipped_differences(past))
    fold = np.arange(n) * FOLDS // n
    open_error = _held_out(past, target, fold)
    errors = {
        shift: _held_out(np.concatenate([past, _standard(a)], axis=1), target, fold) for shift, a in actions.items()
    }
    left = _per_fold(open_error, fold)
    by_fold = {shift: 1 - _per_fold(error, fold) / left for shift, error in errors.items()}
    return ActionFit(
        gain={shift: float(1 - error.sum() / open_error.sum()) for shift, error in errors.items()},
        own_past=float(1 - open_error.sum() / np.square(target).sum()),
        agreeing={shift: int((gains > by_fold[0]).sum()) for shift, gains in by_fold.items()},
        n_steps=n,
        odd=tuple(_odd_ones(stretches, episode, past, actions, target, open_error)),
    )


def action_findings(fit: ActionFit, *, topic: str, rate_hz: float, certain: bool) -> Iterator[Finding]:
    """What the fit says. `certain`: a task names action and state; else they were guessed by their names, and an error is a warning."""
    best, step_ms = fit.best, 1e3 / rate_hz
    evidence: dict[str, float | int | str] = {
        f"explained_at_shift_{shift:+d}": round(gain, 4) for shift, gain in fit.gain.items()
    }
    evidence |= {"explained_by_own_past": round(fit.own_past, 4), "n_steps": fit.n_steps, "rate_hz": rate_hz}
    place = Place(topic=topic)
    if fit.gain[best] < MIN_GAIN:
        yield Finding(
            severity="warning" if certain else "note", kind="action-says-nothing", place=place, evidence=evidence,
            what=f"the action does not predict motion: at no shift does it explain more than {max(fit.gain[best], 0):.0%} of it",
            remedy="name the topic that drives the robot as the action; where none was recorded, "
            '[action.NAME] from = "STATE", shift = 1',
        )  # fmt: skip
    elif fit.shifted and best > 0:
        yield Finding(
            severity="error" if certain else "warning", kind="action-late", place=place, evidence=evidence,
            what=f"the action fits best {_steps(best)} late: that of step k+{best} explains {fit.gain[best]:.0%} of the motion"
            f" at step k, its own {max(fit.gain[0], 0):.0%}",
            remedy=f"offset_s = {-best / rate_hz:.4g} on the action's topic ({best} x {step_ms:.3g} ms), and ingest again",
        )  # fmt: skip
    elif fit.shifted:
        yield Finding(
            severity="note", kind="action-early", place=place, evidence=evidence,
            what=f"the action fits best {_steps(-best)} early: that of step k{best} explains {fit.gain[best]:.0%} of the motion"
            f" at step k, its own {max(fit.gain[0], 0):.0%}",
            remedy=f"a robot that follows its commands {-best * step_ms:.0f} ms later looks like this; if it does not, offset_s ="
            f" {-best / rate_hz:.4g} on the action's topic",
        )  # fmt: skip
    for name, shift, there, here in fit.odd if not fit.shifted else ():
        late = "late" if shift > 0 else "early"
        yield Finding(
            severity="warning", kind="action-odd-episode", place=Place(topic=topic, episode=name),
            what=f"here the action fits best {_steps(abs(shift))} {late}, unlike in the others",
            evidence={f"explained_at_shift_{shift:+d}": round(there, 4), "explained_at_shift_+0": round(here, 4)},
            remedy="compare its clocks with another's by `vilp-data inspect`, or leave this episode out",
        )  # fmt: skip


def _steps(count: int) -> str:
    return {1: "one step", 2: "two steps", 3: "three steps"}[count]


# --- the regression -----------------------------------------------------------------------------------------------------


def _thinned(stretches: Sequence[Stretch]) -> list[Stretch]:
    """Stretches, evenly chosen, of about MAX_STEPS steps together; a single longer one is cut."""
    total = sum(len(stretch.valid) for stretch in stretches)
    stride = max(-(-total // MAX_STEPS), 1)
    if stride > 1 and len(stretches) > stride:
        stretches = stretches[::stride]
    return [
        Stretch(s.name, s.state[:MAX_STEPS], s.action[:MAX_STEPS], s.valid[:MAX_STEPS])
        for s in stretches
        if len(s.valid)
    ]


def _alike(stretches: list[Stretch]) -> list[Stretch]:
    """Those with as many columns as the first: a topic may grow a joint between two demonstrations."""
    shapes = [(s.state.shape[1], s.action.shape[1]) for s in stretches]
    return [s for s, shape in zip(stretches, shapes, strict=True) if shape == shapes[0]]


def _rows(stretch: Stretch) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Steps k whose neighbours k - 3 … k + 3, and k + 1's state, may all be used."""
    reach = max(abs(shift) for shift in SHIFTS)
    n = len(stretch.valid)
    if n <= 2 * reach:
        return np.empty(0, np.int64)
    usable = stretch.valid & np.isfinite(stretch.state).all(axis=1) & np.isfinite(stretch.action).all(axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(usable, 2 * reach + 1).all(axis=1)
    return np.flatnonzero(windows).astype(np.int64) + reach


def _clipped(change: F64) -> F64:
    limit = CLIP * np.quantile(np.abs(change), 0.99, axis=0)
    return np.clip(change, -limit, limit)


def _clipped_differences(past: F64) -> F64:
    """The past's second half are differences, cut like the changes that they predict."""
    half = past.shape[1] // 2
    return np.concatenate([past[:, :half], _clipped(past[:, half:])], axis=1)


def _standard(values: F64) -> F64:
    """Columns of mean 0 and deviation 1; columns that never change are 0."""
    deviation = values.std(axis=0)
    flat = deviation <= 1e-12 * (1e-12 + np.abs(values).max(axis=0))
    return np.asarray((values - values.mean(axis=0)) / np.where(flat, np.inf, deviation))


def _solved(gram: F64, product: F64, n: int) -> F64:
    return np.asarray(np.linalg.solve(gram + RIDGE * n * np.eye(len(gram)), product))


def _held_out(inputs: F64, target: F64, fold: np.ndarray[tuple[int], np.dtype[np.int64]]) -> F64:
    """Squared error of each step [n], predicted by the folds that do not hold it."""
    edges = np.searchsorted(fold, np.arange(1, FOLDS))
    parts = list(zip(np.split(inputs, edges), np.split(target, edges), strict=True))
    grams = [x.T @ x for x, _ in parts]
    products = [x.T @ y for x, y in parts]
    gram, product = sum(grams), sum(products)
    errors = []
    for (x, y), own_gram, own_product in zip(parts, grams, products, strict=True):
        weights = _solved(gram - own_gram, product - own_product, len(inputs) - len(x))
        errors.append(np.square(y - x @ weights).sum(axis=1))
    return np.concatenate(errors)


def _per_fold(error: F64, fold: np.ndarray[tuple[int], np.dtype[np.int64]]) -> F64:
    return np.maximum(np.bincount(fold, error, FOLDS), 1e-12)


def _odd_ones(
    stretches: Sequence[Stretch],
    episode: np.ndarray[tuple[int], np.dtype[np.int64]],
    past: F64,
    actions: dict[int, F64],
    target: F64,
    open_error: F64,
) -> Iterator[tuple[str, int, float, float]]:
    """Episodes whose own actions, shifted, fit the law of all episodes clearly better than unshifted."""
    if len(stretches) < FOLDS:
        return
    mean, deviation = actions[0].mean(axis=0), actions[0].std(axis=0)
    deviation = np.where(deviation > 0, deviation, np.inf)
    right = np.concatenate([past, (actions[0] - mean) / deviation], axis=1)
    weights = _solved(right.T @ right, right.T @ target, len(right))
    n = len(stretches)
    left = np.maximum(np.bincount(episode, open_error, n), 1e-12)
    gains = {}
    for shift, values in actions.items():
        inputs = np.concatenate([past, (values - mean) / deviation], axis=1)
        gains[shift] = 1 - np.bincount(episode, np.square(target - inputs @ weights).sum(axis=1), n) / left
    steps = np.bincount(episode, minlength=n)
    for i in np.flatnonzero(steps >= EPISODE_STEPS).tolist():
        best = max(SHIFTS, key=lambda shift: float(gains[shift][i]))
        if best != 0 and gains[best][i] > MIN_GAIN and gains[best][i] - gains[0][i] >= EPISODE_MARGIN:
            yield stretches[i].name, best, float(gains[best][i]), float(gains[0][i])
