"""A scripted expert of Push-T: it tries pushes in a simulator of its own, and does the one that pays most for its time.

Which pushes it tries is drawn from a seed, so two episodes that begin alike do not go alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vilp_data.sims.free_way import CELL, Ways, cell_centres, clear_cost
from vilp_data.sims.pusht import BOARD_SIZE, PushTEnv
from vilp_data.sims.pusht_trial import AGENT_RADIUS, MIDDLES, OUTLINE_LENGTH, PushTrial, outline, placed, turned
from vilp_data.types import F32, F64

GAP = 8.0  # px between disc and T before a push
EDGE = 24.0  # px that the disc's middle keeps from the board's edge
CLEAR = AGENT_RADIUS + 18.0  # and from the T's outline on the way to a push: corners of ways are cut
SPEED = 16.0  # px that the target moves in a step of a push
LEAD = 50.0  # px that the target is ahead of the disc on the way to a push
ARRIVED = 3.0
PATIENCE = 60  # steps of a way
MAX_PUSHES = 60

LONGEST = 140.0  # px of a push, from contact on
STEEPEST = 0.6  # rad between a push and the T's face
FIRST_TRIES, BEST, BETTER_TRIES = 90, 4, 50  # pushes drawn anywhere; the best of them; pushes drawn near those
OUTLINE_POINTS = 36  # that stand for the whole outline
GOOD_ENOUGH = 0.3  # px: a T that is nearer than this to its goal on the average need not be brought nearer
PAUSE = 6.0  # steps that a push is taken to cost beside its own and those of the way to it
WAY_SPEED = 25.0  # px a step, about, on the way to a push


@dataclass(frozen=True)
class Push:
    """A push beside the T where it stands now.

    draw     float64 [3]: where along the outline, px; slant to the face there, rad; length from contact on, px
    start    float64 [2], px of the board: where the disc begins, at rest
    targets  float64 [n,2], px of the board: one a step
    """

    draw: F64
    start: F64
    targets: F64


class PushTExpert:
    """Drives a freshly reset `PushTEnv`: iterate `actions()`, and step the environment with each before asking for the next."""

    goes_on_after_success = False

    def __init__(self, env: PushTEnv, *, seed: int) -> None:
        self.env = env
        self._random = np.random.default_rng((seed, 2))  # not what the start was drawn from
        self._trial = PushTrial()
        self._outline, _ = outline((np.arange(OUTLINE_POINTS) + 0.5) / OUTLINE_POINTS * OUTLINE_LENGTH)
        self._goal = placed(self._outline, env.goal_pose)
        self._centres = cell_centres(BOARD_SIZE, BOARD_SIZE)

    def tags(self) -> dict[str, str]:
        """Nothing: there is no style to an episode, every push is a draw."""
        return {}

    def actions(self) -> Iterator[F32]:
        """Actions float32 [2], push after push: the environment says when it is enough."""
        for _ in range(MAX_PUSHES):
            push = self._choose()
            if push is None:
                return
            yield from self._go(push.start)
            yield from push.targets.astype(np.float32)

    # --- which push ---

    def _choose(self) -> Push | None:
        """The best of pushes drawn anywhere around the T and of others drawn near the best of those; None where there is no room."""
        random = self._random
        anywhere = np.stack(
            [
                random.uniform(0, OUTLINE_LENGTH, FIRST_TRIES),
                random.uniform(-STEEPEST, STEEPEST, FIRST_TRIES),
                LONGEST * random.uniform(0.04, 1, FIRST_TRIES) ** 2,  # most of them short
            ],
            axis=1,
        )
        tried = self._tried(anywhere)
        if not tried:
            return None
        tried.sort(key=lambda one: one[0], reverse=True)
        best = np.array([push.draw for _, push in tried[:BEST]])
        near = best[np.arange(BETTER_TRIES) % len(best)] + random.normal(0, (8, 0.15, 0), (BETTER_TRIES, 3))
        near[:, 2] *= np.exp(random.normal(0, 0.3, BETTER_TRIES))
        return max([*tried, *self._tried(near)], key=lambda one: one[0])[1]

    def _tried(self, draws: F64) -> list[tuple[float, Push]]:
        """What each of `draws` [n,3] pays, but for those without room: how often a step of it halves the distance to the goal."""
        pose, ways = self.env.block, self._ways()
        before = self._distance(pose)
        tried = []
        for push in self._pushes(draws, pose):
            after = self._distance(self._trial.push(pose, push.start, push.targets))
            n_steps = PAUSE + ways.cost_to(push.start) * CELL / WAY_SPEED + len(push.targets)
            tried.append((math.log2((before + GOOD_ENOUGH) / (after + GOOD_ENOUGH)) / n_steps, push))
        return tried

    def _pushes(self, draws: F64, pose: F64) -> Iterator[Push]:
        """Those of `draws` that keep on the board and begin clear of the T."""
        along, slant, length = draws.T
        places, normals = outline(along)
        places, normals = placed(places, pose), turned(normals, float(pose[2]))
        starts = places + normals * (AGENT_RADIUS + GAP)
        ends = starts + turned(-normals, slant) * (length + GAP)[:, None]
        gaps = np.hypot(*(starts[:, None] - placed(self._outline, pose)).transpose(2, 0, 1)).min(axis=1)
        points = np.concatenate([starts, ends], axis=1)
        on_board = ((points > EDGE) & (points < BOARD_SIZE - EDGE)).all(axis=1)
        for i in np.flatnonzero(on_board & (gaps > AGENT_RADIUS + GAP - 3)):
            n_steps = max(2, math.ceil((length[i] + GAP) / SPEED))
            share = np.minimum(np.arange(1, n_steps + 2) / n_steps, 1)  # the last one twice: the disc lags behind
            yield Push(draws[i], starts[i], starts[i] + (ends[i] - starts[i]) * share[:, None])

    def _distance(self, pose: F64) -> float:
        """Mean distance of the T's outline from where it should be, px."""
        return float(np.hypot(*(placed(self._outline, pose) - self._goal).T).mean())

    # --- the way there ---

    def _go(self, goal: F64) -> Iterator[F32]:
        """To `goal`, around the T."""
        way = self._ways().to(goal)
        for _ in range(PATIENCE):
            while len(way) > 1 and math.dist(way[0], self.env.agent) < LEAD / 2:
                way.pop(0)
            gap = way[0] - self.env.agent
            distance = math.hypot(*gap)
            if distance < ARRIVED and len(way) == 1:
                return
            target = self.env.agent + gap * min(1.0, LEAD / distance)
            yield np.clip(target, EDGE, BOARD_SIZE - EDGE).astype(np.float32)

    def _ways(self) -> Ways:
        """From where the disc is."""
        things = placed(np.concatenate([self._outline, MIDDLES]), self.env.block)
        return Ways(self.env.agent, self._centres, clear_cost(self._centres, things, CLEAR))
