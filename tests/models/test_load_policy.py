"""Policies by name, from the runs of a preset: each acts on the dataset it was trained on."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.models.trained_cards import N_ACTION_STEPS, PRESET, TrainedCards, train_card_vqgan
from vilp_data.dataset_split import read_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.latents import open_latents
from vilp_models.checkpoint import checkpoint_digest
from vilp_models.policies.base import Observation
from vilp_models.policies.load import DIGITS, LOADERS, PolicyRequest, load_policy
from vilp_models.policies.oracle import OraclePolicy
from vilp_models.policies.vilp import VilpPolicy
from vilp_models.recipe import PlannerRecipe, PolicyRecipe, load_recipe
from vilp_models.starts import Recording, episode_seed, episode_starts
from vilp_models.train import train_policy
from vilp_models.vqgan import VqganEncoder, load_frame_encoder


def request_of(cards: TrainedCards, preset: str | None = PRESET, **options: Any) -> PolicyRequest:
    return PolicyRequest(cards.root, cards.spec, preset, N_ACTION_STEPS, **options)


@pytest.fixture(scope="session")
def recordings(trained_cards: TrainedCards) -> Mapping[int, Recording]:
    """Of the validation episodes, by seed."""
    return episode_starts(EpisodeStore(trained_cards.root), "val")[1]


def observation(recordings: Mapping[int, Recording]) -> Observation:
    """The first step of every recording."""
    followed = list(recordings.values())
    return Observation(
        frames={view: np.stack([one.frame(view, 0) for one in followed]) for view in ("front", "side")},
        low_dim=np.stack([one.low_dim[0] for one in followed]),
        hold_action=np.zeros((len(followed), 2), np.float32),
    )


@pytest.mark.parametrize("preset", [PRESET, None])
@pytest.mark.parametrize(
    ("name", "models"),
    [
        ("oracle", {"policy_checkpoint": ("policy", "front+side")}),  # its frames are real: no VQGAN has a part in it
        ("bc", {"bc_checkpoint": ("bc", "front+side")}),
        (
            "vilp",
            {
                "policy_checkpoint": ("policy", "front+side"),
                "planner_checkpoint_front": ("planner", "front"),
                "planner_checkpoint_side": ("planner", "side"),
                "vqgan_checkpoint_front": ("vqgan", "front+side"),
                "vqgan_checkpoint_side": ("vqgan", "front+side"),
            },
        ),
    ],
)
def test_a_policy_of_trained_models_acts_and_names_their_checkpoints(
    trained_cards: TrainedCards,
    recordings: Mapping[int, Recording],
    name: str,
    models: Mapping[str, tuple[str, str]],
    preset: str | None,
) -> None:
    policy = load_policy(name, request_of(trained_cards, preset, recordings=recordings))
    policy.reset(list(recordings))
    actions = policy.act(observation(recordings))
    assert actions.shape == (len(recordings), N_ACTION_STEPS, 2)
    assert np.isfinite(actions).all()
    assert np.ptp(actions) > 0
    digests = {
        tag: checkpoint_digest(trained_cards.run(model) / views)[:DIGITS] for tag, (model, views) in models.items()
    }
    planner = load_recipe(PlannerRecipe, "planner", trained_cards.spec.models, preset=PRESET, where="test")
    sampling = {"denoising_steps": str(planner.denoising_steps), "sampler": planner.sampler, "precision": "f32"}
    if name != "vilp":
        sampling = {}
    assert policy.tags == {**digests, **sampling, "split": read_split(trained_cards.root).hash[:DIGITS]}
    assert policy.timings()


def test_how_a_policy_imagines_is_as_asked_and_told(
    trained_cards: TrainedCards, recordings: Mapping[int, Recording]
) -> None:
    settings = {"denoising_steps": 3, "sampler": "ddim", "precision": "bf16"}
    acted = []
    for given in ({}, settings):
        policy = load_policy("vilp", request_of(trained_cards, **given))
        policy.reset(list(recordings))
        acted.append(policy.act(observation(recordings)))
    assert {name: policy.tags[name] for name in settings} == {name: str(value) for name, value in settings.items()}
    assert np.abs(acted[0] - acted[1]).max() > 0


def test_a_policy_may_be_given_another_vqgan_and_is_refused_with_one_that_made_other_latents(
    trained_cards: TrainedCards, tmp_path: Path
) -> None:
    train_card_vqgan(trained_cards, tmp_path / "other", seed=1)
    with pytest.raises(UsageError, match="another VQGAN"):
        load_policy("vilp", request_of(trained_cards, vqgan=tmp_path / "other"))


def test_all_networks_of_a_policy_are_on_the_device_asked_for(
    trained_cards: TrainedCards, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    policy = load_policy("vilp", request_of(trained_cards, device="cpu"))
    assert isinstance(policy, VilpPolicy)
    assert {encoder.device.type for encoder in policy.encoders.values()} == {"cpu"}


def test_a_policy_acts_on_another_kind_of_device_than_its_latents_were_made_on(
    trained_cards: TrainedCards, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(VqganEncoder, "key", property(lambda encoder: encoder.key_on("cuda")))
    assert load_policy("vilp", request_of(trained_cards)).n_action_steps == N_ACTION_STEPS


def test_an_oracle_that_reads_latents_is_given_them_as_they_are_stored(
    trained_cards: TrainedCards, recordings: Mapping[int, Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cards = TrainedCards(Path(shutil.copytree(trained_cards.root, tmp_path / "cards")), trained_cards.spec)
    shutil.rmtree(cards.run("policy"))
    recipe = PolicyRecipe(vision_width=8, hidden=(16,), sees="latents", steps=1, warmup_steps=1, batch_size=2)
    train_policy(cards.root, cards.spec, recipe, cards.run("policy"), vqgan=cards.run("vqgan"), show=False)
    policy = load_policy("oracle", request_of(cards, recordings=recordings))
    assert isinstance(policy, OraclePolicy)
    seen: list[Mapping[str, torch.Tensor]] = []

    def act(
        first: Mapping[str, torch.Tensor], second: Mapping[str, torch.Tensor], low_dim: torch.Tensor
    ) -> torch.Tensor:
        seen.append(first)
        return torch.zeros(len(low_dim), policy.network.frame_stride, 2)

    monkeypatch.setattr(policy.network, "act", act)
    seed = next(iter(recordings))
    policy.reset(seed)
    policy.act(observation({seed: recordings[seed]}))
    store = EpisodeStore(cards.root)
    [entry] = [entry for entry in store.index() if episode_seed(entry.id) == seed]
    for view in ("front", "side"):
        stored = open_latents(cards.root, entry, view, load_frame_encoder(cards.run("vqgan"), view).key)
        given = seen[0][view].numpy()
        np.testing.assert_array_equal(given, given.astype(np.float16))
        np.testing.assert_allclose(given, stored[[0, 2]].astype(np.float32), rtol=2e-3, atol=2e-3)
    assert {"vqgan_checkpoint_front", "vqgan_checkpoint_side"} <= set(policy.tags)


def test_the_oracle_acts_as_its_network_on_true_frames(
    trained_cards: TrainedCards, recordings: Mapping[int, Recording]
) -> None:
    policy = load_policy("oracle", request_of(trained_cards, recordings=recordings))
    assert isinstance(policy, OraclePolicy)
    seed, recording = next(iter(recordings.items()))
    policy.reset(seed)
    actions = policy.act(observation({seed: recording}))
    pair = [
        {view: torch.from_numpy(recording.frame(view, step)[None].copy()) for view in ("front", "side")}
        for step in (2, 4)
    ]
    expected = policy.network.act(*pair, torch.from_numpy(recording.low_dim[2][None]))
    np.testing.assert_allclose(actions[:, 2:], expected.numpy(), rtol=1e-4, atol=1e-5)


def test_an_unknown_policy_is_refused_with_the_nearest_name(trained_cards: TrainedCards) -> None:
    with pytest.raises(UsageError, match=r"no policy called 'orcle'(.|\n)*did you mean 'oracle'"):
        load_policy("orcle", request_of(trained_cards))
    assert set(LOADERS) == {"stay", "replay", "oracle", "bc", "vilp"}


@pytest.mark.parametrize("name", ["oracle", "replay"])
def test_a_policy_that_follows_recordings_is_refused_where_seeds_begin_episodes(
    trained_cards: TrainedCards, name: str
) -> None:
    with pytest.raises(UsageError, match=rf"'{name}' follows recorded episodes(.|\n)*--from-episodes val"):
        load_policy(name, request_of(trained_cards))


@pytest.mark.parametrize(("name", "first"), [("oracle", "vqgan"), ("bc", "bc"), ("vilp", "planner")])
def test_a_preset_that_was_not_trained_is_refused_with_the_command(
    trained_cards: TrainedCards, recordings: Mapping[int, Recording], name: str, first: str
) -> None:
    with pytest.raises(UsageError, match=rf"{first}-cpu(.|\n)*{first}-tiny(.|\n)*train {first} --preset cpu"):
        load_policy(name, request_of(trained_cards, "cpu", recordings=recordings))
