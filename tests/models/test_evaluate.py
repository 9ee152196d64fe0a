"""Networks really trained, for a few steps, then judged: the whole way from checkpoints to reports and videos."""

from __future__ import annotations

import json
from pathlib import Path

from tests.models.trained_cards import TrainedCards
from vilp_data.dataset_split import read_split
from vilp_models.evaluate import Sampling, evaluate_planner, evaluate_policy, generate_videos


def judged(trained_cards: TrainedCards, **options: object) -> tuple[dict[str, object], Path]:
    root, spec = trained_cards
    settings = {"n_starts": 3, "n_samples": 2, "sampling": Sampling(denoising_steps=2)} | options
    return evaluate_planner(root, spec, trained_cards.run("planner"), trained_cards.run("vqgan"), **settings)  # type: ignore[arg-type]


def test_planners_are_judged_on_validation_alone_and_once_for_the_same_inputs(trained_cards: TrainedCards) -> None:
    root, _ = trained_cards
    table, folder = judged(trained_cards)
    assert folder == trained_cards.run("planner") / "evaluation"
    assert set(table["episodes"]) <= set(read_split(root).ids("val"))  # type: ignore[call-overload]
    assert table["inputs"]["denoising_steps"] == 2  # type: ignore[index]
    assert any("do not act on this planner" in warning for warning in table["warnings"])  # type: ignore[attr-defined]
    made = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert set(made) == {"report.json", "report.md", "sheet.png"}
    assert judged(trained_cards)[0] == table
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == made
    judged(trained_cards, n_samples=1)
    assert json.loads((folder / "report.json").read_text())["samples"] == 1


def test_the_low_level_policy_is_judged_on_true_and_on_reconstructed_frames(trained_cards: TrainedCards) -> None:
    root, spec = trained_cards
    table, folder = evaluate_policy(root, spec, trained_cards.run("policy"), trained_cards.run("vqgan"))
    assert (folder / "report.md").is_file()
    assert set(table["parts"]["move"]["candidates"]) == {"true", "reconstructed", "mean", "last", "hold"}


def test_clips_and_long_videos_are_written_for_validation_episodes(trained_cards: TrainedCards, tmp_path: Path) -> None:
    root, spec = trained_cards
    run, vqgan = trained_cards.run("planner"), trained_cards.run("vqgan")
    options = {"n_videos": 1, "sampling": Sampling(denoising_steps=1)}
    generate_videos(root, spec, run, vqgan, tmp_path, long_frames=None, **options)  # type: ignore[arg-type]
    [line] = generate_videos(root, spec, run, vqgan, tmp_path, long_frames=3, **options)  # type: ignore[arg-type]
    first = read_split(root).ids("val")[0]
    names = [f"{first}-step0{kind}.{suffix}" for kind in ("", "-long3") for suffix in ("mp4", "png", "rrd")]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    assert line.startswith(f"{first}-step0-long3.mp4, .png, .rrd: 3 frames, front ")
