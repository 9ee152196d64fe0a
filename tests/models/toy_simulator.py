"""A simulator without physics: a dot that moves by its actions, in views of any size. Registered as test/Dot-v0."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from vilp_data.spec import TaskSpec
from vilp_data.task_toml import parse_task

GOAL = 8.0

TASK = """
name = "dot"
rate_hz = 10.0
[views.top]
topic = "/top"
height = 8
width = 12
[low_dim.position]
topic = "/state"
clock = "log"
fields = ["[0:1]"]
[action.push]
topic = "/action"
clock = "log"
[state]
topic = "/state"
clock = "log"
[sim]
env = "test/Dot-v0"
max_steps = 20
"""


class Dot(gymnasium.Env):
    """state float64 [2]: position, and how often it was pushed. Reward position / GOAL; done at GOAL."""

    def __init__(self, *, cameras: bool = True, height: int = 8, width: int = 12) -> None:
        self.size = (height, width, 3)
        self.observation_space = Dict(
            {"top": Box(0, 255, self.size, np.uint8), "low_dim": Box(-np.inf, np.inf, (1,), np.float32)}
        )
        self.action_space = Box(-1, 1, (1,), np.float32)
        self.state = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        start = np.array([self.np_random.uniform(0, 1), 0.0])
        self.state = np.array(options["state"], np.float64) if options and "state" in options else start
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.state = np.array([self.state[0] + float(action[0]), self.state[1] + 1])
        return self._observe(), float(self.state[0] / GOAL), bool(self.state[0] >= GOAL), False, self._info()

    def _observe(self) -> dict[str, Any]:
        picture = np.full(self.size, np.uint8(np.clip(self.state[0] * 20, 0, 255)), np.uint8)
        return {"top": picture, "low_dim": self.state[:1].astype(np.float32)}

    def _info(self) -> dict[str, Any]:
        hold = np.zeros(1, np.float32)
        return {"state": self.state.copy(), "is_success": bool(self.state[0] >= GOAL), "hold_action": hold}


def register() -> None:
    if "test/Dot-v0" not in gymnasium.registry:
        gymnasium.register("test/Dot-v0", entry_point=Dot, disable_env_checker=True)


def dot_task(options: str = "") -> TaskSpec:
    register()
    return parse_task(TASK + options, where="test")
