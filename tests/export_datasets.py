"""Small datasets to export, and the rows that an export of them must hold. For tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.stored_episodes import episode
from tests.synthetic import card_frame
from vilp_data import shards
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.split import SplitEpisode, draw_split
from vilp_data.task_toml import task_from_dict
from vilp_data.types import Episode

HEIGHT, WIDTH = 24, 32

SPEC: dict[str, Any] = {
    "name": "handover",
    "rate_hz": 10.0,
    "views": {view: {"topic": f"/{view}", "height": HEIGHT, "width": WIDTH} for view in ("front", "side")},
    "low_dim": {
        "arm": {"topic": "/arm", "fields": ["[0:3]"]},
        "gripper": {"topic": "/gripper", "fields": ["position[0:1]"]},
    },
    "action": {"target": {"topic": "/target", "fields": ["x", "y"], "unit": "m", "frame": "base"}},
}


def demonstration(
    name: str,
    n_steps: int,
    *,
    outcome: str = "success",
    tags: dict[str, str] | None = None,
    state: int = 0,
    **options: Any,
) -> Episode:
    """Colour cards that move, the side camera at half rate; everything else random."""
    plain = episode(name, n_steps, **options)
    frames = {
        view: np.stack([card_frame(i + 5 * len(name), HEIGHT, WIDTH) for i in range(index[-1] + 1)])
        for view, index in plain.source_index.items()
    }
    rng = np.random.default_rng(n_steps)
    times = 1_000_000_007 + np.arange(n_steps, dtype=np.int64) * 100_000_000
    return replace(
        plain, frames=frames, outcome=outcome, tags=tags or {}, log_time_ns=times,
        state=rng.standard_normal((n_steps, state)) if state else None,
    )  # fmt: skip


def write(
    root: Path, *episodes: Episode, val: tuple[str, ...] = (), spec: dict[str, Any] | None = None
) -> EpisodeStore:
    """A dataset of these episodes, split where `val` names some."""
    store = EpisodeStore(root)
    store.write_spec(task_from_dict(spec or SPEC, where="test"))
    for one in episodes:
        store.write(one, Origin(f"{one.id}.mcap", "ab" * 32, one.id, f"key of {one.id}", {}))
    store.write_index()
    if val:
        lock = draw_split([SplitEpisode(entry.id, entry.content_sha256) for entry in store.index()], ratio=0.5, seed=0)
        assignment = {one.id: "val" if one.id in val else "train" for one in episodes}
        from vilp_data.split_lock import assignment_hash

        lock = replace(lock, assignment=assignment, hash=assignment_hash(assignment))
        shards.write_atomic(root / "split.lock.json", lock.to_json())
    return store


def plain_dataset(root: Path) -> list[Episode]:
    """Two training episodes and a validation one, in the order of an export."""
    episodes = [
        demonstration("pick", 14, tags={"task": "pick it up", "operator": "ann"}),
        demonstration("place", 9, outcome="unknown"),
        demonstration("hand", 11, tags={"success": "true"}),
    ]
    write(root, *episodes, val=("hand",))
    return episodes


def blind_dataset(root: Path) -> list[Episode]:
    """Two episodes of a robot without any camera: numbers alone."""
    episodes = [replace(demonstration(name, 6 + len(name)), frames={}, source_index={}) for name in ("pick", "place")]
    write(root, *episodes, spec={**SPEC, "views": {}})
    return episodes


def shown(one: Episode, view: str) -> Any:
    """What each step sees, uint8 [F,H,W,3]."""
    return one.frames[view][one.source_index[view]]
