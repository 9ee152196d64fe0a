"""What every robosuite task is to gymnasium: views, proprioception, actions, states and topics of one arm, at 10 Hz.

One `step` holds its action for two control steps of robosuite (20 Hz, the rate its gripper and controllers are tuned for). A task adds
its scene, what a seed draws, and its success rule.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import gymnasium
import mujoco
import numpy as np
import robosuite.utils.transform_utils as transforms

from vilp_data.errors import UsageError
from vilp_data.sims.arm_scene import CONTROL_RATE_HZ, MAX_POSITION_STEP, MAX_ROTATION_STEP, ArmScene
from vilp_data.types import F32, F64

if TYPE_CHECKING:
    from vilp_data.recorder import EpisodeRecorder

BASE_FRAME = "base"
RATE_HZ = 10
GRIPPER_OPEN, GRIPPER_CLOSED = -1.0, 1.0
HAND_DOWN = np.array([1.0, 1.0, 0.0, 0.0]) / np.sqrt(
    2
)  # (x, y, z, w): a hand that points down, its fingers across the reach
_MUJOCO_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS | mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_WARMSTART

Scene = TypeVar("Scene", bound=ArmScene)


@dataclass(frozen=True)
class Proprioception:
    """What the robot's own sensors say at one instant of simulated time.

    time_s             since the reset
    joint_position     float64 [J] rad, joint_velocity float64 [J] rad/s, in the order of `ArmEnv.joint_names`
    ee_position        float64 [3] m, in the robot's base frame
    ee_quaternion      float64 [4] (x, y, z, w), base frame; of its two signs, after a reset the one nearer `HAND_DOWN`, from there
                       on the one nearer the sample before
    gripper_position   float64 [2] m, the finger joints: (0.04, -0.04) open, (0, 0) closed
    """

    time_s: float
    joint_position: F64
    joint_velocity: F64
    ee_position: F64
    ee_quaternion: F64
    gripper_position: F64


class ArmEnv(gymnasium.Env[dict[str, Any], F32], Generic[Scene], ABC):  # type: ignore[misc]  # gymnasium is not followed
    """One arm at a task.

    observation  each view of the scene: uint8 [height,width,3] RGB, top row first (none with cameras=False, or after `set_drawing(False)`);
                 low_dim: float32 [9], end-effector position, quaternion (x, y, z, w), finger joints
    action       float32 [7]: position delta in m (±0.05), axis-angle delta in rad (±0.5), both in the base frame and from the
                 pose reached so far; gripper -1 open, +1 close
    info         state: float64 [S], all that `reset(options={"state": ...})` needs to go on from here bit for bit, whatever the
                 seed; but where the hand has turned more than half a turn from `HAND_DOWN`, the quaternion goes on with the
                 other sign;
                 is_success: bool; proprioception: the samples since the last step, 20 Hz, the newest at this observation;
                 hold_action: float32 [7], no motion and the gripper as it was last told (open, before it was told anything; from a
                 restored state, to the side that the fingers' targets are on, which may still be on their way to the other)
    terminated   on success
    truncated    never: how long an episode may be, says who plays it (`sim.max_steps`)
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array"],
        "render_fps": RATE_HZ,
        # On the machine that recorded, states come back bit for bit; another processor may round the physics differently.
        "replay_tolerance": 1e-6,
    }

    def __init__(self, scene: Scene, *, height: int, width: int, cameras: bool) -> None:
        """`height` and `width` are those of every view, of a `scene` that was built to draw them if `cameras`."""
        self.scene = scene
        self.cameras = cameras
        self.height, self.width = height, width
        self.render_mode = "rgb_array" if cameras else None
        self.action_space = _action_space()
        self.observation_space = _observation_space(self.views, height, width)
        self._gripper_command = GRIPPER_OPEN
        self._ee_quaternion = HAND_DOWN
        self._drawing = True

    # --- what a task says

    @abstractmethod
    def draw_episode(self, rng: np.random.Generator) -> None:
        """Draw what sets this episode apart, for the reset of the scene that follows. What robosuite's own environments draw (where their
        things lie, the joints' first angles) is drawn by themselves; in a scene of ours the joints begin at the robot's own angles."""

    @abstractmethod
    def is_solved(self) -> bool:
        """The task's success rule, of the scene as it is now."""

    @abstractmethod
    def tags(self) -> dict[str, str]:
        """What sets this episode apart from others of the task."""

    # --- gymnasium

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        state = (options or {}).get("state")
        self.draw_episode(self.np_random)
        self.scene.seed_noise(int(self.np_random.integers(1 << 62)))
        self.scene.reset()
        self._gripper_command = GRIPPER_OPEN
        self._ee_quaternion = HAND_DOWN
        if state is not None:
            self._restore(np.asarray(state, np.float64))
        self.scene.forget_controller_cache()
        self.scene.refresh_kinematics()
        return self._observation(), self._info([self._proprioception()])

    def step(self, action: F32) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        command = _controller_command(action)
        samples = []
        for _ in range(CONTROL_RATE_HZ // RATE_HZ):
            self.scene.step(command)
            self.scene.refresh_kinematics()
            samples.append(self._proprioception())
        self._gripper_command = float(command[-1])
        info = self._info(samples)
        success = bool(info["is_success"])
        return self._observation(), float(success), success, False, info

    def render(self) -> Any:
        """All views side by side, uint8 [height, n width, 3]; None without cameras."""
        return np.concatenate([self._image(name) for name in self.views], axis=1) if self.cameras else None

    def set_drawing(self, on: bool) -> None:
        """Whether observations hold the views from now on; one that nobody looks at takes most of a step's time."""
        self._drawing = on

    def close(self) -> None:
        self.scene.close()

    @property
    def views(self) -> tuple[str, ...]:
        """Those that are drawn."""
        return tuple(self.scene.cameras) if self.cameras else ()

    # --- topics

    @property
    def joint_names(self) -> list[str]:
        return [name.removeprefix("robot0_") for name in self.scene.robots[0].robot_joints]

    @property
    def gripper_names(self) -> list[str]:
        return [name.removeprefix("gripper0_right_") for name in self.scene.robots[0].gripper_joints["right"]]

    def write_tick(
        self, log: EpisodeRecorder, stamp_ns: int, observation: Mapping[str, Any], info: Mapping[str, Any], action: F32
    ) -> None:
        """Write what the task's topics hold at one tick: what was measured since the last one, and the command issued now."""
        *_, newest = info["proprioception"]
        for sample in info["proprioception"]:
            self._write_proprioception(log, stamp_ns + round((sample.time_s - newest.time_s) * 1e9), sample)
        for view in (name for name in observation if name != "low_dim"):
            log.image(f"/camera/{view}/image", stamp_ns, observation[view], frame_id=f"camera_{view}")
        log.vector("/sim/state", stamp_ns, info["state"])
        log.twist("/action/ee_delta", stamp_ns, action[:3], action[3:6], frame_id=BASE_FRAME)
        log.joint_state("/action/gripper", stamp_ns, ["gripper"], action[6:])

    def _write_proprioception(self, log: EpisodeRecorder, stamp_ns: int, sample: Proprioception) -> None:
        log.joint_state("/joint_states", stamp_ns, self.joint_names, sample.joint_position, sample.joint_velocity)
        log.pose("/ee_pose", stamp_ns, sample.ee_position, sample.ee_quaternion, frame_id=BASE_FRAME)
        log.joint_state("/gripper/state", stamp_ns, self.gripper_names, sample.gripper_position)

    # --- state ---

    def state(self) -> F64:
        """float64 [S]: MuJoCo's physics, control and warm start; the gripper's ramp (2); the scene's placement."""
        model, data = self.scene.model_and_data
        physics = np.empty(mujoco.mj_stateSize(model, _MUJOCO_STATE))
        mujoco.mj_getState(model, data, physics, _MUJOCO_STATE)
        return np.concatenate([physics, self._gripper_ramp(), self.scene.placement()])

    def _restore(self, state: F64) -> None:
        model, data = self.scene.model_and_data
        n_physics = mujoco.mj_stateSize(model, _MUJOCO_STATE)
        expected = n_physics + 2 + len(self.scene.placement())
        if state.shape != (expected,):
            raise UsageError(
                "this state is not from this environment",
                where="options['state']",
                found=f"shape {state.shape}, expected ({expected},)",
                remedy=f"make {type(self).__name__} with the options of the recording",
            )
        self.scene.place(state[n_physics + 2 :])
        mujoco.mj_setState(model, data, state[:n_physics], _MUJOCO_STATE)
        ramp = state[n_physics : n_physics + 2].copy()
        self.scene.robots[0].gripper["right"].current_action = ramp
        self._gripper_command = GRIPPER_CLOSED if ramp[1] > 0 else GRIPPER_OPEN

    def _gripper_ramp(self) -> F64:
        """The finger targets in ±1, moved a fifth per control step; robosuite begins with a single zero for both."""
        return np.broadcast_to(np.asarray(self.scene.robots[0].gripper["right"].current_action, np.float64), 2)

    # --- observations ---

    def _observation(self) -> dict[str, Any]:
        now = self._proprioception()
        low_dim = np.concatenate([now.ee_position, now.ee_quaternion, now.gripper_position]).astype(np.float32)
        drawn = self.views if self._drawing else ()
        return {**{name: self._image(name) for name in drawn}, "low_dim": low_dim}

    def _info(self, samples: list[Proprioception]) -> dict[str, Any]:
        return {
            "state": self.state(),
            "is_success": self.is_solved(),
            "proprioception": tuple(samples),
            "hold_action": np.array([0, 0, 0, 0, 0, 0, self._gripper_command], np.float32),
        }

    def _image(self, view: str) -> Any:
        camera = self.scene.cameras[view]
        return self.scene.draw(camera if isinstance(camera, str) else view, self.height, self.width)

    def _proprioception(self) -> Proprioception:
        robot, data = self.scene.robots[0], self.scene.sim.data
        # Of a hand that points down w is about 0, and the sign that a matrix gives by itself a matter of rounding.
        quaternion = _quaternion(self.scene)
        self._ee_quaternion = quaternion if quaternion @ self._ee_quaternion >= 0 else -quaternion
        return Proprioception(
            time_s=float(data.time),
            joint_position=data.qpos[robot._ref_joint_pos_indexes].copy(),
            joint_velocity=data.qvel[robot._ref_joint_vel_indexes].copy(),
            ee_position=self.scene.grip_position() - robot.base_pos,
            ee_quaternion=self._ee_quaternion,
            gripper_position=data.qpos[robot._ref_gripper_joint_pos_indexes["right"]].copy(),
        )


def _quaternion(scene: ArmScene) -> F64:
    """(x, y, z, w) of the grip site; the base stands upright at the world's orientation, so world and base axes agree."""
    return np.asarray(transforms.mat2quat(scene.grip_rotation()), np.float64)


def _controller_command(action: F32) -> F64:
    """The controller's ±1 for an action in metres and radians, clipped to its limits; ValueError unless seven finite numbers."""
    given = np.asarray(action, np.float32).astype(np.float64)
    if given.shape != (7,) or not np.isfinite(given).all():
        raise ValueError(f"an action is seven finite numbers (position 3, axis-angle 3, gripper 1), not {action!r}")
    scale = np.array([MAX_POSITION_STEP] * 3 + [MAX_ROTATION_STEP] * 3 + [1.0])
    command: F64 = np.clip(given / scale, -1.0, 1.0)
    return command


def _action_space() -> gymnasium.spaces.Box:
    limit = np.array([MAX_POSITION_STEP] * 3 + [MAX_ROTATION_STEP] * 3 + [1.0], np.float32)
    return gymnasium.spaces.Box(-limit, limit, dtype=np.float32)


def _observation_space(views: tuple[str, ...], height: int, width: int) -> gymnasium.spaces.Dict:
    spaces: dict[str, gymnasium.spaces.Space[Any]] = {
        "low_dim": gymnasium.spaces.Box(-np.inf, np.inf, (9,), np.float32)
    }
    spaces.update({name: gymnasium.spaces.Box(0, 255, (height, width, 3), np.uint8) for name in views})
    return gymnasium.spaces.Dict(spaces)
