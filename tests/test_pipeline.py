"""The whole line at PRESET=tiny, as a stranger types it: every stage for real, and nothing the second time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
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


def run_data(*words: str) -> str:
    """Run `vilp-data`; what it says."""
    ended = subprocess.run(
        [str(Path(sys.executable).with_name("vilp-data")), *words], capture_output=True, text=True, check=False
    )
    return ended.stdout + ended.stderr


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

    replayed = make("replay", "TASK=hanoi", "PRESET=tiny", f"DATA={tmp_path}")
    assert "off by at most 0 (within 1e-06)" in replayed
    assert "3 of 3 episodes replay as recorded; 3 of 3 end as recorded (3 in success)" in replayed


@pytest.mark.sim
def test_make_rollout_trains_every_model_and_lets_them_act(tmp_path: Path) -> None:
    """Two views and low_dim, a handful of steps each: nothing is learnt, and everything runs."""
    pytest.importorskip("robosuite", reason="the simulators are not installed: make setup")
    words = ["TASK=hanoi", "PRESET=tiny", "SEEDS=0:1", f"DATA={tmp_path}"]
    told = make("rollout", "bc", "generate", *words)
    assert "do not act on this planner" in told  # it is compared with copying, and loses, and that is said
    for run in ("planner-tiny/front", "planner-tiny/side", "policy-tiny/front+side", "bc-tiny/front+side"):
        assert (tmp_path / "runs" / run / "checkpoint.safetensors").is_file()
    assert (tmp_path / "runs" / "planner-tiny" / "evaluation" / "sheet.png").is_file()

    report = json.loads((tmp_path / "rollouts" / "vilp-tiny-0-1" / "report.json").read_text())
    assert report["episodes"][0]["n_steps"] == 100
    assert set(report["time"]["parts_s"]) == {"encode", "condition", "denoise", "decode", "act"}
    assert [other["policy"] for other in report["against"]] == ["stay"]
    assert list((tmp_path / "rollouts" / "vilp-tiny-0-1" / "videos").glob("*.mp4"))
    for kind in ("mp4", "png", "rrd"):
        assert list((tmp_path / "generated" / "planner-tiny").rglob(f"*.{kind}"))

    log = next((tmp_path / "rollouts" / "vilp-tiny-0-1" / "logs").glob("*.mcap"))
    assert "1 rollout of a policy left out" in run_data(
        "ingest", str(log), "--into", str(tmp_path), "--task", "hanoi", "--preset", "tiny"
    )
    assert "trained already" in make("policy", *words)


@pytest.mark.slow
@pytest.mark.sim
@pytest.mark.parametrize(
    ("task", "n_logs"), [("arrange_blocks", 6), ("pusht", 6), ("can", 3), ("nut_assembly", 7), ("move_the_stack", 3)]
)
def test_every_task_goes_from_nothing_to_a_policy_that_acts(tmp_path: Path, task: str, n_logs: int) -> None:
    pytest.importorskip("robosuite", reason="the simulators are not installed: make setup")
    words = [f"TASK={task}", "PRESET=tiny", "SEEDS=0:1", f"DATA={tmp_path}"]
    told = make("latents", "planner", "policy", "rollout", *words)
    assert f"{n_logs} logs, {n_logs} successful" in told
    assert f"{n_logs} episodes ingested" in told
    assert (tmp_path / "rollouts" / "vilp-tiny-0-1" / "report.json").is_file()
    assert "3 of 3 end as recorded (3 in success)" in make("replay", *words)


@pytest.mark.slow
def test_human_push_t_goes_through_the_same_line(tmp_path: Path) -> None:
    log = real_data("pusht/pusht_cchi_v7_replay.zarr")
    out = make("latents", "TASK=pusht", "PRESET=tiny", f"LOGS={log}", f"DATA={tmp_path}")
    assert "206 episodes ingested" in out
    assert "185 training, 21 validation episodes" in out
    assert len(read_split(tmp_path).ids("val")) == 21
