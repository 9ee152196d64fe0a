"""Latents of the small store that the tests of models share, made without training, and planners' windows over it."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.fake_encoder import BlockMeans
from tests.models.conftest import STEPS, VIEWS
from vilp_data.episodes import EpisodeStore
from vilp_data.latents import latents_path
from vilp_data.shards import write_shard
from vilp_data.spec import WindowSpec
from vilp_data.types import F16

WINDOW = WindowSpec(n_plan_frames=3, frame_stride=2, max_goal_frames=2)
ENCODER = BlockMeans()
DECODERS = dict.fromkeys(VIEWS, ENCODER)


def write_card_latents(store: EpisodeStore) -> dict[str, dict[str, F16]]:
    """view -> episode -> latents, as written into the store's folder."""
    made: dict[str, dict[str, F16]] = {view: {} for view in VIEWS}
    for entry in store.index():
        for view, frames in store.read(entry.id).frames.items():
            made[view][entry.id] = ENCODER.encode(frames)
            header = {"format": "1", "key": ENCODER.key, "source_frames_sha256": entry.frames_sha256[view]}
            path = latents_path(store.root, view, ENCODER.key, entry.id)
            write_shard(path, {"latents": made[view][entry.id]}, header)
    return made


def futures(store: EpisodeStore, view: str) -> dict[bytes, Tensor]:
    """What a planner that knows the future needs: the frame now -> latents to come."""
    known = {}
    for entry in store.index():
        frames = store.read(entry.id).frames[view]
        for t in range(STEPS - 6):
            known[frames[t].tobytes()] = torch.from_numpy(ENCODER.encode(frames[t + 2 : t + 7 : 2]))
    return known
