"""A scripted expert of Arrange-Blocks that does not always do the same.

Drawn for each episode: the block that stays where it is, in whose row the others come to stand; which of them comes first; on
which side of blocks the pusher goes around them; how fast it goes. A block is pushed up or down, whichever way the row lies. What is
still to be done shows in the picture: a row drawn at random would not, and nobody could learn from a picture where it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vilp_data.sims.arrange_blocks import ArrangeBlocksEnv
from vilp_data.sims.arrange_blocks_table import PUSHER_RADIUS, REACH, WALL, WORLD, in_a_row
from vilp_data.sims.free_way import Ways, cell_centres, clear_cost
from vilp_data.types import F32, F64

CLEAR = REACH + PUSHER_RADIUS + 12  # from a block's centre, on the way around it
WRONG_SIDE = 2.0  # what a cell beside a block costs in addition on the side that the style does not take
EDGE = WALL + PUSHER_RADIUS + 1  # from the table's edge
LEAD = 50.0  # px that the target is ahead of the pusher while it goes somewhere
PUSH_LEAD = 24.0  # and while it pushes
ARRIVED = 12.0
OFF_CENTRE = 10.0  # px, at most, between where a push meets a block and its middle
CLOSE_ENOUGH = 3.0  # px between a block's centre and the row: well inside the rule's tolerance
PATIENCE = 80  # steps of one leg
ROUNDS = 3  # a block may be touched on the way to another


@dataclass(frozen=True)
class Style:
    """How an episode is done.

    stays, order  which block stays, and the two that come to it, first to last (0, 1, 2)
    side          -1 goes around blocks on their left, 1 on their right
    speed         factor of the leads
    """

    stays: int
    order: tuple[int, int]
    side: int
    speed: float


class ArrangeBlocksExpert:
    """Drives a freshly reset `ArrangeBlocksEnv`: iterate `actions()`, and step the environment with each before asking for the next.

    It goes on for a step or two after the environment calls the episode a success: to the middle of the tolerance, not to its edge.
    """

    goes_on_after_success = True

    def __init__(self, env: ArrangeBlocksEnv, *, seed: int) -> None:
        self.env = env
        self._random = np.random.default_rng((seed, 1))  # not what the start was drawn from
        stays, first, second = self._random.permutation(3).tolist()
        side, speed = self._random.choice((-1, 1)), self._random.uniform(0.8, 1.2)
        self.style = Style(stays, (first, second), int(side), float(speed))
        self._push = ["up" if self._below(block) > 0 else "down" for block in self.style.order]
        self._centres = cell_centres(*WORLD)

    def tags(self) -> dict[str, str]:
        """The style, for an episode's log."""
        return {
            "style_stays": str(self.style.stays + 1),
            "style_order": "".join(str(block + 1) for block in self.style.order),
            "style_push": ",".join(self._push),
            "style_side": "left" if self.style.side < 0 else "right",
            "style_speed": f"{self.style.speed:.2f}",
        }

    def actions(self) -> Iterator[F32]:
        """Actions float32 [2] until the blocks stand in a row, or `ROUNDS` have not brought them there."""
        for _ in range(ROUNDS):
            for block in self.style.order:
                if in_a_row(self.env.blocks[:, 1]):
                    return
                if abs(self._below(block)) > CLOSE_ENOUGH:
                    yield from self._bring(block)

    def _below(self, block: int) -> float:
        """How far a block is below the row, px."""
        y = self.env.blocks[:, 1]
        return float(y[block] - y[self.style.stays])

    def _bring(self, block: int) -> Iterator[F32]:
        """Go behind the block as seen from the row, and push it there."""
        behind = math.copysign(1.0, self._below(block))
        off_centre = float(self._random.uniform(-OFF_CENTRE, OFF_CENTRE))
        x, y, _ = self.env.blocks[block]
        yield from self._go(_inside((x + off_centre, y + behind * CLEAR)))
        for _ in range(PATIENCE):
            left = self._below(block) * behind
            if left <= CLOSE_ENOUGH / 2:
                return
            ahead = min(PUSH_LEAD * self.style.speed, left + 4)
            x = float(self.env.blocks[block, 0])
            yield _inside((x + off_centre, self.env.pusher[1] - behind * ahead)).astype(np.float32)

    def _go(self, goal: F64) -> Iterator[F32]:
        """To `goal`, around the blocks."""
        lead = LEAD * self.style.speed
        way = Ways(self.env.pusher, self._centres, self._cost()).to(goal)
        for _ in range(PATIENCE):
            while len(way) > 1 and math.dist(way[0], self.env.pusher) < lead:
                way.pop(0)
            gap = way[0] - self.env.pusher
            distance = math.hypot(*gap)
            if distance < ARRIVED and len(way) == 1:
                return
            yield _inside(self.env.pusher + gap * min(1.0, lead / distance)).astype(np.float32)

    def _cost(self) -> F64:
        """Of ways between the blocks, float64 [rows,columns]: see `Ways`."""
        blocks = self.env.blocks[:, :2]
        offset = self._centres[:, :, None] - blocks
        beside = np.hypot(offset[..., 0], offset[..., 1]) < 2 * CLEAR
        wrong = beside & (np.sign(offset[..., 0]) != self.style.side)
        return np.asarray(clear_cost(self._centres, blocks, CLEAR) + WRONG_SIDE * wrong.sum(axis=2), np.float64)


def _inside(point: F64 | tuple[float, float]) -> F64:
    """`point` [2], or where the table keeps the pusher from going further."""
    return np.asarray(np.clip(point, EDGE, np.array(WORLD) - EDGE), np.float64)
