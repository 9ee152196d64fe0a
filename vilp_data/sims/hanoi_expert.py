"""A scripted expert for Towers of Hanoi, which tries again when a disc slips."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vilp_data.sims.arm_motion import CLOSE, OPEN, ArmMotion, at_height, raised
from vilp_data.sims.arm_scene import TABLE_HEIGHT
from vilp_data.sims.hanoi import HanoiEnv
from vilp_data.sims.hanoi_scene import DISC_HEIGHT
from vilp_data.types import F32, F64

GRIP_ABOVE_CENTRE = 0.004  # the fingertips, 9 mm below the grip site, then end 2 mm above whatever the disc lies on
TRAVEL_HEIGHT = TABLE_HEIGHT + 0.068  # of the grip site: a carried disc clears the pegs and a full tower
RELEASE_CLEARANCE = 0.004
ATTEMPTS = 4
CLOSE_STEPS = 4
OPEN_STEPS = 5  # the fingers' targets ramp for ten control steps; only at the end do they clear the largest disc


def hanoi_moves(n_discs: int, source: int, target: int) -> list[tuple[int, int, int]]:
    """The 2^n - 1 moves (disc, from peg, to peg) that carry `n_discs` discs from peg `source` to peg `target`."""
    if n_discs == 0:
        return []
    spare = 3 - source - target
    largest = (n_discs - 1, source, target)
    return [*hanoi_moves(n_discs - 1, source, spare), largest, *hanoi_moves(n_discs - 1, spare, target)]


class HanoiExpert:
    """Drives a freshly reset `HanoiEnv`: iterate `actions()`, and step the environment with each before asking for the next.

    It has one way of doing it, whatever the seed.
    """

    goes_on_after_success = False

    def __init__(self, env: HanoiEnv, *, seed: int = 0) -> None:
        self.env = env
        self._height = [env.n_discs, 0, 0]  # how many discs each peg holds
        self._arm = ArmMotion(env.scene, np.array([np.cos(env.base_angle), np.sin(env.base_angle), 0.0]))

    def actions(self) -> Iterator[F32]:
        """Actions float32 [7] until the puzzle is solved, or until one disc has slipped `ATTEMPTS` times."""
        for disc, source, target in hanoi_moves(self.env.n_discs, 0, self.env.goal_peg):
            self._height[source] -= 1
            for _ in range(ATTEMPTS):
                yield from self._carry(disc, target)
                if self.env.is_on_peg(disc, target, self._height[target]):
                    break
            else:
                return
            self._height[target] += 1

    def tags(self) -> dict[str, str]:
        """Nothing: there is one way."""
        return {}

    def _carry(self, disc: int, target: int) -> Iterator[F32]:
        """Grasp a disc wherever it is, carry it over a peg, let go, and rise."""
        arm, scene = self._arm, self.env.scene
        start = scene.disc_position(disc)
        yield from arm.go(_at_travel_height(start), OPEN, tolerance=0.006)
        yield from arm.go(raised(start, GRIP_ABOVE_CENTRE), OPEN, tolerance=0.002)
        yield from arm.stay(CLOSE, CLOSE_STEPS)
        yield from arm.go(_at_travel_height(scene.grip_position()), CLOSE, tolerance=0.012)
        held_by = scene.grip_position() - scene.disc_position(disc)
        if np.linalg.norm(held_by) > DISC_HEIGHT:
            return  # missed
        landing = TABLE_HEIGHT + (self._height[target] + 0.5) * DISC_HEIGHT
        above = np.array([*scene.peg_xy[target], landing + RELEASE_CLEARANCE]) + held_by
        yield from arm.go(_at_travel_height(above), CLOSE, tolerance=0.004)
        yield from arm.go(above, CLOSE, tolerance=0.003)
        yield from arm.stay(OPEN, OPEN_STEPS)
        yield from arm.go(_at_travel_height(scene.grip_position()), OPEN, tolerance=0.012)


def _at_travel_height(position: F64) -> F64:
    return at_height(position, TRAVEL_HEIGHT)
