"""How scripted experts move an arm: closed-loop steps towards a place, the gripper pointing straight down unless told otherwise.

An expert sees the true poses. It steers by what it sees at every step, so its actions are deltas towards the next waypoint.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import robosuite.utils.transform_utils as transforms

from vilp_data.sims.arm_scene import MAX_POSITION_STEP, MAX_ROTATION_STEP, ArmScene
from vilp_data.types import F32, F64

OPEN, CLOSE = -1.0, 1.0
WAYPOINT_STEPS = 30  # give up on a waypoint that is not reached by then
POSITION_GAIN = 1.3
LOOK_AHEAD_S = 0.06  # a command is held for 0.1 s and the arm has momentum: aim short by the way it will drift
ROTATION_GAIN = 0.7
DOWN = np.array([0.0, 0.0, -1.0])


class ArmMotion:
    """Moves the gripper of `scene`; each method gives actions float32 [7] of `ArmEnv`, to be stepped one at a time.

    fingers_along   a direction, float64 [3] in the world, of length 1: the fingers open along it, either way round
    pointing        where they point, float64 [3] of length 1, square to the other: straight down unless it is set

    Both may be set anew at any time; the hand turns there on its way.
    """

    def __init__(self, scene: ArmScene, fingers_along: F64) -> None:
        self.scene = scene
        self.fingers_along = fingers_along
        self.pointing = DOWN

    def go(self, target: F64, gripper: float, *, tolerance: float, n_steps: int = WAYPOINT_STEPS) -> Iterator[F32]:
        """Towards a position of the grip site (world), within `tolerance` metres, in `n_steps` at most."""
        for _ in range(n_steps):
            error = target - self.scene.grip_position()
            if np.linalg.norm(error) < tolerance:
                return
            yield self.action(error, gripper)

    def stay(self, gripper: float, n_steps: int) -> Iterator[F32]:
        """Where the hand is now."""
        here = self.scene.grip_position()
        for _ in range(n_steps):
            yield self.action(here - self.scene.grip_position(), gripper)

    def action(self, error: F64, gripper: float) -> F32:
        """One step towards a place that lies `error` (float64 [3] m) from the grip site."""
        step = POSITION_GAIN * error - LOOK_AHEAD_S * self.scene.grip_velocity()
        step *= min(1.0, MAX_POSITION_STEP / max(float(np.abs(step).max()), 1e-9))  # keep the direction when clipped
        turn = np.clip(ROTATION_GAIN * self.rotation_error(), -MAX_ROTATION_STEP, MAX_ROTATION_STEP)
        return np.concatenate([step, turn, [gripper]]).astype(np.float32)

    def rotation_error(self) -> F64:
        """Axis-angle, base frame, that turns the gripper to where it should point, its fingers opening as they should."""
        now = self.scene.grip_rotation()
        along = self.fingers_along
        if along @ now[:, 0] < 0:  # the fingers are alike: take the nearer half turn
            along = -along
        wanted = np.column_stack([along, np.cross(self.pointing, along), self.pointing])
        return np.asarray(transforms.quat2axisangle(transforms.mat2quat(wanted @ now.T)), np.float64)


def raised(position: F64, by: float) -> F64:
    """A place so many metres above another."""
    return np.array([position[0], position[1], position[2] + by])


def at_height(position: F64, height: float) -> F64:
    """The place above or below at a height in the world."""
    return np.array([position[0], position[1], height])
