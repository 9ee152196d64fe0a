"""The oracle: pairs of true frames, in the order in which VILP would pair imagined ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from vilp_models.low_level import LowLevelPolicy
from vilp_models.policies.base import Observation
from vilp_models.policies.oracle import OraclePolicy
from vilp_models.starts import Recording

STRIDE = 2


class Pairs(torch.nn.Module):
    """Stands for a low-level policy: the actions tell which two frames and which low_dim it was given."""

    views = ("top",)
    frame_stride = STRIDE

    def __init__(self) -> None:
        super().__init__()
        self.action = torch.nn.Module()
        self.action.register_buffer("mean", torch.zeros(3))

    def act(self, first: Any, second: Any, low_dim: Any) -> torch.Tensor:
        told = torch.stack(
            [first["top"].flatten(1)[:, 0], second["top"].flatten(1)[:, 0], low_dim[:, 0]], dim=1
        ).float()
        return told[:, None].repeat(1, STRIDE, 1)


def recording(n_steps: int, base: int) -> Recording:
    """Step k shows the grey base + k, each image stored twice over, and has low_dim base + k."""
    values = base + np.arange(n_steps)
    frames = np.repeat(values, 2).astype(np.uint8)[:, None, None, None] * np.ones((1, 4, 4, 3), np.uint8)
    index = 2 * np.arange(n_steps, dtype=np.int32)
    low_dim = values[:, None].astype(np.float32)
    return Recording({"top": frames}, {"top": index}, low_dim, low_dim, low_dim.astype(np.float64))


def present(*greys: int) -> Observation:
    frames = np.array(greys, np.uint8)[:, None, None, None] * np.ones((1, 4, 4, 3), np.uint8)
    return Observation({"top": frames}, -np.array(greys, np.float32)[:, None], np.zeros((len(greys), 3), np.float32))


def oracle(n_action_steps: int, **given: Any) -> OraclePolicy:
    network: LowLevelPolicy = Pairs()  # type: ignore[assignment]
    recordings = {3: recording(8, base=10), 5: recording(8, base=100)}
    return OraclePolicy(network, recordings, n_action_steps=n_action_steps, **given)


def told(chunk: np.ndarray[Any, Any], environment: int) -> list[list[float]]:
    return [[float(value) for value in step] for step in chunk[environment]]


def test_pairs_begin_at_the_real_present_and_go_on_through_true_frames() -> None:
    policy = oracle(4)
    policy.reset([5, 3])
    chunk = policy.act(present(201, 202))
    assert chunk.shape == (2, 4, 3)
    assert told(chunk, 0) == [[201, 102, -201]] * 2 + [[102, 104, 102]] * 2
    assert told(chunk, 1) == [[202, 12, -202]] * 2 + [[12, 14, 12]] * 2
    assert (
        told(policy.act(present(203, 204)), 1) == [[204, 16, -204]] * 2 + [[16, 17, 16]] * 2
    )  # past the end: the last


def test_a_chunk_may_end_within_a_pair_and_a_reset_begins_anew() -> None:
    policy = oracle(3)
    for _ in range(2):
        policy.reset(3)
        assert told(policy.act(present(200)), 0) == [[200, 12, -200]] * 2 + [[12, 14, 12]]
        assert told(policy.act(present(200)), 0)[0] == [200, 15, -200]  # step 3 + 2


def test_a_network_that_sees_latents_is_given_those_of_every_frame() -> None:
    policy = oracle(4, encode=lambda view, frames: 1000.0 + frames[:, :1, :2, :2].transpose(0, 3, 1, 2)[:, :1])
    policy.reset([3])
    assert told(policy.act(present(200)), 0)[::2] == [[1200, 1012, -200], [1012, 1014, 12]]
    assert set(policy.timings()) == {"encode", "low_level"}


def test_an_unknown_recording_is_an_error() -> None:
    with pytest.raises(KeyError):
        oracle(2).reset([4])
