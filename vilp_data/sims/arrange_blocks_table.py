"""The table of Arrange-Blocks without its physics: its measures, the rule of success, and where episodes begin."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vilp_data.types import F64

WORLD = (800.0, 480.0)  # width, height, px
WALL = 5.0  # thickness of the walls inside it
BLOCK_SIDE = 85.0
PUSHER_RADIUS = 15.0
IMAGE_SHAPE = (96, 160, 3)

TOLERANCE = 10.0
"""Of the row: the blocks' centres differ by less than this in y (the paper's |y1 - y2| < 10 and |y1 - y3| < 10)."""

REACH = BLOCK_SIDE * math.sqrt(0.5)
"""From a block's centre to its corners."""

# Where blocks begin: behind each the pusher must find room to push it away from the wall, and beside each there is room for any other,
# so a row is possible wherever they stand.
MARGIN_X, MARGIN_Y = 75.0, 105.0
APART_X = 150.0
PUSHER_FREE = REACH + PUSHER_RADIUS + 5  # between the pusher and a block's centre


def in_a_row(y: F64 | Sequence[float]) -> bool:
    """The paper's success for the centres' y [3], px: |y1 - y2| < 10 and |y1 - y3| < 10."""
    return row_share(y) == 1.0


def row_share(y: F64 | Sequence[float]) -> float:
    """Share of |y1 - y2|, |y1 - y3| that are below the tolerance: 0, 0.5 or 1."""
    first, second, third = y
    return (int(abs(first - second) < TOLERANCE) + int(abs(first - third) < TOLERANCE)) / 2


def draw_start(random: np.random.Generator) -> F64:
    """A start without overlaps that is not solved: float64 [11], laid out as the environment's state. Blocks stand in columns of
    their own, in any order, turned by any angle: a square turned by pi/2 looks as before."""
    width, height = WORLD
    spare = width - 2 * MARGIN_X - 2 * APART_X
    while True:
        columns = MARGIN_X + np.sort(random.uniform(0, spare, 3)) + APART_X * np.arange(3)
        x = random.permutation(columns)
        y = random.uniform(MARGIN_Y, height - MARGIN_Y, 3)
        angle = random.uniform(0, math.pi / 2, 3)
        edge = WALL + PUSHER_RADIUS
        pusher = random.uniform((edge, edge), (width - edge, height - edge))
        if not in_a_row(y) and np.hypot(x - pusher[0], y - pusher[1]).min() > PUSHER_FREE:
            return np.concatenate([pusher, np.stack([x, y, angle], axis=1).ravel()])
