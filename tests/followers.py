"""A robot that follows smooth commands, simulated between its control ticks: as scripted, planned and filtered demonstrations are."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from vilp_data.check.action_fit import Trajectory
from vilp_data.types import F64

SUBSTEPS = 10


def follower(
    *, rate_hz: float = 10.0, lag_s: float = 0.1, segment_s: float = 1.0, command_noise: float = 0.0, state_noise: float = 1e-4,
    recorded_noise: float = 0.0, delay_s: float = 0.0, second_order: bool = False, late: int = 0, episodes: int = 6, seed: int = 0,
) -> list[Trajectory]:  # fmt: skip
    """Demonstrations of minimum-jerk commands between random waypoints, followed with a time constant of `lag_s` after a dead time of
    `delay_s`. The motion over [t_k, t_{k+1}) is driven by the command held there, a_k, and by nothing later. `command_noise` drives the
    robot too; `recorded_noise` is in the recorded commands alone. Actions are stored `late` steps late."""
    return [
        _demonstration(
            np.random.default_rng([seed, number]), f"e{number}", rate_hz, lag_s, segment_s, command_noise, state_noise,
            recorded_noise, delay_s, second_order, late,
        )
        for number in range(episodes)
    ]  # fmt: skip


def _demonstration(
    rng: np.random.Generator, name: str, rate_hz: float, lag_s: float, segment_s: float, command_noise: float, state_noise: float,
    recorded_noise: float, delay_s: float, second_order: bool, late: int,
) -> Trajectory:  # fmt: skip
    step_s = 1 / (rate_hz * SUBSTEPS)
    command = np.concatenate(list(_minimum_jerk(rng, step_s, segment_s)))
    action = command[::SUBSTEPS] + rng.normal(0, command_noise, command[::SUBSTEPS].shape)
    held = np.repeat(action, SUBSTEPS, axis=0)[: len(command)]
    held = np.concatenate([np.repeat(held[:1], round(delay_s / step_s), axis=0), held])[: len(command)]
    state, velocity, stiffness = np.empty_like(held), np.zeros(held.shape[1]), 2 / lag_s
    state[0] = command[0]
    for k in range(1, len(held)):
        away = held[k - 1] - state[k - 1]
        damped = velocity + step_s * (stiffness**2 * away - 2 * stiffness * velocity)  # critically
        velocity = damped if second_order else away / lag_s
        state[k] = state[k - 1] + step_s * velocity
    seen = state[::SUBSTEPS] + rng.normal(0, state_noise, action.shape)
    recorded = action + rng.normal(0, recorded_noise, action.shape)
    return Trajectory(name, seen, np.roll(recorded, late, axis=0), np.ones(len(seen), np.bool_))


def _minimum_jerk(rng: np.random.Generator, step_s: float, segment_s: float) -> Iterator[F64]:
    points = rng.uniform(-1, 1, (12, 2))
    for start, end in pairwise(points):
        share = np.arange(0, 1, step_s / (segment_s * rng.uniform(0.7, 1.3)))[:, None]
        yield start + (end - start) * (10 * share**3 - 15 * share**4 + 6 * share**5)
