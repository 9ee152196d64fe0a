"""The physical world of Towers of Hanoi: a table, three pegs in a row, discs with a hole, and one arm.

Distances are metres. Discs are counted from the smallest (0) up, pegs along the row from 0 to 2. The row turns by the base angle
about the middle peg: pi/2 lies across the arm's reach, from the robot's right to its left.
"""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from robosuite.controllers import load_composite_controller_config
from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
from robosuite.models.arenas import TableArena
from robosuite.models.objects import CylinderObject, HollowCylinderObject
from robosuite.models.tasks import ManipulationTask

from vilp_data.types import F64

CONTROL_RATE_HZ = 20
TABLE_HEIGHT = 0.8
TABLE_SIZE = (0.8, 0.8, 0.05)
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
MAX_POSITION_STEP = 0.05  # what the controller's ±1 means, in metres and in radians
MAX_ROTATION_STEP = 0.5

# name -> eye, the point looked at, vertical field of view in degrees
CAMERAS = {
    "front": ((0.58, 0.0, 1.10), (0.0, 0.0, 0.885), 32.0),
    "side": ((0.20, 0.58, 1.02), (0.0, 0.0, 0.885), 32.0),
}


def peg_positions(base_angle: float) -> F64:
    """Where the three pegs stand on the table: float64 [3,2], in world coordinates."""
    direction = np.array([np.cos(base_angle), np.sin(base_angle)])
    return np.asarray(MIDDLE_PEG) + np.outer([-PEG_SPACING, 0.0, PEG_SPACING], direction)


class HanoiScene(ManipulationEnv):  # type: ignore[misc]  # robosuite has no types
    """The robosuite world. It is built once; every reset restores the same model, moves the pegs and stacks the discs."""

    def __init__(self, robot: str, n_discs: int, *, image_size: tuple[int, int] | None) -> None:
        """`image_size` is (height, width) of the largest image that will be drawn; None for a world without cameras."""
        self.n_discs = n_discs
        self.image_size = image_size
        self.start_peg = 0
        self.base_angle = np.pi / 2
        super().__init__(
            robots=robot,
            gripper_types="PandaGripper",
            controller_configs=_controller(robot),
            use_camera_obs=False,
            has_renderer=False,
            has_offscreen_renderer=image_size is not None,
            renderer="mujoco",
            render_camera=None,
            control_freq=CONTROL_RATE_HZ,
            ignore_done=True,
            hard_reset=False,
        )

    @property
    def model_and_data(self) -> tuple[Any, Any]:
        """MuJoCo's own model and data, below robosuite's wrappers."""
        return self.sim.model._model, self.sim.data._data

    @property
    def peg_xy(self) -> F64:
        """float64 [3,2], world."""
        return peg_positions(self.base_angle)

    def disc_position(self, disc: int) -> F64:
        """Centre of a disc, float64 [3], world."""
        return np.array(self.sim.data.body_xpos[self.disc_body_ids[disc]])

    def gripper_touches_discs(self) -> bool:
        discs = [geom for disc in self.discs for geom in disc.contact_geoms]
        return bool(self.check_contact(self.robots[0].gripper["right"].contact_geoms, discs))

    def place_pegs(self, base_angle: float) -> None:
        """Turn the row of pegs."""
        self.base_angle = base_angle
        for body, (x, y) in zip(self.peg_body_ids, self.peg_xy, strict=True):
            self.sim.model.body_pos[body] = (x, y, TABLE_HEIGHT + PEG_HEIGHT / 2)

    def refresh_kinematics(self) -> None:
        """Bring positions and cameras up to date with the joints, touching nothing that the next physics step starts from.

        After a step MuJoCo's poses are one physics step behind; `mj_forward` would also rewrite the solver's warm start, and
        then looking at the world would change what happens next.
        """
        model, data = self.model_and_data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)

    def forget_controller_cache(self) -> None:
        """Make the controllers read the joints anew at the next step, after a state was set from outside."""
        for part in self.robots[0].part_controllers.values():
            part.new_update = True

    # --- what robosuite calls ---

    def reward(self, action: Any = None) -> float:
        return 0.0

    def _load_model(self) -> None:
        super()._load_model()
        base = self.robots[0].robot_model
        base.set_base_xpos(base.base_xpos_offset["table"](TABLE_SIZE[0]))
        arena = TableArena(table_full_size=TABLE_SIZE, table_offset=(0, 0, TABLE_HEIGHT))
        arena.set_origin([0, 0, 0])
        for name, (eye, target, fov_deg) in CAMERAS.items():
            arena.set_camera(name, eye, _looking_at(eye, target), {"fovy": str(fov_deg)})
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
        self.model = ManipulationTask(arena, [base], [*self.pegs, *self.discs])
        if self.image_size is not None:
            _set_drawing_size(self.model.root, *self.image_size)

    def _setup_references(self) -> None:
        super()._setup_references()
        self.peg_body_ids = [self.sim.model.body_name2id(peg.root_body) for peg in self.pegs]
        self.disc_body_ids = [self.sim.model.body_name2id(disc.root_body) for disc in self.discs]

    def _setup_observables(self) -> dict[str, Any]:
        return {}  # robosuite would compute its own at every physics step; ours are read once a control step

    def _reset_internal(self) -> None:
        super()._reset_internal()
        self.place_pegs(self.base_angle)
        x, y = self.peg_xy[self.start_peg]
        facing = [np.cos(self.base_angle / 2), 0.0, 0.0, np.sin(self.base_angle / 2)]  # a flat side towards the fingers
        for level, disc in enumerate(reversed(self.discs)):
            z = TABLE_HEIGHT + (level + 0.5) * DISC_HEIGHT
            self.sim.data.set_joint_qpos(disc.joints[0], np.array([x, y, z, *facing]))
        context = self.sim._render_context_offscreen
        if context is not None:
            context.vopt.sitegroup[:] = 0
            context.scn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = (
                0  # two to three times faster, no change worth seeing
            )


def _controller(robot: str) -> dict[str, Any]:
    """Operational-space pose control by deltas in the base frame, whatever the arm."""
    config: dict[str, Any] = load_composite_controller_config(controller="BASIC", robot=robot)
    arm = config["body_parts"]["right"]
    expected = {"type": "OSC_POSE", "input_type": "delta", "input_ref_frame": "base"}
    arm.update(expected)
    arm["output_max"] = [MAX_POSITION_STEP] * 3 + [MAX_ROTATION_STEP] * 3
    arm["output_min"] = [-limit for limit in arm["output_max"]]
    return config


def _set_drawing_size(model: Element, height: int, width: int) -> None:
    """Draw into a buffer of just this size: the default 640x480 costs a quarter more time for the same pixels."""
    SubElement(SubElement(model, "visual"), "global", offwidth=str(width), offheight=str(height))


def _looking_at(eye: tuple[float, ...], target: tuple[float, ...]) -> F64:
    """Quaternion (w, x, y, z) of a camera at `eye` that looks at `target` with the world's z up in the image."""
    back = np.subtract(eye, target)
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(back, right), back])
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.flatten())
    return quaternion
