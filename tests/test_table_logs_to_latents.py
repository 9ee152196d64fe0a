"""Table logs through the whole line, for real: a robot's LeRobot dataset, and rendered robosuite demonstrations, to latents."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from tests.real_data import real_data
from vilp_data.dataset import WindowDataset
from vilp_data.episodes import EpisodeStore
from vilp_data.loader import Loader
from vilp_data.shards import read_header

pytestmark = pytest.mark.slow

G1 = """\
name = "g1"

[views.head]
topic = "observation.images.cam_high"
clock = "log"
height = 48
width = 64

[low_dim.joints]
topic = "observation.state"
clock = "log"

[action.joints]
topic = "action"
clock = "log"
"""

LIFT = """\
name = "lift"
rate_hz = 20

[views.agent]
topic = "/camera/agentview/image"
height = 48
width = 48

[low_dim.hand]
topic = "/robot0/ee_pose"

[low_dim.gripper]
topic = "/robot0/gripper/state"
fields = ["position"]

[action.command]
topic = "/action"
clock = "log"
"""


def run(program: str, *words: object, code: int = 0) -> str:
    """Run a command line; what it says. It must end with `code`."""
    command = [str(Path(sys.executable).with_name(program)), *map(str, words)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == code, ended.stdout + ended.stderr
    return ended.stdout + ended.stderr


def walk(tmp_path: Path, toml: str, log: Path, *, code: int) -> Path:
    """Ingest, split, a frame encoder of a few steps, latents: the dataset, after a second run found nothing to do."""
    assert len(toml.splitlines()) <= 20
    task, root = tmp_path / "task.toml", tmp_path / "data"
    task.write_text(toml)
    ingest = ("ingest", log, "--task", task, "--into", root, "--workers", 1)
    run("vilp-data", *ingest, code=code)
    run("vilp-data", "split", root)
    run("vilp-models", "train", "vqgan", "--data", root, "--task", task, "--preset", "tiny")
    run("vilp-data", "latents", root, "--workers", 1)
    assert "0 episodes ingested" in run("vilp-data", *ingest, code=code)
    return root


def windows_of(root: Path) -> WindowDataset:
    keys = {view.name: next(view.iterdir()).name for view in (root / "latents").iterdir()}
    return WindowDataset(root, split="train", latent_keys=keys, window=EpisodeStore(root).spec().window)


def two_episodes_and_one_without_its_video(folder: Path) -> Path:
    """A dataset of episodes 0, 28 and 29 that links to the real files."""
    source = real_data("g1_inspire_lerobot")
    (folder / "meta").mkdir(parents=True)
    for name in ("data", "videos"):
        (folder / name).symlink_to(source / name)
    (folder / "meta/info.json").write_bytes((source / "meta/info.json").read_bytes())
    lines = (source / "meta/episodes.jsonl").read_text().splitlines()
    kept = [line for line in lines if json.loads(line)["episode_index"] in (0, 28, 29)]
    (folder / "meta/episodes.jsonl").write_text("\n".join(kept))
    return folder


def test_a_real_robots_lerobot_dataset_goes_from_its_folder_to_windows_of_latents(tmp_path: Path) -> None:
    dataset = two_episodes_and_one_without_its_video(tmp_path / "g1")
    root = walk(tmp_path, G1, dataset, code=1)
    store = EpisodeStore(root)
    assert [entry.id for entry in store.index()] == ["g1-episode_000028", "g1-episode_000029"]
    frames = read_header(store.frames_path("head", "g1-episode_000028")).tensors["frames"]
    assert frames.shape == (278, 48, 64, 3)  # every row of the table, each with a frame of its own
    batch = next(iter(Loader(windows_of(root), batch_size=4, seed=0)))
    assert batch.low_dim.shape == (4, 26)
    assert batch.action is not None
    assert batch.action.shape[2] == 26


def last_rows(source: Path, copy: Path, count: int) -> Path:
    """The last rows of a demonstration, as a file of its own."""
    with h5py.File(source) as file, h5py.File(copy, "w") as out:
        out.create_group("data").attrs.update(file["data"].attrs)
        for name in ("states", "actions"):
            out[f"data/demo_1/{name}"] = file[f"data/demo_1/{name}"][-count:]
    return copy


@pytest.mark.sim
def test_rendered_demonstrations_go_from_states_to_windows_of_latents(tmp_path: Path) -> None:
    pytest.importorskip("robosuite", reason="the simulators are not installed: make setup")
    folder = "robosuite_demos/v1.0.1/robosuite/models/assets/demonstrations"
    sources = [
        last_rows(real_data(f"{folder}/{task}/panda/demo.hdf5"), tmp_path / f"{task}.hdf5", 60)
        for task in ("lift", "stack")
    ]
    told = run("vilp-data", "render", *sources, "-o", tmp_path / "logs", "--height", 48, "--width", 48, "--workers", 1)
    assert "2 logs, 2 end in success" in told
    root = walk(tmp_path, LIFT, tmp_path / "logs", code=0)
    assert {entry.id: (entry.outcome, entry.n_steps) for entry in EpisodeStore(root).index()} == {
        "Lift-demo_1": ("success", 60), "Stack-demo_1": ("success", 60)
    }  # fmt: skip
