"""Push-T as the human demonstrations were recorded: gym-pusht's controller and physics, the data's frames.

pygame 2.6 changed where filled polygons end. The data's frames were drawn before: with an earlier pygame most of them
come out equal byte for byte, with a later one the worst fall to 38 dB. Hence its pin in pyproject.toml.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from vilp_data.errors import UsageError
from vilp_data.types import F32, F64, U8

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame prints to stdout when imported, and --json goes there

import gymnasium
from gym_pusht.envs.pusht import PushTEnv as GymPushT
from gymnasium.spaces import Box, Dict

FRAME_SIZE = 96
BOARD_SIZE = 512.0
GOAL_POSE = (256.0, 256.0, math.pi / 4)
"""x, y in px of 512, angle in radians: the benchmark's."""

Observation = dict[str, U8 | F32]


class PushTEnv(gymnasium.Env):  # type: ignore[misc]  # gymnasium is an optional extra that the type check leaves out
    """Push the T onto its goal with a disc that chases a target position. `goal_pose` [3] moves the goal: x, y, px of 512, and angle.

    Observation  "top" (with cameras): uint8 [96,96,3] RGB, top row first; "low_dim": float32 [2], the agent's position, px of 512
    Action       float32 [2], where the agent is to go, px of 512; in force for 0.1 s (ten steps of a PD controller)
    Reward       covered share of the goal / 0.95, at most 1; an episode ends above 0.95
    Info         "state": float64 [5], px of 512 and radians in [0, 2 pi), in the order of `state_names`;
                 "is_success": bool; "coverage": float in [0, 1], the covered share of the goal;
                 "hold_action": float32 [2], the target that keeps the agent where it is

    `reset(options={"state": s})` puts the bodies exactly at `s`, at rest. Velocities are not part of the state: a
    demonstration begins at rest, so its first state and its actions give all that follows, but a state from its middle
    gives no more than the picture. Without that option gym-pusht draws the start from the seed and places the block in
    its own way, which is the benchmark's.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "state_names": ("agent_x", "agent_y", "block_x", "block_y", "block_angle"),
        "state_periods": (math.inf, math.inf, math.inf, math.inf, 2 * math.pi),
        "controlled_state": (0, 1),
        "replay_tolerance": 1e-3,
    }

    def __init__(
        self, render_mode: str | None = None, *, cameras: bool = True, goal_pose: Sequence[float] = GOAL_POSE
    ) -> None:
        self.render_mode = render_mode
        self.cameras = cameras
        self.goal_pose = np.array(goal_pose, np.float64)
        if self.goal_pose.shape != (3,):
            found = f"{len(goal_pose)} numbers"
            raise UsageError("a goal is x, y in px of 512 and an angle in radians", where="goal_pose", found=found)
        self.action_space = Box(0.0, BOARD_SIZE, (2,), np.float32)
        spaces = {"low_dim": Box(-np.inf, np.inf, (2,), np.float32)}  # the walls stop the block, not the agent
        if cameras:
            spaces["top"] = Box(0, 255, (FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
        self.observation_space = Dict(spaces)
        self._sim = GymPushT(obs_type="state", observation_width=FRAME_SIZE, observation_height=FRAME_SIZE)

    @property
    def agent(self) -> F64:
        """Its position, float64 [2], px of 512."""
        return np.array(self._sim.agent.position)

    @property
    def block(self) -> F64:
        """Its pose, float64 [3]: x, y of the middle of the bar's outer edge in px of 512, angle in radians, not wrapped."""
        return np.array((*self._sim.block.position, self._sim.block.angle))

    def tags(self) -> dict[str, str]:
        """What sets an episode of this environment apart from one of another goal."""
        x, y, angle = self.goal_pose
        return {"goal": f"{x:g},{y:g},{math.degrees(angle):.0f}", "object": "T"}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin at `options["state"]` (float64 [5]), else at random. Raises UsageError for a state of another shape."""
        super().reset(seed=seed)
        if options is not None and "state" in options:
            self._sim._setup()  # a new space: bodies at rest, no contacts remembered
            self._place(np.asarray(options["state"], np.float64))
        else:
            self._sim.reset(seed=seed)
        self._sim.goal_pose = self.goal_pose.copy()  # which every reset puts where the benchmark has it
        coverage = self._sim._get_coverage()
        return self._observe(), self._info(coverage, is_success=coverage > self._sim.success_threshold)

    def step(self, action: F32) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Chase `action` for 0.1 s. Never truncates: how long an episode may last is the caller's to say."""
        _, reward, terminated, _, info = self._sim.step(np.asarray(action, np.float64))
        after = self._info(info["coverage"], is_success=info["is_success"])
        return self._observe(), float(reward), bool(terminated), False, after

    def render(self) -> U8 | None:
        """A larger picture, uint8 [680,680,3], with the last target as a red cross; None without a render mode."""
        if self.render_mode is None:
            return None
        picture: U8 = self._sim.render()
        return picture

    def close(self) -> None:
        self._sim.close()

    def _place(self, state: F64) -> None:
        """Put the bodies at `state`, before any physics.

        Setting the angle turns the block about its centre of gravity and so moves its origin: position comes after it.
        Drawing uses the shapes' cached corners, which only a physics step or reindexing brings up to date.
        """
        if state.shape != (5,):
            raise UsageError(
                "not a state of Push-T",
                found=f"shape {state.shape}",
                remedy="give float64 [5]: " + ", ".join(self.metadata["state_names"]),
            )
        agent, block = self._sim.agent, self._sim.block
        agent.position = (float(state[0]), float(state[1]))
        block.angle = float(state[4])
        block.position = (float(state[2]), float(state[3]))
        for body in (agent, block):
            self._sim.space.reindex_shapes_for_body(body)

    def _observe(self) -> Observation:
        low_dim = np.array(self._sim.agent.position, np.float32)
        return {"low_dim": low_dim} | ({"top": self._sim._render()} if self.cameras else {})

    def _info(self, coverage: float, *, is_success: bool) -> dict[str, Any]:
        return {
            "state": self._sim.get_obs(),
            "coverage": float(coverage),
            "is_success": bool(is_success),
            "hold_action": np.array(self._sim.agent.position, np.float32),
        }
