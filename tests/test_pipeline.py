"""The whole line at PRESET=tiny, as a stranger types it: every stage for real, and nothing the second time."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tests.faults import tree
from tests.real_data import real_data
from vilp_data.dataset import WindowDataset
from vilp_data.dataset_split import read_split
from vilp_data.episodes import EpisodeStore
from vilp_data.loader import Loader

ROOT = Path(__file__).resolve().parent.parent


def make(*words: str) -> str:
    """Run `make` in the project; its output. The environment that runs the tests serves as the project's."""
    ended = subprocess.run(
        ["make", *words], cwd=ROOT, capture_output=True, text=True, check=False, env=dict(os.environ)
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def latent_keys(root: Path) -> dict[str, str]:
    return {view.name: next(view.iterdir()).name for view in sorted((root / "latents").iterdir())}


@pytest.mark.sim
def test_make_latents_walks_from_nothing_to_windows_of_latents_and_then_has_nothing_to_do(tmp_path: Path) -> None:
    pytest.importorskip("robosuite", reason="the simulators are not installed: make setup")
    words = ["latents", "TASK=hanoi", "PRESET=tiny", f"DATA={tmp_path}"]
    first = make(*words)
    assert "3 logs, 3 successful" in first
    assert "3 episodes ingested" in first
    assert "2 training, 1 validation episodes" in first
    assert (tmp_path / "runs" / "vqgan-tiny" / "fidelity" / "worst.png").is_file()

    windows = WindowDataset(
        tmp_path, split="train", latent_keys=latent_keys(tmp_path), window=EpisodeStore(tmp_path).spec().window
    )
    batch = next(iter(Loader(windows, batch_size=8, seed=0)))
    assert batch.latents["front"].shape == (8, 6, 3, 12, 20)
    assert batch.frames["side"].shape == (8, 96, 160, 3)
    assert batch.low_dim.shape == (8, 9)
    assert batch.action is not None
    assert batch.action.shape == (8, 12, 7)

    before = tree(tmp_path)
    second = make(*words)
    assert "0 episodes ingested, 3 already there" in second
    assert "trained already" in second
    assert "all there already" in second
    assert tree(tmp_path) == before

    assert "off by at most 0 (within 1e-06)" in make("replay", "TASK=hanoi", "PRESET=tiny", f"DATA={tmp_path}")


@pytest.mark.slow
def test_human_push_t_goes_through_the_same_line(tmp_path: Path) -> None:
    log = real_data("pusht/pusht_cchi_v7_replay.zarr")
    out = make("latents", "TASK=pusht", "PRESET=tiny", f"LOGS={log}", f"DATA={tmp_path}")
    assert "206 episodes ingested" in out
    assert "185 training, 21 validation episodes" in out
    assert len(read_split(tmp_path).ids("val")) == 21
