"""What a policy sees, and what it must offer: `reset`, `act`, and where its time went.

Axes: B environments, H height, W width, L low_dim, A action.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from vilp_data.types import F32, U8


@dataclass(frozen=True)
class Observation:
    """The present of B environments, as numpy arrays in the order that `Policy.reset` was given their seeds.

    frames       view -> uint8 [B,H,W,3], RGB, top row first, at the size the dataset stores
    low_dim      float32 [B,L]
    hold_action  float32 [B,A]: the action that keeps each robot where it is
    """

    frames: Mapping[str, U8]
    low_dim: F32
    hold_action: F32

    @property
    def n_environments(self) -> int:
        return len(self.hold_action)


class Policy(Protocol):
    """Acts in a batch of environments, all at the same step: one call of `act` for every `n_action_steps` steps since `reset`.

    Everything random of environment i depends on its own seed and on the number of calls since the reset, not on who else is
    in the batch. An environment that is done stays in the batch, and its last observation is given again.
    """

    @property
    def n_action_steps(self) -> int:
        """(paper N_e) how many actions of a chunk are executed before `act` is asked again."""
        ...

    @property
    def tags(self) -> Mapping[str, str]:
        """What a report and the logs say of this policy beside its name: digests of checkpoints, settings."""
        ...

    def reset(self, seed: int | Sequence[int]) -> None:
        """Begin anew in as many environments as there are seeds; a single seed is one environment."""
        ...

    def act(self, observation: Observation) -> F32:
        """The next actions of every environment, float32 [B, n_action_steps, A], in the dataset's units."""
        ...

    def timings(self) -> Mapping[str, float]:
        """Part ("denoise", "decode", …) -> seconds of the latest `act`, of all environments together; empty before it."""
        ...
