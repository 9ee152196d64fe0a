"""What a push does to the T: its outline, and a simulator that tries one push after another.

The same bodies, controller and step as the environment's, without pictures, scores and records of contacts: a third of a
millisecond a push.
What is not pushed stands still, so the T's pose and a place for the disc, at rest, say all that a push needs.
"""

from __future__ import annotations

import numpy as np
import pymunk
from gym_pusht.envs.pusht import PushTEnv as GymPushT

from vilp_data.types import F64

AGENT_RADIUS = 15.0
DT_S, STEPS_PER_ACTION = 0.01, 10
STIFFNESS, DAMPING = 100.0, 20.0  # of the disc's pull towards its target, 1/s^2 and 1/s

CORNERS = np.array([(-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30)], np.float64)
"""Of the T in its own frame, px: the bar's outer edge first."""
MIDDLES = np.array([*((x, 15) for x in range(-45, 46, 15)), *((0, y) for y in range(30, 106, 15))], np.float64)
"""Points [n,2] within it, from end to end of the bar and of the stem."""
_EDGES = np.roll(CORNERS, -1, axis=0) - CORNERS
_LENGTHS = np.hypot(*_EDGES.T)
OUTLINE_LENGTH = float(_LENGTHS.sum())


class PushTrial:
    """Tries pushes, each from any pose of the T."""

    def __init__(self) -> None:
        self._space = pymunk.Space()
        self._space.damping = 0.0
        corners = [(5, 506), (5, 5), (506, 5), (506, 506)]
        for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
            self._space.add(GymPushT.add_segment(self._space, start, end, 2))
        self._agent = GymPushT.add_circle(self._space, (256, 400), AGENT_RADIUS)
        self._block, _ = GymPushT.add_tee(self._space, (256, 300), 0)

    def push(self, block: F64, start: F64, targets: F64) -> F64:
        """The T's pose [3] after `targets` [n,2] are chased for a step each, from `start` [2]; it stands at `block` [3] before. `start`
        is some px away from it: by the time they touch, contacts of an earlier trial are forgotten."""
        agent = self._agent
        agent.position, agent.velocity = (float(start[0]), float(start[1])), (0.0, 0.0)
        self._block.angle = float(block[2])  # turns about the centre of gravity: the position comes after it
        self._block.position = (float(block[0]), float(block[1]))
        self._block.velocity, self._block.angular_velocity = (0.0, 0.0), 0.0
        self._space.reindex_shapes_for_body(agent)
        self._space.reindex_shapes_for_body(self._block)
        for x, y in targets.tolist():
            for _ in range(STEPS_PER_ACTION):
                (at_x, at_y), (v_x, v_y) = agent.position, agent.velocity
                agent.velocity = (
                    v_x + (STIFFNESS * (x - at_x) - DAMPING * v_x) * DT_S,
                    v_y + (STIFFNESS * (y - at_y) - DAMPING * v_y) * DT_S,
                )
                self._space.step(DT_S)
        return np.array((*self._block.position, self._block.angle))


def outline(along: F64) -> tuple[F64, F64]:
    """Places [n,2] on the T's outline and its normals [n,2] there, outwards, in its own frame, at `along` [n] px from the first corner."""
    ends = np.cumsum(_LENGTHS)
    edge = np.minimum(np.searchsorted(ends, along % OUTLINE_LENGTH, side="right"), len(CORNERS) - 1)
    direction = _EDGES[edge] / _LENGTHS[edge, None]
    left = ends[edge] - along % OUTLINE_LENGTH
    return CORNERS[edge] + direction * (_LENGTHS[edge] - left)[:, None], np.stack(
        [direction[:, 1], -direction[:, 0]], 1
    )


def placed(points: F64, pose: F64) -> F64:
    """Points [n,2] of the T's frame on the board, where it stands at `pose` [3]."""
    return turned(points, float(pose[2])) + pose[:2]


def turned(vectors: F64, angle: float | F64) -> F64:
    """Vectors [n,2] turned by `angle`, one for all or [n], from x towards y."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
