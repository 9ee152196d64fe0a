"""The physical world of a robosuite task: one arm, what lies before it, and the cameras of this project instead of robosuite's.

A task's own scene says what else there is. Distances are metres, in the world's frame: x away from the robot, z up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from robosuite.controllers import load_composite_controller_config
from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
from robosuite.models.arenas import TableArena

from vilp_data.errors import UsageError
from vilp_data.types import F64, U8

ROBOTS = ("Panda", "UR5e")
CONTROL_RATE_HZ = 20
TABLE_HEIGHT = 0.8  # of the table of `ArmScene._before_a_table`
TABLE_SIZE = (0.8, 0.8, 0.05)
MAX_POSITION_STEP = 0.05  # what the controller's ±1 means, in metres and in radians
MAX_ROTATION_STEP = 0.5


@dataclass(frozen=True)
class Camera:
    """A camera that stands still: its eye and the point it looks at, m, and its vertical field of view."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov_deg: float


class ArmScene(ManipulationEnv):  # type: ignore[misc]  # robosuite has no types
    """A robosuite environment that is built once, and of which nothing is computed that nobody asked for.

    A task inherits from this alone, or from this before one of robosuite's own environments. `cameras` names what the views look
    through: a `Camera`, or one that the model has already.
    """

    cameras: ClassVar[Mapping[str, Camera | str]]

    def __init__(self, robot: str, *, image_size: tuple[int, int] | None, **arguments: Any) -> None:
        """`image_size` is (height, width) of the largest image that will be drawn; None for a world without cameras. `arguments` go to
        robosuite's own environment. UsageError for an arm that no task was tried with."""
        if robot not in ROBOTS:
            raise UsageError(f"the arm is {' or '.join(ROBOTS)}", where="robot", found=robot)
        self.image_size = image_size
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
            **arguments,
        )

    def placement(self) -> F64:
        """What stands in this episode's world without a joint, so that no physics state holds it: float64 [P], here empty."""
        return np.empty(0)

    def place(self, placement: F64) -> None:
        """Put what `placement` tells to where it was."""

    @property
    def model_and_data(self) -> tuple[Any, Any]:
        """MuJoCo's own model and data, below robosuite's wrappers."""
        return self.sim.model._model, self.sim.data._data

    def grip_position(self) -> F64:
        """The place between the fingertips, float64 [3]."""
        return np.array(self.sim.data.site_xpos[self.robots[0].eef_site_id["right"]])

    def grip_rotation(self) -> F64:
        """Float64 [3,3], its columns the gripper's axes: the fingers open along the first, the third points out of the hand."""
        return np.array(self.sim.data.site_xmat[self.robots[0].eef_site_id["right"]]).reshape(3, 3)

    def grip_velocity(self) -> F64:
        """Float64 [3] m/s."""
        return np.array(self.sim.data.get_site_xvelp(self.robots[0].gripper["right"].important_sites["grip_site"]))

    def gripper_touches(self, geoms: list[str]) -> bool:
        """Whether hand or fingers touch one of these."""
        return bool(self.check_contact(self.robots[0].gripper["right"].contact_geoms, geoms))

    def seed_noise(self, seed: int) -> None:
        """What the next reset of one of robosuite's own environments draws (where things lie, the joints' first angles) follows from
        `seed`."""
        self.rng.bit_generator.state = np.random.default_rng(
            seed
        ).bit_generator.state  # in place: its samplers share it

    def refresh_kinematics(self) -> None:
        """Bring positions and cameras up to date with the joints, touching nothing that the next physics step starts from.

        After a step MuJoCo's poses are one physics step behind; `mj_forward` would also rewrite the solver's warm start, and
        then looking at the world would change what happens next.
        """
        model, data = self.model_and_data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)

    def draw(self, camera: str, height: int, width: int) -> U8:
        """What a camera of the model sees: uint8 [height,width,3] RGB, top row first."""
        self._draw_here()
        image = self.sim.render(width=width, height=height, camera_name=camera)
        return np.ascontiguousarray(image[::-1])  # OpenGL counts rows from the bottom

    def close(self) -> None:
        self._draw_here()
        super().close()

    def _draw_here(self) -> None:
        """OpenGL draws and frees in the context that is current, and robosuite makes none so: with two worlds in a process, one would draw
        with what the other has loaded, and closing one would free the other's."""
        context = self.sim._render_context_offscreen if self.sim is not None else None
        if context is not None:
            context.gl_ctx.make_current()

    def forget_controller_cache(self) -> None:
        """Make the controllers read the joints anew at the next step, after a state was set from outside."""
        for part in self.robots[0].part_controllers.values():
            part.new_update = True

    def _before_a_table(self) -> TableArena:
        """Stand the arm before a table, for a task that has no arena of its own; the arena with it."""
        base = self.robots[0].robot_model
        base.set_base_xpos(base.base_xpos_offset["table"](TABLE_SIZE[0]))
        arena = TableArena(table_full_size=TABLE_SIZE, table_offset=(0, 0, TABLE_HEIGHT))
        arena.set_origin([0, 0, 0])
        return arena

    # --- what robosuite calls ---

    def reward(self, action: Any = None) -> float:
        return 0.0

    def _initialize_sim(self, xml_string: str | None = None) -> None:
        for name, camera in self.cameras.items():
            if isinstance(camera, Camera):
                _add_camera(self.model.worldbody, name, camera)
        if self.image_size is not None:
            _set_drawing_size(self.model.root, *self.image_size)
        super()._initialize_sim(xml_string)

    def _setup_observables(self) -> dict[str, Any]:
        return {}  # robosuite would compute its own at every physics step; ours are read once a control step

    def _reset_internal(self) -> None:
        super()._reset_internal()
        # What the arm's spare freedom is pulled towards. robosuite takes the joints' first angles, which seeds draw and no state holds.
        robot = self.robots[0]
        robot.part_controllers["right"].initial_joint = np.array(robot.init_qpos)
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


def _add_camera(world: Element, name: str, camera: Camera) -> None:
    for known in world.findall(f"camera[@name='{name}']"):
        world.remove(known)
    quaternion = _looking_at(camera.eye, camera.target)
    fov = str(camera.fov_deg)
    SubElement(world, "camera", name=name, mode="fixed", pos=_text(camera.eye), quat=_text(quaternion), fovy=fov)


def _text(numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in numbers)


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
