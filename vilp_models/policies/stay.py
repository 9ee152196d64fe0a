"""The policy that keeps the robot where it is: what any other has to beat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vilp_data.types import F32
from vilp_models.policies.base import Observation


class StayPolicy:
    """Holds the pose seen at the beginning of every chunk."""

    def __init__(self, *, n_action_steps: int) -> None:
        self.n_action_steps = n_action_steps
        self.tags: Mapping[str, str] = {}

    def reset(self, seed: int | Sequence[int]) -> None:
        """Nothing is remembered."""

    def act(self, observation: Observation) -> F32:
        return np.repeat(observation.hold_action[:, None], self.n_action_steps, axis=1)

    def timings(self) -> Mapping[str, float]:
        return {}
