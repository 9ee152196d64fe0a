"""The physical world of Towers of Hanoi: a table, three pegs in a row, and discs with a hole.

Discs are counted from the smallest (0) up, pegs along the row from 0 to 2. The row turns by the base angle about the middle peg: pi/2
lies across the arm's reach, from the robot's right to its left.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from robosuite.models.objects import CylinderObject, HollowCylinderObject
from robosuite.models.tasks import ManipulationTask

from vilp_data.sims.arm_scene import TABLE_HEIGHT, ArmScene, Camera
from vilp_data.types import F64

MIDDLE_PEG = (0.0, 0.0)
PEG_SPACING = 0.12
PEG_HEIGHT = 0.036  # a taller one reaches the palm when the lowest disc is grasped
PEG_RADIUS = 0.006
DISC_HEIGHT = 0.014
DISC_RADII = (0.025, 0.031, 0.037)  # the gripper opens to 80 mm
DISC_HOLE_RADIUS = 0.012
DISC_SIDES = 8  # boxes a ring is made of; resting contacts, and with them the time of a step, grow with its square
DISC_COLOURS = ((0.85, 0.12, 0.10, 1.0), (0.10, 0.55, 0.15, 1.0), (0.10, 0.25, 0.80, 1.0))
PEG_COLOUR = (0.95, 0.75, 0.10, 1.0)


def peg_positions(base_angle: float) -> F64:
    """Where the three pegs stand on the table: float64 [3,2], in world coordinates."""
    direction = np.array([np.cos(base_angle), np.sin(base_angle)])
    return np.asarray(MIDDLE_PEG) + np.outer([-PEG_SPACING, 0.0, PEG_SPACING], direction)


class HanoiScene(ArmScene):
    """Every reset restores the same model, moves the pegs and stacks the discs."""

    cameras: ClassVar[Mapping[str, Camera | str]] = {
        "front": Camera((0.58, 0.0, 1.10), (0.0, 0.0, 0.885), 32.0),
        "side": Camera((0.20, 0.58, 1.02), (0.0, 0.0, 0.885), 32.0),
    }

    def __init__(self, robot: str, n_discs: int, *, image_size: tuple[int, int] | None) -> None:
        self.n_discs = n_discs
        self.start_peg = 0
        self.base_angle = np.pi / 2
        super().__init__(robot, image_size=image_size)

    @property
    def peg_xy(self) -> F64:
        """float64 [3,2], world."""
        return peg_positions(self.base_angle)

    def disc_position(self, disc: int) -> F64:
        """Centre of a disc, float64 [3], world."""
        return np.array(self.sim.data.body_xpos[self.disc_body_ids[disc]])

    def gripper_touches_discs(self) -> bool:
        return self.gripper_touches([geom for disc in self.discs for geom in disc.contact_geoms])

    def placement(self) -> F64:
        """The base angle, rad."""
        return np.array([self.base_angle])

    def place(self, placement: F64) -> None:
        """Turn the row of pegs."""
        self.base_angle = float(placement[0])
        for body, (x, y) in zip(self.peg_body_ids, self.peg_xy, strict=True):
            self.sim.model.body_pos[body] = (x, y, TABLE_HEIGHT + PEG_HEIGHT / 2)

    # --- what robosuite calls ---

    def _load_model(self) -> None:
        super()._load_model()
        self.pegs = [
            CylinderObject(f"peg{i}", size=[PEG_RADIUS, PEG_HEIGHT / 2], rgba=PEG_COLOUR, joints=None) for i in range(3)
        ]
        self.discs = [
            HollowCylinderObject(
                f"disc{i}", outer_radius=DISC_RADII[i], inner_radius=DISC_HOLE_RADIUS, height=DISC_HEIGHT / 2, ngeoms=DISC_SIDES,
                rgba=DISC_COLOURS[i], density=600.0, friction=(1.0, 0.01, 0.001),
            )
            for i in range(self.n_discs)
        ]  # fmt: skip
        self.model = ManipulationTask(self._before_a_table(), [self.robots[0].robot_model], [*self.pegs, *self.discs])

    def _setup_references(self) -> None:
        super()._setup_references()
        self.peg_body_ids = [self.sim.model.body_name2id(peg.root_body) for peg in self.pegs]
        self.disc_body_ids = [self.sim.model.body_name2id(disc.root_body) for disc in self.discs]

    def _reset_internal(self) -> None:
        super()._reset_internal()
        self.place(self.placement())
        x, y = self.peg_xy[self.start_peg]
        facing = [np.cos(self.base_angle / 2), 0.0, 0.0, np.sin(self.base_angle / 2)]  # a flat side towards the fingers
        for level, disc in enumerate(reversed(self.discs)):
            z = TABLE_HEIGHT + (level + 0.5) * DISC_HEIGHT
            self.sim.data.set_joint_qpos(disc.joints[0], np.array([x, y, z, *facing]))
