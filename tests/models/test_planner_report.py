"""Planners that know the future, or nothing: what the report must say of them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.models.conftest import STEPS, VIEWS
from tests.models.encoded_cards import DECODERS, ENCODER, WINDOW, futures, write_card_latents
from tests.models.fake_planner import FakePlanner
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.types import F16
from vilp_models.imagined import Imagination, read_recorded, recorded_starts, spread, start_noise
from vilp_models.plan_errors import MEASURES
from vilp_models.planner_page import example_sheet, write_planner_report
from vilp_models.planner_report import PlannerReport, planner_report

STD = dict.fromkeys(VIEWS, (50.0, 60.0, 70.0))
SHAPE = (3, 3, 4, 6)


@pytest.fixture
def latents(store: EpisodeStore) -> dict[str, dict[str, F16]]:
    return write_card_latents(store)


def report_of(store: EpisodeStore, planners: dict[str, FakePlanner], **options: int) -> PlannerReport:
    settings = {"n_starts": 100, "n_samples": 3} | options
    imagination = Imagination(planners, WINDOW.n_plan_frames)
    return planner_report(store, imagination, DECODERS, store.index()[2:], WINDOW, latent_std=STD, **settings)


def test_a_planner_that_repeats_the_present_scores_exactly_what_copying_does(
    store: EpisodeStore, latents: dict[str, dict[str, F16]]
) -> None:
    report = report_of(store, {view: FakePlanner(view) for view in VIEWS})
    for view in report.views:
        for measure in MEASURES:
            for imagined in ("sample", "best"):
                copied = view.score(measure, "copy_reconstructed")
                np.testing.assert_array_equal(view.score(measure, imagined).steps, copied.steps)
                assert view.gain(measure, imagined).mean.value == 0
        assert "even the best of all samples is no better than copying" in view.warnings[1]
        assert "changed pixels over the horizon (+0.00 dB)" in view.warnings[0]


def test_a_planner_that_knows_the_future_scores_the_ceiling(
    store: EpisodeStore, latents: dict[str, dict[str, F16]]
) -> None:
    report = report_of(store, {view: FakePlanner(view, futures=futures(store, view)) for view in VIEWS})
    for view in report.views:
        assert view.score("latent", "sample").steps.tolist() == [0, 0, 0]
        for measure in ("moving", "changed"):
            ceiling = view.score(measure, "reconstruction")
            np.testing.assert_array_equal(view.score(measure, "sample").steps, ceiling.steps)
        assert view.gain("changed", "sample").mean.value > 0
    assert report.warnings == []


def test_the_best_of_several_samples_beats_one_and_shared_noise_makes_views_agree(
    store: EpisodeStore, latents: dict[str, dict[str, F16]]
) -> None:
    planners = {view: FakePlanner(view, noise=60.0, futures=futures(store, view)) for view in VIEWS}
    report = report_of(store, planners, n_samples=4, n_starts=8)
    front = report.views[0]
    assert front.score("latent", "best").mean.value < front.score("latent", "sample").mean.value
    assert report.agreement == {"front+side": 1.0}
    again = report_of(store, planners, n_samples=4, n_starts=8)
    assert again.views[0].score("changed", "best").mean == front.score("changed", "best").mean


def test_only_starts_with_a_recorded_horizon_are_compared(
    store: EpisodeStore, latents: dict[str, dict[str, F16]]
) -> None:
    starts = recorded_starts(store, store.index(), WINDOW)
    assert [steps.tolist() for _, steps in starts] == [list(range(STEPS - 6))] * 4
    assert report_of(store, {"front": FakePlanner("front")}).n_starts == 2 * (STEPS - 6)
    long = WINDOW.model_copy(update={"n_plan_frames": 6})
    with pytest.raises(UsageError, match=r"no validation episode is long enough(.|\n)*n_plan_frames"):
        recorded_starts(store, store.index(), long)


def test_starts_are_spread_evenly_from_the_first_to_the_last(store: EpisodeStore) -> None:
    starts = recorded_starts(store, store.index(), WINDOW)
    chosen = [(entry.id, step) for entry, steps in spread(starts, 5) for step in steps.tolist()]
    assert chosen == [("a", 0), ("b", 0), ("c", 0), ("c", 5), ("d", 5)]
    assert sum(len(steps) for _, steps in spread(starts, 1000)) == 4 * (STEPS - 6)


def test_recorded_windows_hold_what_the_episode_holds(store: EpisodeStore, latents: dict[str, dict[str, F16]]) -> None:
    keys = dict.fromkeys(VIEWS, ENCODER.key)
    episode = store.read("c")
    [one, two] = read_recorded(store, store.entry("c"), np.array([1, 4, 5]), keys, WINDOW, batch_size=2)
    assert [*one.step.tolist(), *two.step.tolist()] == [1, 4, 5]
    for view in VIEWS:
        np.testing.assert_array_equal(one.present[view][1], episode.frames[view][4])
        np.testing.assert_array_equal(one.future[view][1], episode.frames[view][[6, 8, 10]])
        np.testing.assert_array_equal(two.latents[view][0], latents[view]["c"][[7, 9, 11]])
        np.testing.assert_array_equal(two.present_latents[view][0], latents[view]["c"][5])


def test_noise_belongs_to_the_start_and_the_sample(store: EpisodeStore, latents: dict[str, dict[str, F16]]) -> None:
    imagination = Imagination({"front": FakePlanner("front", noise=1.0)}, WINDOW.n_plan_frames)
    keys = dict.fromkeys(VIEWS, ENCODER.key)

    def imagined(steps: list[int]) -> np.ndarray:
        [recorded] = read_recorded(store, store.entry("c"), np.array(steps), keys, WINDOW, batch_size=9)
        return imagination.of(recorded, n_samples=2)["front"]

    together = imagined([0, 3])
    np.testing.assert_array_equal(imagined([3])[0], together[1])
    drawn = [start_noise(0, "c", 3, 0, SHAPE), start_noise(0, "c", 3, 1, SHAPE), start_noise(1, "c", 3, 0, SHAPE)]
    drawn += [start_noise(0, "d", 3, 0, SHAPE), start_noise(0, "c", 4, 0, SHAPE)]
    assert len({noise.tobytes() for noise in drawn}) == 5


def test_the_report_is_written_for_programs_people_and_eyes(
    store: EpisodeStore, latents: dict[str, dict[str, F16]], tmp_path: Path
) -> None:
    report = report_of(store, {view: FakePlanner(view) for view in VIEWS})
    inputs = {"n_plan_frames": 3, "frame_stride": 2, "denoising_steps": 4, "sampler": "ddim", "seed": 0}
    write_planner_report(report, tmp_path / "evaluation", inputs)
    table = json.loads((tmp_path / "evaluation" / "report.json").read_text())
    changed = table["views"]["front"]["changed"]
    assert changed["sample"] == changed["copy_reconstructed"]
    assert changed["gain"]["sample"]["mean"]["value"] == 0
    assert len(changed["reconstruction"]["steps"]) == 3
    page = (tmp_path / "evaluation" / "report.md").read_text()
    assert page.count("**Warning:** do not act on this planner") == 4
    assert "12 starts spread evenly over 2 validation episodes, each imagined 3 times" in page
    assert "| what | t + 2 | t + 4 | t + 6 |" in page
    sheet = cv2.imread(str(tmp_path / "evaluation" / "sheet.png"))[..., ::-1]
    first = example_sheet(report.views[0].examples[0])
    np.testing.assert_array_equal(sheet[: len(first), : first.shape[1]], first)


def test_the_sheet_shows_present_future_and_imagined_in_their_places(
    store: EpisodeStore, latents: dict[str, dict[str, F16]]
) -> None:
    example = report_of(store, {"side": FakePlanner("side", futures=futures(store, "side"))}).views[0].examples[0]
    sheet = example_sheet(example)
    cell = {"height": 2 * 32, "width": 2 * 48}
    body = sheet[-5 * cell["height"] :, -4 * cell["width"] :]
    cells = body.reshape(5, 32, 2, 4, 48, 2, 3)[:, :, 0, :, :, 0].transpose(0, 2, 1, 3, 4)
    np.testing.assert_array_equal(cells[0], np.concatenate([example.present[None], example.real]))
    np.testing.assert_array_equal(cells[1, 1:], example.reconstructed)
    np.testing.assert_array_equal(cells[2, 1:], example.best)
    np.testing.assert_array_equal(cells[3, 1:], example.first)
    assert not cells[2:, 0].any()
    error = np.abs(example.real.astype(int) - example.best.astype(int))
    np.testing.assert_array_equal(cells[4, 1:], np.minimum(4 * error, 255))
