"""Where an arm's joints stand when its hand is at a given place: for episodes that begin with the hand elsewhere than robosuite puts it."""

from __future__ import annotations

import mujoco
import numpy as np

from vilp_data.sims.arm_scene import ArmScene
from vilp_data.types import F64

ROUNDS = 60
DAMPING = 0.02  # of the least squares: near a stretched arm steps stay small
LARGEST_TURN = 0.2  # rad, of one joint in one round
CLOSE_ENOUGH = 1e-4  # m and rad


def bring_hand(scene: ArmScene, position: F64, rotation: F64) -> None:
    """Set the arm's joints such that its grip site is at `position` (float64 [3], world) with axes `rotation` (float64 [3,3]).

    Damped least squares from where the joints are; what is out of reach is left where it got to. Touches nothing but these joints.
    """
    model, data = scene.model_and_data
    robot = scene.robots[0]
    joints, dofs = robot._ref_joint_pos_indexes, robot._ref_joint_vel_indexes
    low, high = model.jnt_range[robot._ref_joint_indexes].T
    site = robot.eef_site_id["right"]
    along, about = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for _ in range(ROUNDS):
        scene.refresh_kinematics()
        error = np.concatenate([position - scene.grip_position(), _turn_between(scene.grip_rotation(), rotation)])
        if np.abs(error).max() < CLOSE_ENOUGH:
            break
        mujoco.mj_jacSite(model, data, along, about, site)
        jacobian = np.concatenate([along, about])[:, dofs]
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * np.eye(6), error)
        step *= min(1.0, LARGEST_TURN / max(float(np.abs(step).max()), 1e-9))
        data.qpos[joints] = np.clip(data.qpos[joints] + step, low, high)
    scene.refresh_kinematics()


def _turn_between(now: F64, wanted: F64) -> F64:
    """Axis-angle float64 [3], world, that turns `now` into `wanted`."""
    quaternion, turn = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, (wanted @ now.T).flatten())
    mujoco.mju_quat2Vel(turn, quaternion, 1.0)
    return turn
