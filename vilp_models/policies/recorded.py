"""The policy that plays recorded actions: what the demonstrations themselves score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vilp_data.types import F32
from vilp_models.policies.base import Observation
from vilp_models.starts import Recording


class RecordedPolicy:
    """Repeats the actions of the recording that its seed names; past their end the last one. Looks at nothing."""

    def __init__(self, recordings: Mapping[int, Recording], *, n_action_steps: int) -> None:
        self.n_action_steps = n_action_steps
        self.tags: Mapping[str, str] = {}
        self._recordings = recordings
        self._playing: list[Recording] = []
        self._step = 0

    def reset(self, seed: int | Sequence[int]) -> None:
        """Begin with the recordings that the seeds name. KeyError for one that there is not."""
        self._playing = [self._recordings[one] for one in ([seed] if isinstance(seed, int) else seed)]
        self._step = 0

    def act(self, observation: Observation) -> F32:
        steps = range(self._step, self._step + self.n_action_steps)
        self._step += self.n_action_steps
        return np.stack([playing.action[[playing.held(step) for step in steps]] for playing in self._playing])

    def timings(self) -> Mapping[str, float]:
        return {}
