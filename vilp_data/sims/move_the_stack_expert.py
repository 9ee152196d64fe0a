"""A scripted expert of Move-the-Stack that does not always do the same, and tries again when the stack slips.

Drawn for each episode: between which flat sides of the lowest cup the fingers take it, how high the stack is carried, whether straight
over or in a bow to one side, and how fast. It goes to the middle of the board: a spot on it that was drawn would not show in the picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vilp_data.sims.arm_motion import CLOSE, OPEN, WAYPOINT_STEPS, ArmMotion, at_height, raised
from vilp_data.sims.arm_scene import TABLE_HEIGHT
from vilp_data.sims.move_the_stack import MoveTheStackEnv
from vilp_data.sims.move_the_stack_scene import BOARD_SIZE, CUP_HEIGHT, CUP_SIDES
from vilp_data.types import F32, F64

GRIP_HEIGHT = CUP_HEIGHT  # of the grip site above the lowest foot: the rim of the lowest cup is between the pads
ABOVE_STACK = 0.05  # and of open fingers above that, before they come down around the stack
RELEASE_CLEARANCE = 0.003
TURNED = 0.1  # rad
LOST = 0.02  # m between the hand and where it took hold of the lowest cup
ATTEMPTS = 4
CLOSE_STEPS = 4
OPEN_STEPS = 5  # the fingers' targets ramp for ten control steps
PATHS = {"straight": 0.0, "left": 0.07, "right": -0.07}  # m, at the middle of the way, as seen along it


@dataclass(frozen=True)
class Style:
    """How an episode is done.

    fingers   through which of the cup's flat sides, 0 to CUP_SIDES / 2 - 1: they open at that many eighths of a turn from the cups' own
    path      one of PATHS
    carry     m that the stack is lifted
    step      m that the hand goes in a step, on its way with the stack
    """

    fingers: int
    path: str
    carry: float
    step: float


class MoveTheStackExpert:
    """Drives a freshly reset `MoveTheStackEnv`: iterate `actions()`, and step the environment with each before asking for the next."""

    goes_on_after_success = False

    def __init__(self, env: MoveTheStackEnv, *, seed: int = 0) -> None:
        self.env = env
        random = np.random.default_rng((seed, 1))  # not what the start was drawn from
        self.style = Style(
            fingers=int(random.integers(CUP_SIDES // 2)),
            path=str(random.choice(list(PATHS))),
            carry=float(random.uniform(0.03, 0.10)),
            step=float(random.uniform(0.02, 0.04)),
        )
        self._arm = ArmMotion(env.scene, np.array([1.0, 0.0, 0.0]))

    def tags(self) -> dict[str, str]:
        """The style, for an episode's log."""
        return {
            "style_fingers": str(self.style.fingers),
            "style_path": self.style.path,
            "style_carry": f"{self.style.carry:.3f}",
            "style_step": f"{self.style.step:.3f}",
        }

    def actions(self) -> Iterator[F32]:
        """Actions float32 [7] until the stack is on the board, has slipped `ATTEMPTS` times, or is none any more."""
        for _ in range(ATTEMPTS):
            if self.env.is_solved() or not self.env.is_stacked():
                return
            yield from self._carry_over()

    def _carry_over(self) -> Iterator[F32]:
        """Take hold of the lowest cup wherever it is, carry it over the board, let go, and rise."""
        arm, scene, style = self._arm, self.env.scene, self.style
        hold = raised(scene.cup_position(0), GRIP_HEIGHT)
        arm.fingers_along = self._across_sides()
        yield from arm.go(raised(hold, ABOVE_STACK), OPEN, tolerance=0.008)
        yield from self._turn_above(raised(hold, ABOVE_STACK))
        yield from arm.go(hold, OPEN, tolerance=0.003)
        yield from arm.stay(CLOSE, CLOSE_STEPS)
        yield from arm.go(raised(scene.grip_position(), style.carry), CLOSE, tolerance=0.012)
        held_by = scene.grip_position() - scene.cup_position(0)
        if np.linalg.norm(held_by - [0, 0, GRIP_HEIGHT]) > LOST:
            yield from arm.stay(OPEN, OPEN_STEPS)  # lost: open again before coming down on it
            return
        landing = np.array([*scene.board_pose[:2], TABLE_HEIGHT + BOARD_SIZE[2] + RELEASE_CLEARANCE]) + held_by
        above = at_height(landing, scene.grip_position()[2])
        for point in self._way_to(above):
            yield arm.action(point - scene.grip_position(), CLOSE)
        yield from arm.go(above, CLOSE, tolerance=0.008)
        yield from arm.go(landing, CLOSE, tolerance=0.002)
        yield from arm.stay(OPEN, OPEN_STEPS)
        yield from arm.go(raised(scene.grip_position(), ABOVE_STACK), OPEN, tolerance=0.012)

    def _turn_above(self, place: F64) -> Iterator[F32]:
        """Until the fingers open along the way they should: turning, they would push the stack over."""
        for _ in range(WAYPOINT_STEPS):
            if np.linalg.norm(self._arm.rotation_error()) < TURNED:
                return
            yield self._arm.action(place - self.env.scene.grip_position(), OPEN)

    def _across_sides(self) -> F64:
        """The direction, float64 [3], in which the fingers open across the sides of the lowest cup that the style takes."""
        side = self.env.scene.cup_rotation(0)[:, 0]
        angle = np.arctan2(side[1], side[0]) + self.style.fingers * 2 * np.pi / CUP_SIDES
        return np.array([np.cos(angle), np.sin(angle), 0.0])

    def _way_to(self, goal: F64) -> F64:
        """Points a step apart, float64 [K,3], from the hand to `goal`: straight, or in a bow."""
        start = self.env.scene.grip_position()
        n_steps = max(1, int(np.ceil(np.linalg.norm(goal - start) / self.style.step)))
        share = np.linspace(0, 1, n_steps + 1)[1:, None]
        to_the_left = np.cross([0.0, 0.0, 1.0], goal - start)
        to_the_left /= max(float(np.linalg.norm(to_the_left)), 1e-9)
        way: F64 = start + share * (goal - start) + PATHS[self.style.path] * np.sin(np.pi * share) * to_the_left
        return way
