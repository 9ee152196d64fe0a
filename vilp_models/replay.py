"""Play stored episodes back through their simulator: proof that frames, states and actions belong to their steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vilp_data.errors import UsageError
from vilp_data.types import F32, F64, U8, Episode, Outcome
from vilp_models.metrics import psnr
from vilp_models.starts import tagged_seed

RENDER_MIN_DB = 40.0
"""What frames drawn from recorded states score at least against the stored ones; a swapped channel gets 29."""

LISTED_STATES = 8
"""How many dimensions of the state a report prints; Hanoi has dozens."""

Progress = Callable[[int, int], None]
"""Told (steps done, steps in all)."""


@dataclass(frozen=True)
class StateErrors:
    """How far played states lie from recorded ones: one value for each of S dimensions, in its unit, over all steps."""

    max_abs: tuple[float, ...]
    mean_abs: tuple[float, ...]

    def worst(self, dimensions: Sequence[int]) -> float:
        return max(self.max_abs[i] for i in dimensions)


@dataclass(frozen=True)
class ReplayReport:
    """What playing an episode's actions gave. `shifted`: the same with each action one step early, which must not pass.

    The proof rests on the `controlled` dimensions; the others show how far the whole simulated episode drifts.
    `recorded`: what the episode says it came to. `success`: whether a played step succeeded, None where the simulator does not say.
    """

    episode: str
    n_steps: int
    recorded: Outcome
    success: bool | None
    names: tuple[str, ...]
    controlled: tuple[int, ...]
    error: StateErrors
    shifted: StateErrors

    def proves(self, tolerance: float) -> bool:
        """Do the recorded states come back within `tolerance`, and would actions one step off have been seen?"""
        return not self.fails(tolerance) and tolerance < self.shifted.worst(self.controlled)

    def fails(self, tolerance: float) -> bool:
        """Do they not come back? An episode of a step or two, or at rest, may do neither: its actions are too alike to tell a shift."""
        return not self.error.worst(self.controlled) <= tolerance


@dataclass(frozen=True)
class RenderReport:
    """How well frames drawn from recorded states match the stored ones: view -> PSNR in dB at each of `steps`.

    `next_step_db`: the same drawings against the following step's frames, which must not match. Equal frames score 100.
    """

    episode: str
    steps: tuple[int, ...]
    psnr_db: Mapping[str, tuple[float, ...]]
    next_step_db: Mapping[str, tuple[float, ...]]

    def proves(self, minimum_db: float = RENDER_MIN_DB) -> bool:
        """Does every drawing match its step's frame, and some drawing not match the following one's?"""
        return all(min(self.psnr_db[view]) >= minimum_db > min(self.next_step_db[view]) for view in self.psnr_db)


# --- states ---------------------------------------------------------------------------------------------------------


def replay(episode: Episode, env: Any, *, progress: Progress | None = None) -> ReplayReport:
    """Play the episode's actions from its first state and compare every later state; then again one step off.

    Raises UsageError where the episode lacks actions or states, or has one that is not finite. `progress` counts the
    steps of both plays: 2 (F - 1) in all.
    """
    actions, states = _replayable(episode)
    n_steps = len(states) - 1
    periods = np.array(env.metadata.get("state_periods", (np.inf,) * states.shape[1]))
    seed = tagged_seed(episode.tags)
    plays, errors = [], []
    for shift in (0, 1):
        told = None if progress is None else _behind(progress, before=shift * n_steps, total=2 * n_steps)
        plays.append(play(env, states[0], actions[shift : shift + n_steps], seed=seed, progress=told))
        errors.append(_compare(plays[-1].states, states[1:], periods))
    names = env.metadata.get("state_names", tuple(f"state[{i}]" for i in range(states.shape[1])))
    controlled = env.metadata.get("controlled_state", tuple(range(states.shape[1])))
    return ReplayReport(
        episode.id, n_steps, episode.outcome, plays[0].success, tuple(names), tuple(controlled), *errors
    )


@dataclass(frozen=True)
class Play:
    """What actions came to: the states float64 [k,S] after each, and whether any of them was a success (None: not said)."""

    states: F64
    success: bool | None


def play(env: Any, state: F64, actions: F32, *, seed: int | None = None, progress: Progress | None = None) -> Play:
    """Take `actions` [k,A] in turn from `state` [S], past success too."""
    env.reset(seed=seed, options={"state": state})
    states, success = [], None
    for action in actions:
        _, _, _, _, info = env.step(action)
        states.append(info["state"])
        if "is_success" in info:
            success = bool(success or info["is_success"])
        if progress is not None:
            progress(len(states), len(actions))
    return Play(np.stack(states).astype(np.float64), success)


def _behind(progress: Progress, *, before: int, total: int) -> Progress:
    """Progress of a part that follows `before` steps of `total`."""
    return lambda done, _: progress(before + done, total)


def _replayable(episode: Episode) -> tuple[F32, F64]:
    if episode.action is None or episode.state is None:
        missing = "actions" if episode.action is None else "simulator states"
        raise UsageError(f"no {missing} to play back", where=episode.id, remedy="choose an episode that has both")
    if episode.n_steps < 2:
        raise UsageError("one step leaves nothing to compare", where=episode.id, remedy="choose a longer episode")
    finite = np.isfinite(episode.action).all(axis=1) & np.isfinite(episode.state).all(axis=1)
    if not finite.all():
        where = f"{episode.id}, step {int(np.argmin(finite))}"
        raise UsageError(
            "an action or state is not finite", where=where, remedy="choose an episode without invalid steps"
        )
    return episode.action, episode.state


def _compare(played: F64, recorded: F64, periods: F64) -> StateErrors:
    if played.shape != recorded.shape:
        raise UsageError(
            "the simulator's state is not laid out like the episode's",
            found=f"{played.shape[1]} values, recorded {recorded.shape[1]}",
            remedy="replay with the simulator that recorded it",
        )
    difference = played - recorded
    wraps = np.isfinite(periods)
    difference[:, wraps] -= periods[wraps] * np.round(difference[:, wraps] / periods[wraps])
    absolute = np.abs(difference)
    return StateErrors(tuple(absolute.max(axis=0).tolist()), tuple(absolute.mean(axis=0).tolist()))


# --- frames ---------------------------------------------------------------------------------------------------------


def render_match(episode: Episode, env: Any, *, every: int = 1, progress: Progress | None = None) -> RenderReport:
    """Draw the environment at the recorded state of each `every`-th step but the last, and compare with its frames.

    Raises UsageError where the episode has no states, or the environment lacks a view or draws it at another size.
    """
    if episode.state is None:
        raise UsageError("no simulator states to draw", where=episode.id, remedy="choose an episode that has them")
    steps = range(0, episode.n_steps - 1, every)
    if not steps:
        raise UsageError("one step leaves nothing to compare", where=episode.id, remedy="choose a longer episode")
    seed = tagged_seed(episode.tags)
    same: dict[str, list[float]] = {view: [] for view in episode.frames}
    following: dict[str, list[float]] = {view: [] for view in episode.frames}
    for done, step in enumerate(steps, start=1):
        observation, _ = env.reset(seed=seed, options={"state": episode.state[step]})
        for view, frames in episode.frames.items():
            drawn = _drawn(observation, view, frames.shape[1:])
            same[view].append(psnr(drawn, frames[episode.source_index[view][step]]))
            following[view].append(psnr(drawn, frames[episode.source_index[view][step + 1]]))
        if progress is not None:
            progress(done, len(steps))
    return RenderReport(episode.id, tuple(steps), _frozen(same), _frozen(following))


def _drawn(observation: Mapping[str, U8], view: str, shape: tuple[int, ...]) -> U8:
    remedy = "compare the task's [views] with its [sim]"
    if view not in observation:
        raise UsageError(f"the simulator has no view {view!r}", found=", ".join(observation), remedy=remedy)
    drawn = observation[view]
    if drawn.shape != shape:
        raise UsageError(f"view {view!r} has another size", found=f"drawn {drawn.shape}, stored {shape}", remedy=remedy)
    return drawn


def _frozen(values: Mapping[str, Sequence[float]]) -> dict[str, tuple[float, ...]]:
    return {view: tuple(row) for view, row in values.items()}


# --- reports --------------------------------------------------------------------------------------------------------


def format_replay(report: ReplayReport, *, tolerance: float | None = None) -> list[str]:
    """Lines for a terminal: a verdict where there is a tolerance, then the controlled states and the worst others."""
    worst, worst_shifted = (errors.worst(report.controlled) for errors in (report.error, report.shifted))
    verdict = "" if tolerance is None else f" ({_verdict(report, tolerance)})"
    lines = [
        f"{report.episode}: {report.n_steps} step{'' if report.n_steps == 1 else 's'} replayed, off by at most {worst:.2g}{verdict}; "
        f"with actions one step early by {worst_shifted:.2g}",
        f"  {'':<14}{'max':>10}{'mean':>10}{'one early: max':>18}{'mean':>10}",
    ]
    order = sorted(range(len(report.names)), key=lambda i: (i not in report.controlled, -report.error.max_abs[i]))
    for i in order[:LISTED_STATES]:
        exact = f"{report.error.max_abs[i]:>10.2g}{report.error.mean_abs[i]:>10.2g}"
        shifted = f"{report.shifted.max_abs[i]:>18.2g}{report.shifted.mean_abs[i]:>10.2g}"
        lines.append(f"  {report.names[i]:<14}{exact}{shifted}")
    if len(order) > LISTED_STATES:
        lines.append(f"  and {len(order) - LISTED_STATES} more")
    return lines


def _verdict(report: ReplayReport, tolerance: float) -> str:
    if report.fails(tolerance):
        return f"NOT within {tolerance:g}"
    return f"within {tolerance:g}" + ("" if report.proves(tolerance) else ", but too alike to tell a step's shift")


def format_replays(reports: Sequence[ReplayReport], proven: Sequence[bool]) -> str:
    """A line for a terminal: how many of the episodes are `proven`, and how many came to what was recorded of them."""
    line = f"{sum(proven)} of {len(reports)} episodes replay as recorded"
    told = [report for report in reports if report.recorded != "unknown" and report.success is not None]
    if told:
        alike = sum(report.success == (report.recorded == "success") for report in told)
        succeeded = sum(report.recorded == "success" for report in told)
        line += f"; {alike} of {len(told)} end as recorded ({succeeded} in success)"
    return line


def format_render(report: RenderReport, *, minimum_db: float = RENDER_MIN_DB) -> list[str]:
    """Lines for a terminal, one a view: verdict, worst and median frame, and the worst when one step off."""
    lines = []
    for view, values in report.psnr_db.items():
        worst = int(np.argmin(values))
        verdict = "matches" if values[worst] >= minimum_db else "does NOT match"
        lines.append(
            f"{report.episode}, {view}: {verdict} at {minimum_db:g} dB: "
            f"worst {values[worst]:.1f} (step {report.steps[worst]}), median {np.median(values):.1f}; "
            f"one step off: worst {min(report.next_step_db[view]):.1f}"
        )
    return lines
