"""VILP along recorded episodes: what each plan sees, what is kept of it, and what is measured."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from tests.models.test_vilp import observation, vilp
from tests.models.trained_cards import N_ACTION_STEPS, PRESET, TrainedCards
from tests.stored_episodes import add_episodes
from vilp_data.cli import app as data_app
from vilp_data.dataset_split import read_split
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import UsageError, VilpDataError
from vilp_data.generated_episode import GeneratedEpisode, Maker, open_generated_episode
from vilp_data.latents import open_latents
from vilp_data.plots import frame_psnr
from vilp_models.cli import app
from vilp_models.lpips import Lpips
from vilp_models.policies.base import Observation
from vilp_models.whole_episode import WholeRequest, imagine_whole

STRIDE = 2
MAKER = Maker({}, {}, ())


def request_of(cards: TrainedCards) -> WholeRequest:
    runs = [cards.run(model) for model in ("planner", "vqgan", "policy")]
    return WholeRequest(cards.root, cards.spec, *runs, N_ACTION_STEPS)


def val_entry(cards: TrainedCards) -> EpisodeEntry:
    return EpisodeStore(cards.root).entry(sorted(read_split(cards.root).ids("val"))[0])


def walked(cards: TrainedCards, *, seed: int = 0, perceptual: Lpips | None = None) -> GeneratedEpisode:
    policy, planned = request_of(cards).load()
    store, entry = EpisodeStore(cards.root), val_entry(cards)
    return imagine_whole(store, policy, planned.encoders, entry, MAKER, seed=seed, perceptual=perceptual)


def test_every_plan_sees_the_recorded_present_and_does_what_the_policy_would(trained_cards: TrainedCards) -> None:
    made, entry = walked(trained_cards), val_entry(trained_cards)
    assert made.plan_step.tolist() == list(range(0, entry.n_steps, N_ACTION_STEPS))
    store, (policy, _) = EpisodeStore(trained_cards.root), request_of(trained_cards).load()
    frames = {view: open_frames(store, entry, view) for view in made.views}
    low_dim = open_steps(store, entry)["low_dim"]
    policy.reset(0)
    for number, step in enumerate(made.plan_step.tolist()):
        now = Observation(
            {view: frames[view][[step]] for view in made.views}, low_dim[[step]], np.zeros((1, 2), np.float32)
        )
        plan = policy.plan(now)
        np.testing.assert_array_equal(
            made.action[step : step + N_ACTION_STEPS], plan.actions[0][: entry.n_steps - step]
        )
        rows = made.plan == number
        for view, imagined in policy.imagined_frames(plan).items():
            np.testing.assert_array_equal(made.imagined[view][rows], imagined[0, : rows.sum()])


def test_frames_are_those_between_two_looks_at_the_world(trained_cards: TrainedCards) -> None:
    made, entry = walked(trained_cards), val_entry(trained_cards)
    last = entry.n_steps - 1
    expected = [
        (step + ahead, number)
        for number, step in enumerate(range(0, entry.n_steps, N_ACTION_STEPS))
        for ahead in (STRIDE, 2 * STRIDE)
        if step + ahead <= last
    ]
    assert list(zip(made.step.tolist(), made.plan.tolist(), strict=True)) == expected
    assert (made.plan_of_step == np.arange(entry.n_steps) // N_ACTION_STEPS).all()


def test_what_is_measured_is_against_the_frame_at_that_step(trained_cards: TrainedCards) -> None:
    torch.manual_seed(0)
    perceptual = Lpips("alex")  # not trained: any distance will do
    made, entry = walked(trained_cards, perceptual=perceptual), val_entry(trained_cards)
    store, (_, planned) = EpisodeStore(trained_cards.root), request_of(trained_cards).load()
    for view in made.views:
        real = open_frames(store, entry, view)[made.step]
        latents = open_latents(store.root, entry, view, planned.encoders[view].key)[made.step]
        np.testing.assert_array_equal(made.reconstructed[view], planned.encoders[view].decode(latents))
        for kind, frames in (("imagined", made.imagined), ("reconstructed", made.reconstructed)):
            np.testing.assert_allclose(made.psnr_db[kind][view], frame_psnr(real, frames[view]), rtol=1e-6)
            assert made.lpips[kind][view].shape == made.step.shape
    assert walked(trained_cards).lpips == {}


def test_a_seed_imagines_the_same_again_and_another_does_not(trained_cards: TrainedCards) -> None:
    first, again, other = (walked(trained_cards, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.imagined["front"], again.imagined["front"])
    assert (first.imagined["front"] != other.imagined["front"]).any()


def test_plans_begin_anew_after_an_invalid_step_and_imagine_nothing_across_it(
    trained_cards: TrainedCards, tmp_path: Path
) -> None:
    shutil.copytree(trained_cards.root, tmp_path / "gap")
    cards = TrainedCards(tmp_path / "gap", trained_cards.spec)
    store, entry = EpisodeStore(cards.root), val_entry(cards)
    policy, planned = request_of(cards).load()
    stored = store.read(entry.id)
    stored.valid[5] = False
    add_episodes(cards.root, replace(stored, id=entry.id))
    made = imagine_whole(store, policy, planned.encoders, store.entry(entry.id), MAKER)
    assert made.plan_step.tolist()[:3] == [0, 4, 6]
    assert made.step.tolist()[:4] == [2, 4, 8, 10]
    assert np.isnan(made.action[5]).all()
    assert made.plan_of_step.tolist()[3:7] == [0, 1, -1, 2]


def test_a_policy_that_sees_latents_shows_its_dream_all_the_same() -> None:
    torch.set_num_threads(1)
    seeing, blind = (vilp(sees=sees) for sees in ("frames", "latents"))
    for policy in (seeing, blind):
        policy.reset(7)
        plan = policy.plan(observation(1))
        frames = policy.imagined_frames(plan)
        for view, clip in plan.latents.items():
            expected = policy.encoders[view].decode_tensor(clip[0, : policy.n_pairs]).numpy()
            np.testing.assert_array_equal(frames[view][0], expected)


# --- the command -------------------------------------------------------------------------------------------------------


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., str]:
    """Runs `vilp-models generate` and gives what it said."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str | Path) -> str:
        ended = CliRunner().invoke(app, ["generate", *map(str, words)])
        if isinstance(ended.exception, VilpDataError):
            return str(ended.exception)
        assert ended.exit_code == 0, ended.output
        return ended.output

    return run


def test_whole_episodes_are_made_once_and_open(
    trained_cards: TrainedCards, said: Callable[..., str], tmp_path: Path
) -> None:
    store, ids = EpisodeStore(trained_cards.root), sorted(read_split(trained_cards.root).ids("val"))
    words = ("--data", trained_cards.root, "--preset", PRESET, "--whole", "--out", tmp_path / "out")
    first = said(*words)
    [command] = re.findall("look at them with `(.*)`", first)
    program, *look = shlex.split(command)
    assert program == "vilp-data"
    page = CliRunner().invoke(data_app, [*look, "--html", str(tmp_path / "dream.html")], catch_exceptions=False)
    assert page.exit_code == 0, page.output
    made = [open_generated_episode(store, tmp_path / "out", name) for name in ids]
    assert [one.maker.settings["planner"] for one in made] == [f"planner-{PRESET}"] * len(ids)
    assert {place.split("/")[1] for place in made[0].maker.files} == {
        f"{m}-{PRESET}" for m in ("planner", "vqgan", "policy")
    }
    bytes_there = [(tmp_path / "out" / f"{name}.safetensors").stat().st_mtime_ns for name in ids]
    assert said(*words).count("there already") == len(ids)
    assert [(tmp_path / "out" / f"{name}.safetensors").stat().st_mtime_ns for name in ids] == bytes_there
    assert "there already" not in said(*words, "--seed", "3", "--episode", ids[0])
    assert open_generated_episode(store, tmp_path / "out", ids[0]).maker.command[-2:] == ("--episode", ids[0])


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (("--whole", "--long", "8"), "leave one of them out"),
        (("--episode", "a"), "add --whole"),
        (("--set", "small"), "add --whole"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    trained_cards: TrainedCards, said: Callable[..., str], words: tuple[str, ...], answer: str
) -> None:
    assert answer in said("--data", trained_cards.root, "--preset", PRESET, *words)


def test_only_validation_episodes_are_walked_along(trained_cards: TrainedCards, said: Callable[..., str]) -> None:
    trained_on = next(iter(read_split(trained_cards.root).ids("train")))
    words = ("--data", trained_cards.root, "--preset", PRESET, "--whole", "--episode", trained_on)
    assert f"no validation episode called '{trained_on}'" in said(*words)


def test_an_episode_too_short_for_a_frame_is_refused(trained_cards: TrainedCards, tmp_path: Path) -> None:
    shutil.copytree(trained_cards.root, tmp_path / "short")
    cards = TrainedCards(tmp_path / "short", trained_cards.spec)
    store, entry = EpisodeStore(cards.root), val_entry(cards)
    policy, planned = request_of(cards).load()
    stored = store.read(entry.id)
    stored.valid[2:] = False
    add_episodes(cards.root, stored)
    with pytest.raises(UsageError, match="too short for one imagined frame"):
        imagine_whole(store, policy, planned.encoders, store.entry(entry.id), MAKER)
