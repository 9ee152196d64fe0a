"""Many environments of a task in lockstep, as a policy sees them: B starts in, observations of all B out.

They run one after another in this process (gymnasium's SyncVectorEnv). On two cores that is faster than a process each
(AsyncVectorEnv): a step of Push-T with its picture takes 1.3 ms, handing it over takes as long, and the cores are wanted by the
policy's networks, which work while the environments wait.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from vilp_data.errors import UsageError
from vilp_data.geometry import fit_image
from vilp_data.spec import TaskSpec
from vilp_data.types import F32, F64, U8
from vilp_models.policies.base import Observation
from vilp_models.simulator import make_env
from vilp_models.starts import Start


@dataclass(frozen=True)
class Outcome:
    """What a step of all environments gave: reward float64 [B], success and done bool [B]."""

    reward: F64
    success: np.typing.NDArray[np.bool_]
    done: np.typing.NDArray[np.bool_]


class Environments:
    """`size` environments of a task; `slots` are their ends, each with the raw observation and info that it gave last."""

    def __init__(self, spec: TaskSpec, size: int) -> None:
        self.spec = spec
        self.slots: list[Slot] = []

        def slot() -> Slot:
            self.slots.append(Slot(make_env(spec), len(self.slots)))
            return self.slots[-1]

        # Without automatic resets: an environment that is done waits for the others, and says nothing of it to gymnasium.
        self._vector = SyncVectorEnv([slot] * size, autoreset_mode=AutoresetMode.DISABLED)

    def __len__(self) -> int:
        return len(self.slots)

    def reset(self, starts: Sequence[Start]) -> Observation:
        """Begin an episode in every environment; `starts` are as many as these."""
        states = [start.state for start in starts]
        observation, infos = self._vector.reset(
            seed=[start.reset_seed for start in starts], options={Slot.STATES: states}
        )
        return self._seen(observation, infos)

    def step(self, actions: F32, *, draw: bool = True) -> tuple[Observation, Outcome]:
        """Take `actions` float32 [B,A]. An environment that is done stays as it is, and earns nothing more.

        Without `draw` the frames that come back are not to be looked at: simulators that can leave drawing out do so."""
        for slot in self.slots:
            slot.draw(draw)
        observation, reward, _, _, infos = self._vector.step(actions)
        success = np.array([bool(slot.info["is_success"]) for slot in self.slots])
        done = np.array([slot.done for slot in self.slots])
        return self._seen(observation, infos), Outcome(np.array(reward), success, done)

    def close(self) -> None:
        self._vector.close()

    def _seen(self, observation: Mapping[str, Any], infos: Mapping[str, Any]) -> Observation:
        frames = {view: self._frames(view, observation) for view in self.spec.views}
        low_dim = np.asarray(observation["low_dim"], np.float32)
        return Observation(frames, low_dim, np.asarray(infos["hold_action"], np.float32))

    def _frames(self, view: str, observation: Mapping[str, Any]) -> U8:
        """uint8 [B,H,W,C] as they would be stored."""
        if view not in observation:
            remedy = "compare the task's [views] with its [sim]"
            raise UsageError(f"the simulator has no view {view!r}", found=", ".join(observation), remedy=remedy)
        drawn, table = observation[view], self.spec.views[view]
        if drawn.shape[1:] == (table.height, table.width, table.channels):
            return np.asarray(drawn, np.uint8)
        if table.depth is not None:  # its levels are no brightness: resizing would mix "no reading" into distances
            what = f"the simulator's view {view!r} is not the depth that the task stores"
            found = f"{drawn.shape[1:]} where {(table.height, table.width, 1)} is stored"
            raise UsageError(what, found=found, remedy="draw levels of depth at the stored size, or take `depth` out")
        return np.stack([fit_image(image, table.height, table.width, table.fit) for image in drawn])


class Slot(gymnasium.Wrapper[Any, Any, Any, Any]):  # type: ignore[misc]  # gymnasium is not followed
    """One environment among others: begins at its own state, and stands still once it is done.

    `observation`, `info` and `reward` are as the environment gave them last.
    """

    STATES = "states"

    def __init__(self, env: Any, number: int) -> None:
        super().__init__(env)
        self.number = number
        self.done = False
        self.observation: Mapping[str, Any] = {}
        self.info: dict[str, Any] = {}
        self.reward = 0.0
        self._drawing = getattr(env.unwrapped, "set_drawing", None)

    def draw(self, on: bool) -> None:
        """Whether the next steps draw the views; without, those drawn last stay in `observation`. Not every simulator can choose."""
        if self._drawing is not None:
            self._drawing(on)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Mapping[str, Any], dict[str, Any]]:
        """`options["states"]`: the state each environment begins at, None for one that draws its own."""
        self.draw(True)
        state = None if options is None else options[self.STATES][self.number]
        self.observation, self.info = self.env.reset(seed=seed, options=None if state is None else {"state": state})
        self.done, self.reward = False, 0.0
        self._refuse_incomplete()
        return self.observation, self.info

    def step(self, action: F32) -> tuple[Mapping[str, Any], float, bool, bool, dict[str, Any]]:
        """As the environment's, but never terminated or truncated: `done` says that."""
        if self.done:
            return self.observation, 0.0, False, False, self.info
        seen, reward, terminated, truncated, self.info = self.env.step(action)
        self.observation = {**self.observation, **seen}
        self.reward, self.done = float(reward), bool(terminated or truncated)
        return self.observation, self.reward, False, False, self.info

    def _refuse_incomplete(self) -> None:
        given = {"observation": self.observation, "info": self.info}
        needed = {"observation": ("low_dim",), "info": ("state", "is_success", "hold_action")}
        for what, names in needed.items():
            for name in names:
                if name not in given[what]:
                    raise UsageError(
                        f"the simulator's {what} lacks {name!r}, which a policy needs",
                        where=str(self.env.unwrapped),
                        found=", ".join(given[what]),
                        remedy="vilp_models.simulator says what an environment keeps to",
                    )
