"""`bring_hand`: joints that put the hand where it is asked for, within their limits."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("robosuite", reason="the simulators are not installed (make setup)")

from vilp_data.sims.arm_reach import bring_hand  # noqa: E402
from vilp_data.sims.arm_scene import ROBOTS  # noqa: E402
from vilp_data.sims.move_the_stack import MoveTheStackEnv  # noqa: E402
from vilp_data.sims.move_the_stack_scene import pointing_down  # noqa: E402


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_hand_comes_to_be_where_it_is_asked_for_and_only_it_moves(robot: str) -> None:
    env = MoveTheStackEnv(2, robot=robot, cameras=False)
    env.reset(seed=0)
    scene = env.scene
    cup = scene.cup_position(0)
    for position, turn in (((-0.1, 0.15, 0.95), 1.0), ((0.08, -0.12, 1.05), 2.0)):
        bring_hand(scene, np.array(position), pointing_down(turn))
        np.testing.assert_allclose(scene.grip_position(), position, atol=1e-3)
        np.testing.assert_allclose(scene.grip_rotation(), pointing_down(turn), atol=1e-3)
    assert np.array_equal(scene.cup_position(0), cup)

    bring_hand(scene, np.array([3.0, 0.0, 1.0]), pointing_down(1.0))  # out of reach
    model, data = scene.model_and_data
    joints = scene.robots[0]._ref_joint_indexes
    angles = data.qpos[scene.robots[0]._ref_joint_pos_indexes]
    assert np.isfinite(angles).all()
    assert ((angles >= model.jnt_range[joints, 0]) & (angles <= model.jnt_range[joints, 1])).all()
    assert 0.2 < scene.grip_position()[0] < 0.6  # stretched towards it
    env.close()
