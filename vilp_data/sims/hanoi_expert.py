"""A scripted expert for Towers of Hanoi. It sees the true poses, and tries again when a disc slips.

It steers by what it sees at every step, so its actions are those of a closed loop: deltas towards the next waypoint.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import robosuite.utils.transform_utils as transforms

from vilp_data.sims.hanoi import HanoiEnv
from vilp_data.sims.hanoi_scene import DISC_HEIGHT, MAX_POSITION_STEP, MAX_ROTATION_STEP, TABLE_HEIGHT
from vilp_data.types import F32, F64

OPEN, CLOSE = -1.0, 1.0
GRIP_ABOVE_CENTRE = 0.004  # the fingertips, 9 mm below the grip site, then end 2 mm above whatever the disc lies on
TRAVEL_HEIGHT = TABLE_HEIGHT + 0.068  # of the grip site: a carried disc clears the pegs and a full tower
RELEASE_CLEARANCE = 0.004
ATTEMPTS = 4
WAYPOINT_STEPS = 30  # give up on a waypoint that is not reached by then
POSITION_GAIN = 1.3
LOOK_AHEAD_S = 0.06  # a command is held for 0.1 s and the arm has momentum: aim short by the way it will drift
ROTATION_GAIN = 0.7
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
        start = self.env.scene.disc_position(disc)
        yield from self._go(_at_travel_height(start), OPEN, tolerance=0.006)
        yield from self._go(_raised(start, GRIP_ABOVE_CENTRE), OPEN, tolerance=0.002)
        yield from self._stay(CLOSE, CLOSE_STEPS)
        yield from self._go(_at_travel_height(self._ee()), CLOSE, tolerance=0.012)
        held_by = self._ee() - self.env.scene.disc_position(disc)
        if np.linalg.norm(held_by) > DISC_HEIGHT:
            return  # missed
        landing = TABLE_HEIGHT + (self._height[target] + 0.5) * DISC_HEIGHT
        above = np.array([*self.env.scene.peg_xy[target], landing + RELEASE_CLEARANCE]) + held_by
        yield from self._go(_at_travel_height(above), CLOSE, tolerance=0.004)
        yield from self._go(above, CLOSE, tolerance=0.003)
        yield from self._stay(OPEN, OPEN_STEPS)
        yield from self._go(_at_travel_height(self._ee()), OPEN, tolerance=0.012)

    def _go(self, target: F64, gripper: float, *, tolerance: float) -> Iterator[F32]:
        """Towards a position of the grip site (world), within `tolerance` metres, the fingers along the row of pegs."""
        for _ in range(WAYPOINT_STEPS):
            error = target - self._ee()
            if np.linalg.norm(error) < tolerance:
                return
            yield self._action(error, gripper)

    def _stay(self, gripper: float, n_steps: int) -> Iterator[F32]:
        here = self._ee()
        for _ in range(n_steps):
            yield self._action(here - self._ee(), gripper)

    def _action(self, error: F64, gripper: float) -> F32:
        step = POSITION_GAIN * error - LOOK_AHEAD_S * self._ee_velocity()
        step *= min(1.0, MAX_POSITION_STEP / max(float(np.abs(step).max()), 1e-9))  # keep the direction when clipped
        turn = np.clip(ROTATION_GAIN * self._rotation_error(), -MAX_ROTATION_STEP, MAX_ROTATION_STEP)
        return np.concatenate([step, turn, [gripper]]).astype(np.float32)

    def _ee(self) -> F64:
        """Position of the grip site in the world."""
        scene = self.env.scene
        return np.array(scene.sim.data.site_xpos[scene.robots[0].eef_site_id["right"]])

    def _ee_velocity(self) -> F64:
        scene = self.env.scene
        return np.array(scene.sim.data.get_site_xvelp(scene.robots[0].gripper["right"].important_sites["grip_site"]))

    def _rotation_error(self) -> F64:
        """Axis-angle, base frame, that turns the gripper straight down with its fingers opening along the row."""
        scene = self.env.scene
        now = scene.sim.data.site_xmat[scene.robots[0].eef_site_id["right"]].reshape(3, 3)
        along = np.array([np.cos(scene.base_angle), np.sin(scene.base_angle), 0.0])
        if along @ now[:, 0] < 0:  # the fingers are alike: take the nearer half turn
            along = -along
        down = np.array([0.0, 0.0, -1.0])
        wanted = np.column_stack([along, np.cross(down, along), down])
        return np.asarray(transforms.quat2axisangle(transforms.mat2quat(wanted @ now.T)), np.float64)


def _raised(position: F64, by: float) -> F64:
    return np.array([position[0], position[1], position[2] + by])


def _at_travel_height(position: F64) -> F64:
    return np.array([position[0], position[1], TRAVEL_HEIGHT])
