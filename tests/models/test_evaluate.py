"""Networks really trained, for a few steps, then judged: the whole way from checkpoints to reports and videos."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.models.conftest import HEIGHT, STEPS, VIEWS, WIDTH, tiny_recipe
from tests.stored_episodes import add_episodes, write_split
from tests.stored_episodes import episode as random_episode
from tests.synthetic import card_frame
from vilp_data.dataset_split import read_split, update_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import SplitError, UsageError
from vilp_data.latent_runs import encode_dataset
from vilp_data.spec import TaskSpec, parse_task
from vilp_models.evaluate import Sampling, evaluate_planner, evaluate_policy, generate_videos
from vilp_models.recipe import PRESETS, PlannerRecipe, PolicyRecipe
from vilp_models.train import train_planner, train_policy, train_vqgan

SPEC = "".join(f'[views.{view}]\ntopic = "/{view}"\nheight = {HEIGHT}\nwidth = {WIDTH}\n' for view in VIEWS)
SPEC = f"""name = "cards"
{SPEC}
[action.move]
topic = "/act"
fields = ["x", "y"]
[window]
n_plan_frames = 2
frame_stride = 2
"""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TaskSpec]:
    """A dataset of six episodes with a VQGAN, planners without low_dim and a low-level policy, each trained for some steps."""
    root = tmp_path_factory.mktemp("judged")
    store, spec = EpisodeStore(root), parse_task(SPEC, where="test")
    store.write_spec(spec)
    index = dict.fromkeys(VIEWS, np.arange(STEPS, dtype=np.int32))
    for number, name in enumerate("abcdef"):
        front = np.stack([card_frame(i + 3 * number, HEIGHT, WIDTH) for i in range(STEPS)])
        frames = {"front": front, "side": 255 - front}
        add_episodes(root, replace(random_episode(name, STEPS), frames=frames, source_index=index))
    write_split(root, ratio=0.6)
    lock = read_split(root)
    vqgan = tiny_recipe(share_views=True)
    train_vqgan(root, spec, vqgan, root / "runs" / "vqgan", train_episodes=lock.ids("train"), split_hash="", show=False)
    encode_dataset(root, spec, "vqgan", root / "runs" / "vqgan", workers=1)
    planner = PlannerRecipe(**PRESETS["planner"]["tiny"] | {"low_dim": False, "steps": 2, "width": 8})
    train_planner(root, spec, planner, root / "runs" / "planner", vqgan=root / "runs" / "vqgan", show=False)
    policy = PolicyRecipe(**PRESETS["policy"]["tiny"] | {"steps": 2})
    train_policy(root, spec, policy, root / "runs" / "policy", show=False)
    return root, spec


def judged(trained: tuple[Path, TaskSpec], **options: object) -> tuple[dict[str, object], Path]:
    root, spec = trained
    settings = {"n_starts": 3, "n_samples": 2, "sampling": Sampling(denoising_steps=2)} | options
    return evaluate_planner(root, spec, root / "runs" / "planner", root / "runs" / "vqgan", **settings)  # type: ignore[arg-type]


def test_planners_are_judged_on_validation_alone_and_once_for_the_same_inputs(trained: tuple[Path, TaskSpec]) -> None:
    root, _ = trained
    table, folder = judged(trained)
    assert folder == root / "runs" / "planner" / "evaluation"
    assert set(table["episodes"]) <= set(read_split(root).ids("val"))  # type: ignore[call-overload]
    assert table["inputs"]["denoising_steps"] == 2  # type: ignore[index]
    assert any("do not act on this planner" in warning for warning in table["warnings"])  # type: ignore[attr-defined]
    made = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert set(made) == {"report.json", "report.md", "sheet.png"}
    assert judged(trained)[0] == table
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == made
    judged(trained, n_samples=1)
    assert json.loads((folder / "report.json").read_text())["samples"] == 1


def test_the_low_level_policy_is_judged_on_true_and_on_reconstructed_frames(trained: tuple[Path, TaskSpec]) -> None:
    root, spec = trained
    table, folder = evaluate_policy(root, spec, root / "runs" / "policy", root / "runs" / "vqgan")
    assert (folder / "report.md").is_file()
    assert set(table["parts"]["move"]["candidates"]) == {"true", "reconstructed", "mean", "last", "hold"}


def test_clips_and_long_videos_are_written_for_validation_episodes(
    trained: tuple[Path, TaskSpec], tmp_path: Path
) -> None:
    root, spec = trained
    run, vqgan = root / "runs" / "planner", root / "runs" / "vqgan"
    options = {"n_videos": 1, "sampling": Sampling(denoising_steps=1)}
    generate_videos(root, spec, run, vqgan, tmp_path, long_frames=None, **options)  # type: ignore[arg-type]
    [line] = generate_videos(root, spec, run, vqgan, tmp_path, long_frames=3, **options)  # type: ignore[arg-type]
    first = read_split(root).ids("val")[0]
    names = [f"{first}-step0{kind}.{suffix}" for kind in ("", "-long3") for suffix in ("mp4", "png", "rrd")]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    assert line.startswith(f"{first}-step0-long3.mp4, .png, .rrd: 3 frames, front ")


def test_another_window_another_vqgan_and_known_episodes_are_refused(
    trained: tuple[Path, TaskSpec], tmp_path: Path
) -> None:
    root, spec = trained
    other = spec.model_copy(update={"window": spec.window.model_copy(update={"frame_stride": 1})})
    with pytest.raises(UsageError, match=r"another frame stride(.|\n)*frame_stride 2 in the model, 1"):
        judged((root, other))
    ids = read_split(root).ids("train")
    train_vqgan(
        root, spec, tiny_recipe(share_views=True, seed=1), tmp_path, train_episodes=ids, split_hash="", show=False
    )
    encode_dataset(root, spec, "vqgan", tmp_path, workers=1)
    with pytest.raises(UsageError, match="latents of another VQGAN"):
        evaluate_planner(root, spec, root / "runs" / "planner", tmp_path, n_starts=1, n_samples=1, sampling=Sampling())
    before = (root / "split.lock.json").read_bytes()
    update_split(root, ratio=0.6, ratio_from="task", seed=7, group_by=None, strata=(), redraw=True)
    try:
        assert set(read_split(root).ids("val")) & set(ids)
        with pytest.raises(SplitError, match="this planner was trained on"):
            judged(trained)
    finally:
        (root / "split.lock.json").write_bytes(before)
