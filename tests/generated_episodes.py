"""A generated episode of the small dataset of `stored_episodes`, with contents that a test can tell apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.stored_episodes import VIEWS, episode, write_dataset
from vilp_data import shards
from vilp_data.dataset_split import read_split
from vilp_data.episodes import EpisodeStore
from vilp_data.generated_episode import GeneratedEpisode, Kind, Maker, checkpoint_files, write_generated_episode
from vilp_data.types import F32

N_STEPS = 11
STRIDE = 2
PLAN_STEP = (0, 4, 8)
STEP, PLAN = (2, 4, 6, 8, 10), (0, 0, 1, 1, 2)
CHECKPOINT = Path("runs/planner-x/front/checkpoint.safetensors")


def generated_dataset(root: Path) -> tuple[EpisodeStore, GeneratedEpisode]:
    """Two episodes; the one that validates, walked along with plans of four steps, in generated/planner-x."""
    write_dataset(root, episode("one", N_STEPS), episode("two", N_STEPS))
    train(root)
    store = EpisodeStore(root)
    (name,) = read_split(root).ids("val")
    made = walked(store, name)
    write_generated_episode(root / "generated" / "planner-x", made, store.entry(name))
    return store, made


def train(root: Path, *, seed: int = 0) -> None:
    """A checkpoint that depends on the seed."""
    shards.write_shard(root / CHECKPOINT, {"weight": np.array([seed], np.float32)}, {})


def walked(store: EpisodeStore, name: str) -> GeneratedEpisode:
    """Reconstructed frames are one level off the recorded ones, imagined ones sixteen."""
    stored, step = store.read(name), np.array(STEP)
    real = {view: stored.frames[view][stored.source_index[view][step]] for view in VIEWS}
    assert stored.action is not None
    numbers = np.arange(len(STEP), dtype=np.float32)
    psnr: dict[Kind, dict[str, F32]] = {
        "imagined": dict.fromkeys(VIEWS, 20 + numbers),
        "reconstructed": dict.fromkeys(VIEWS, 40 + numbers),
    }
    lpips: dict[Kind, dict[str, F32]] = {kind: {v: of / 100 for v, of in m.items()} for kind, m in psnr.items()}
    return GeneratedEpisode(
        episode=name,
        frame_stride=STRIDE,
        step=step,
        plan=np.array(PLAN, np.int32),
        plan_step=np.array(PLAN_STEP),
        action=stored.action + np.float32(0.5),
        imagined={view: frames ^ 16 for view, frames in real.items()},
        reconstructed={view: frames ^ 1 for view, frames in real.items()},
        psnr_db=psnr,
        lpips=lpips,
        maker=Maker(
            checkpoint_files(store.root, [store.root / CHECKPOINT]),
            {"planner": "planner-x"},
            ("--whole", "--preset", "x", "--episode", name),
        ),
    )
