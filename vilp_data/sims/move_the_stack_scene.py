"""The physical world of Move-the-Stack: a table, a stack of nested cups, and a thin black board.

Cups are counted from the lowest (0) up. Each is open above and wider there than below; the next one stands on its bottom and looks out of
it by `NEST_STEP`. So who lifts the lowest lifts them all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar
from xml.etree.ElementTree import SubElement

import mujoco
import numpy as np
from robosuite.models.objects import BoxObject, CompositeObject
from robosuite.models.tasks import ManipulationTask

from vilp_data.sims.arm_reach import bring_hand
from vilp_data.sims.arm_scene import TABLE_HEIGHT, ArmScene, Camera
from vilp_data.types import F64

BOARD_SIZE = (0.13, 0.13, 0.004)
BOARD_COLOUR = (0.02, 0.02, 0.02, 1.0)
CUP_HEIGHT = 0.056
CUP_RADII = (0.017, 0.030)  # at the bottom and at the rim; the gripper opens to 80 mm
CUP_WALL = 0.0012
CUP_SIDES = 8  # flat sides that touch; what is seen is round
NEST_STEP = (
    0.010  # thickness of a bottom. Three cups are 76 mm high: the palm is 85 mm up when the fingers hold the lowest rim
)
CUP_COLOURS = ((0.85, 0.12, 0.10, 1.0), (0.95, 0.75, 0.10, 1.0), (0.10, 0.30, 0.85, 1.0))
FOOT_HALF_WIDTH = 0.012  # of the square that a cup stands on
WALL_BEGINS = 0.002  # above the foot, which alone shall touch what the cup stands on
SEEN_SIDES = 24


class Cup(CompositeObject):  # type: ignore[misc]  # robosuite has no types
    """Its origin is the middle of its foot, z points to its rim. What touches is made of boxes, what is seen is one round mesh."""

    def __init__(self, name: str, colour: tuple[float, ...]) -> None:
        lean = float(np.arctan2(CUP_RADII[1] - CUP_RADII[0], CUP_HEIGHT))
        slant = (CUP_HEIGHT - WALL_BEGINS) / np.cos(lean)
        side = [CUP_WALL / 2, CUP_RADII[0] * np.tan(np.pi / CUP_SIDES), slant / 2]
        middle = (CUP_HEIGHT + WALL_BEGINS) / 2
        reach = np.interp(middle, [0, CUP_HEIGHT], CUP_RADII) - CUP_WALL / 2
        angles = 2 * np.pi / CUP_SIDES * np.arange(CUP_SIDES)
        super().__init__(
            name,
            total_size=[CUP_RADII[1], CUP_RADII[1], CUP_HEIGHT],
            geom_types=["box"] * (CUP_SIDES + 1),
            geom_sizes=[[FOOT_HALF_WIDTH, FOOT_HALF_WIDTH, NEST_STEP / 2], *[side] * CUP_SIDES],
            geom_locations=[(0, 0, NEST_STEP / 2), *((reach * np.cos(a), reach * np.sin(a), middle) for a in angles)],
            geom_quats=[np.array([1.0, 0, 0, 0]), *(_turned_and_leant(a, lean) for a in angles)],
            geom_names=["foot", *(f"side{i}" for i in range(CUP_SIDES))],
            geom_frictions=[np.array([1.0, 0.01, 0.001])] * (CUP_SIDES + 1),
            geom_condims=[4] * (CUP_SIDES + 1),
            density=1500.0,
            locations_relative_to_center=True,
            obj_types="collision",
        )
        vertices, faces = _cup_surface()
        SubElement(self.asset, "mesh", name="cup_surface", vertex=_text(vertices), face=_text(faces))
        seen = {"type": "mesh", "mesh": "cup_surface", "rgba": _text(np.array(colour)), "name": f"{name}_seen"}
        SubElement(self.get_obj(), "geom", seen, group="1", contype="0", conaffinity="0")


class StackScene(ArmScene):
    """Every reset restores the same model, moves the board, stacks the cups, and brings the hand to where the episode begins.

    stack_pose, board_pose   float64 [3]: x, y (m, world) and turn (rad) about the vertical
    hand_pose                float64 [4]: x, y, z of the grip site, and the turn of the fingers about the vertical
    """

    cameras: ClassVar[Mapping[str, Camera | str]] = {
        "front": Camera((0.60, 0.0, 1.24), (-0.02, 0.0, 0.885), 34.0),
        "side": Camera((0.14, 0.62, 1.20), (-0.01, 0.0, 0.885), 34.0),
    }

    def __init__(self, robot: str, n_cups: int, *, image_size: tuple[int, int] | None) -> None:
        self.n_cups = n_cups
        self.stack_pose = np.array([0.0, -0.1, 0.0])
        self.board_pose = np.array([0.0, 0.1, 0.0])
        self.hand_pose = np.array([0.0, 0.0, 1.0, 0.0])
        super().__init__(robot, image_size=image_size)

    def cup_position(self, cup: int) -> F64:
        """The middle of a cup's foot, float64 [3], world."""
        return np.array(self.sim.data.body_xpos[self.cup_body_ids[cup]])

    def cup_rotation(self, cup: int) -> F64:
        """Float64 [3,3], its columns the cup's axes; the third points out of its opening."""
        return np.array(self.sim.data.body_xmat[self.cup_body_ids[cup]]).reshape(3, 3)

    def gripper_touches_cups(self) -> bool:
        return self.gripper_touches([geom for cup in self.cups for geom in cup.contact_geoms])

    def placement(self) -> F64:
        """The board's x, y (m) and turn (rad)."""
        return self.board_pose.copy()

    def place(self, placement: F64) -> None:
        """Lay the board where it was."""
        self.board_pose = np.array(placement, np.float64)
        x, y, turn = self.board_pose
        self.sim.model.body_pos[self.board_body_id] = (x, y, TABLE_HEIGHT + BOARD_SIZE[2] / 2)
        self.sim.model.body_quat[self.board_body_id] = _turned(turn)

    # --- what robosuite calls ---

    def _load_model(self) -> None:
        super()._load_model()
        self.board = BoxObject("board", size=[side / 2 for side in BOARD_SIZE], rgba=BOARD_COLOUR, joints=None)
        self.cups = [Cup(f"cup{i}", CUP_COLOURS[i]) for i in range(self.n_cups)]
        self.model = ManipulationTask(self._before_a_table(), [self.robots[0].robot_model], [self.board, *self.cups])

    def _setup_references(self) -> None:
        super()._setup_references()
        self.board_body_id = self.sim.model.body_name2id(self.board.root_body)
        self.cup_body_ids = [self.sim.model.body_name2id(cup.root_body) for cup in self.cups]

    def _reset_internal(self) -> None:
        super()._reset_internal()
        self.place(self.placement())
        x, y, turn = self.stack_pose
        for level, cup in enumerate(self.cups):
            z = TABLE_HEIGHT + level * NEST_STEP
            self.sim.data.set_joint_qpos(cup.joints[0], np.array([x, y, z, *_turned(turn)]))
        *position, turn = self.hand_pose
        bring_hand(self, np.array(position), pointing_down(turn))


def pointing_down(turn: float) -> F64:
    """The gripper's axes, float64 [3,3], when it points down; its fingers open along the x axis turned by `turn` rad."""
    down = np.array([0.0, 0.0, -1.0])
    along = np.array([np.cos(turn), np.sin(turn), 0.0])
    return np.column_stack([along, np.cross(down, along), down])


def _turned(angle: float) -> F64:
    """Quaternion (w, x, y, z) of a turn about the vertical."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def _turned_and_leant(angle: float, lean: float) -> F64:
    """A wall's quaternion (w, x, y, z): leant outwards, away from the axis, then turned about it."""
    quaternion = np.zeros(4)
    mujoco.mju_mulQuat(quaternion, _turned(angle), np.array([np.cos(lean / 2), 0.0, np.sin(lean / 2), 0.0]))
    return quaternion


def _cup_surface() -> tuple[F64, Any]:
    """Vertices float64 [V,3] m and triangles int [T,3], counter-clockwise from outside: a closed profile turned about the axis."""
    low, high = CUP_RADII
    inside_low = np.interp(NEST_STEP, [0, CUP_HEIGHT], CUP_RADII) - CUP_WALL
    profile = np.array(
        [(0, 0), (low, 0), (high, CUP_HEIGHT), (high - CUP_WALL, CUP_HEIGHT), (inside_low, NEST_STEP), (0, NEST_STEP)]
    )
    angles = 2 * np.pi / SEEN_SIDES * np.arange(SEEN_SIDES)
    rings = np.stack([np.outer(profile[:, 0], np.cos(angles)), np.outer(profile[:, 0], np.sin(angles))], axis=-1)
    heights = np.repeat(profile[:, 1], SEEN_SIDES)[:, None]
    index = np.arange(len(profile) * SEEN_SIDES).reshape(len(profile), SEEN_SIDES)
    a, b = index[:-1], np.roll(index[:-1], -1, axis=1)
    c, d = np.roll(index[1:], -1, axis=1), index[1:]
    triangles = np.concatenate([np.stack([a, b, c], -1)[1:], np.stack([a, c, d], -1)[:-1]]).reshape(-1, 3)
    return np.concatenate([rings.reshape(-1, 2), heights], axis=1), triangles


def _text(numbers: Any) -> str:
    return " ".join(f"{number:.7g}" for number in np.ravel(numbers))
