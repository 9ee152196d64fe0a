from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.models.conftest import STEPS, tiny_recipe
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.errors import SplitError, StoreError
from vilp_data.latents import latents_path
from vilp_data.shards import write_shard
from vilp_data.spec import TaskSpec
from vilp_models import fidelity
from vilp_models.fidelity import Errors, FidelityReport, errors_between, fidelity_report, mean_frame, report_inputs
from vilp_models.fidelity_page import contact_sheet, read_fresh_report, write_report
from vilp_models.train import train_vqgan
from vilp_models.vqgan import load_frame_encoder


@pytest.fixture
def run_dir(store: EpisodeStore, spec: TaskSpec, tmp_path: Path) -> Path:
    recipe = tiny_recipe(share_views=True)
    train_vqgan(store.root, spec, recipe, tmp_path / "run", train_episodes=["a", "b"], split_hash="s", show=False)
    return tmp_path / "run"


@pytest.fixture
def report(store: EpisodeStore, run_dir: Path) -> FidelityReport:
    return fidelity_report(store, run_dir, ["c", "d"])


def test_a_barely_trained_network_earns_the_warning(report: FidelityReport) -> None:
    assert [view.view for view in report.views] == ["front", "side"]
    assert all("do not train a planner on this" in warning for warning in report.warnings)
    assert len(report.warnings) == 2


def test_what_the_report_counts(report: FidelityReport) -> None:
    view = report.views[0]
    assert [(e.episode, e.frames) for e in view.episodes] == [("c", STEPS), ("d", STEPS)]
    assert view.code_counts.sum() == 2 * STEPS * 8 * 12
    assert 1 <= view.code_perplexity <= view.codes_used
    assert view.precision.max_error < 0.01
    assert view.total("vqgan").moving_count == view.total("mean_frame").moving_count > 0


def test_stored_latents_are_what_is_decoded(store: EpisodeStore, run_dir: Path, report: FidelityReport) -> None:
    encoder = load_frame_encoder(run_dir, "front")
    entry = store.entry("c")
    path = latents_path(store.root, "front", encoder.key, "c")
    shape = (STEPS, *encoder.latent_shape(32, 48))
    header = {"format": "1", "key": encoder.key, "source_frames_sha256": entry.frames_sha256["front"]}
    write_shard(path, {"latents": np.full(shape, 3.0, np.float16)}, header)
    with_stored = fidelity_report(store, run_dir, ["c"], views=["front"])
    assert with_stored.views[0].codes_used == 1
    assert with_stored.views[0].episodes[0].vqgan != report.views[0].episodes[0].vqgan


def test_validating_on_training_episodes_is_refused(store: EpisodeStore, run_dir: Path) -> None:
    with pytest.raises(SplitError, match="found: b"):
        fidelity_report(store, run_dir, ["b", "c"])


def test_the_mean_frame_is_the_mean_of_all_training_frames(store: EpisodeStore) -> None:
    frames = np.concatenate([store.read(e).frames["front"] for e in "ab"])
    assert np.array_equal(mean_frame(store, store.index()[:2], "front"), np.round(frames.mean(axis=0)).astype(np.uint8))


def test_progress_counts_the_frames_of_every_view_up_to_all(store: EpisodeStore, run_dir: Path) -> None:
    told: list[tuple[int, int]] = []
    fidelity_report(store, run_dir, ["c", "d"], progress=lambda done, total: told.append((done, total)))
    assert told == [(n * STEPS, 4 * STEPS) for n in (1, 2, 3, 4)]


def test_a_foreign_frames_file_is_not_averaged(store: EpisodeStore) -> None:
    store.frames_path("front", "a").write_bytes(store.frames_path("side", "a").read_bytes())
    with pytest.raises(StoreError, match="not the frames this episode was committed with"):
        mean_frame(store, store.index()[:2], "front")


def test_errors_add_up_to_those_of_everything_at_once() -> None:
    real, other = (np.random.default_rng(i).integers(0, 256, (20, 4, 4, 3), np.uint8) for i in range(2))
    moving = np.random.default_rng(2).random((20, 4, 4)) < 0.5
    parts = errors_between(real[:3], other[:3], moving[:3]) + errors_between(real[3:], other[3:], moving[3:])
    whole = errors_between(real, other, moving)
    assert parts.psnr == pytest.approx(whole.psnr)
    assert parts.moving_psnr == pytest.approx(whole.moving_psnr)
    assert math.isnan(Errors().moving_psnr)


def test_errors_of_depth_count_readings_only() -> None:
    real = np.full((5, 4, 4, 1), 100, np.uint8)
    real[:, 0] = 0
    other = np.full((5, 4, 4, 1), 110, np.uint8)
    moving = np.zeros((5, 4, 4), np.bool_)
    moving[:, :2] = True
    errors = errors_between(real, other, moving)
    assert (errors.all_sum, errors.all_count) == (100.0 * 5 * 12, 5 * 12)
    assert (errors.moving_sum, errors.moving_count) == (100.0 * 5 * 4, 5 * 4)


def test_a_hole_of_depth_that_flickers_is_no_motion() -> None:
    frames = np.full((9, 4, 4, 1), 200, np.uint8)
    frames[::4, 0] = 0
    frames[:, 1] = 0
    frames[::4, 1] = 200
    measured = fidelity._measure_episode("a", "depth", frames, frames + np.uint8(1), frames[0], 0.0)
    assert measured.vqgan.moving_count == 0
    frames[4:, 2] = 30
    assert fidelity._measure_episode("a", "depth", frames, frames, frames[0], 0.0).vqgan.moving_count > 0


def test_the_mean_frame_of_depth_is_that_of_its_readings(store: EpisodeStore, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = np.array([0, 0, 100, 120], np.uint8).reshape(4, 1, 1, 1)
    monkeypatch.setattr(fidelity, "open_frames", lambda *_: frames)
    assert mean_frame(store, store.index()[:2], "front").tolist() == [[[110]]]


def test_the_report_is_written_for_programs_people_and_eyes(report: FidelityReport, tmp_path: Path) -> None:
    write_report(report, tmp_path / "report", {"made": "from these"})
    table = json.loads((tmp_path / "report" / "report.json").read_text())
    assert table["views"]["front"]["vqgan"]["psnr"] == pytest.approx(report.views[0].total("vqgan").psnr, abs=1e-3)
    page = (tmp_path / "report" / "report.md").read_text()
    assert "**Warning:** do not train a planner" in page
    assert page.count("| c |") == 2
    sheet = cv2.imread(str(tmp_path / "report" / "worst.png"))
    assert np.array_equal(sheet[..., ::-1], contact_sheet([frame for view in report.views for frame in view.worst]))


def test_the_sheet_shows_real_reconstructed_and_amplified_error(report: FidelityReport) -> None:
    frame = report.views[0].worst[0]
    row = contact_sheet([frame])[-64:]
    assert np.array_equal(row[::2, :96:2], frame.real)
    assert np.array_equal(row[::2, 96:192:2], frame.reconstructed)
    error = np.abs(frame.real.astype(int) - frame.reconstructed.astype(int))
    assert np.array_equal(row[::2, 192::2], np.minimum(4 * error, 255))


def test_a_report_is_fresh_until_a_checkpoint_or_the_episodes_change(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, report: FidelityReport, tmp_path: Path
) -> None:
    inputs = report_inputs(store, run_dir, ["c", "d"])
    folder = tmp_path / "report"
    assert read_fresh_report(folder, inputs) is None
    write_report(report, folder, inputs)
    table = read_fresh_report(folder, report_inputs(store, run_dir, ["d", "c"]))
    assert table is not None
    assert table["warnings"] == report.warnings
    assert read_fresh_report(folder, report_inputs(store, run_dir, ["c"])) is None
    recipe = tiny_recipe(share_views=True, seed=1)
    train_vqgan(store.root, spec, recipe, run_dir, train_episodes=["a"], split_hash="s", restart=True, show=False)
    assert read_fresh_report(folder, report_inputs(store, run_dir, ["c", "d"])) is None


def test_a_report_is_not_fresh_where_training_frames_behind_its_baseline_changed(
    store: EpisodeStore, run_dir: Path
) -> None:
    before = report_inputs(store, run_dir, ["c", "d"])
    a = store.read("a")
    brighter = {view: frames // 2 + 100 for view, frames in a.frames.items()}
    store.write(dataclasses.replace(a, frames=brighter), Origin("a.mcap", "0" * 64, "0", "key-a", {}))
    after = report_inputs(store, run_dir, ["c", "d"])
    assert after["mean_frame_of"] != before["mean_frame_of"]
    assert {**after, "mean_frame_of": None} == {**before, "mean_frame_of": None}
