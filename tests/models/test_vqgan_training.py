from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.models.conftest import HEIGHT, WIDTH, card_frames, tiny_recipe
from vilp_data.errors import UsageError
from vilp_models.checkpoint import Arrays
from vilp_models.frames import Clip, TrainingFrames
from vilp_models.optimisation import learning_rate
from vilp_models.recipe import VqganRecipe
from vilp_models.vqgan_loss import PatchDiscriminator, discriminator_loss, weighted_l1
from vilp_models.vqgan_training import VqganTraining, spread_sample


def _train(
    recipe: VqganRecipe, until: int, *, saved: tuple[Arrays, Arrays] | None = None, first: int = 0
) -> VqganTraining:
    training = VqganTraining(recipe, card_frames())
    if saved is not None:
        training.restore(*saved)
    for index in range(first, until):
        training.step(index)
    return training


def _bytes(saved: tuple[Arrays, Arrays]) -> dict[str, bytes]:
    return {f"{i}/{name}": array.tobytes() for i, part in enumerate(saved) for name, array in part.items()}


def test_one_batch_can_be_overfitted() -> None:
    shape = {"width": 16, "groups": 8, "codes": 64}
    schedule = {"steps": 100, "learning_rate": 5e-3, "schedule": "cosine", "warmup_steps": 10}
    recipe = tiny_recipe(**shape, **schedule, batch_size=1, restart_every=20)
    training = VqganTraining(recipe, card_frames(1))
    losses = [training.step(index)["l1"].item() for index in range(recipe.steps)]
    assert losses[-1] < 0.25 * losses[0]


@pytest.mark.parametrize(
    "changes", [{}, {"codebook_start": 2}, {"discriminator_weight": 0.8, "discriminator_start": 2}]
)
def test_stopping_and_resuming_gives_the_same_bits(changes: dict[str, object]) -> None:
    recipe = tiny_recipe(**changes)
    whole = _train(recipe, 6).save()
    half = _train(recipe, 3).save()
    assert _bytes(_train(recipe, 6, saved=half, first=3).save()) == _bytes(whole)


def test_unused_codes_are_moved_onto_what_the_encoder_gives() -> None:
    training = _train(tiny_recipe(restart_every=4), 3)
    with torch.no_grad():
        training.model.quantize.embedding.weight[7] = 1e3
    training.uses[7] = 0
    training.step(3)
    assert training.model.quantize.embedding.weight[7].abs().max() < 100


def test_the_codebook_starts_on_the_encoders_outputs() -> None:
    training = _train(tiny_recipe(learning_rate=1e-9), 1)
    frames, _ = card_frames().batch(seed=0, step=0, size=4)
    z = training.model.encode(torch.from_numpy(frames).permute(0, 3, 1, 2) / 127.5 - 1).latents
    vectors = z.permute(0, 2, 3, 1).flatten(0, 2)
    assert torch.cdist(vectors, training.model.quantize.embedding.weight).amin(1).mean() < 0.4 * vectors.std()


def test_commitment_weighs_the_encoders_term() -> None:
    training = VqganTraining(tiny_recipe(), card_frames())
    z = torch.randn(1, 3, 4, 4, requires_grad=True)
    _, loss, _ = training.model.quantize(z)
    loss.backward()
    codes = training.model.quantize.embedding.weight
    assert z.grad is not None
    # Both gradients have the same sum of differences, up to the sign and commitment.
    assert torch.allclose(z.grad.sum((0, 2, 3)), -0.25 * codes.grad.sum(0), atol=1e-6)


def test_frames_too_small_for_lpips_are_refused() -> None:
    clip = Clip(np.zeros((2, 24, 24, 3), np.uint8))
    with pytest.raises(UsageError, match="at least 31"):
        VqganTraining(tiny_recipe(perceptual="alex"), TrainingFrames([clip]))


def test_moving_pixels_weigh_more() -> None:
    real, fake = torch.zeros(1, 3, 2, 2), torch.zeros(1, 3, 2, 2)
    fake[..., 0, 0] = 1.0
    moving = torch.zeros(1, 2, 2, dtype=torch.bool)
    assert weighted_l1(real, fake, moving, 3.0).item() == pytest.approx(0.25)
    moving[..., 0, 0] = True
    assert weighted_l1(real, fake, moving, 3.0).item() == pytest.approx(4 / 7)


def test_the_discriminator_learns_to_tell_real_from_fake() -> None:
    torch.manual_seed(0)
    net = PatchDiscriminator(filters=8)
    optimizer = torch.optim.Adam(net.parameters(), 1e-3)
    real, fake = torch.rand(4, 3, 32, 48), -torch.rand(4, 3, 32, 48)
    for _ in range(20):
        loss = discriminator_loss(net(real), net(fake))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.5
    assert net(real).mean() > net(fake).mean()


def test_learning_rate_warms_up_and_ends_near_zero() -> None:
    recipe = tiny_recipe(steps=100, warmup_steps=10, schedule="cosine", learning_rate=1.0)
    rates = [learning_rate(recipe, i) for i in range(100)]
    assert rates[:10] == pytest.approx([0.1 * (i + 1) for i in range(10)])
    assert rates[10:] == sorted(rates[10:], reverse=True)
    assert rates[-1] < 0.01


@settings(deadline=None)
@given(st.integers(0, 10), st.integers(0, 10_000), st.integers(1, 8))
def test_batches_depend_on_seed_and_step_alone(seed: int, step: int, size: int) -> None:
    one = card_frames().batch(seed=seed, step=step, size=size)
    frames = card_frames()
    frames.batch(seed=seed, step=step + 1, size=3)
    other = frames.batch(seed=seed, step=step, size=size)
    assert np.array_equal(one[0], other[0])
    assert np.array_equal(one[1], other[1])


def test_different_steps_draw_different_frames() -> None:
    frames = card_frames()
    batches = {frames.batch(seed=0, step=step, size=8)[0].tobytes() for step in range(8)}
    assert len(batches) == 8


def test_crops_centre_on_what_moves() -> None:
    frames = np.zeros((9, HEIGHT, WIDTH, 3), np.uint8)
    for i in range(9):
        frames[i, 20:23, 5 * i : 5 * i + 3] = 255
    crops, moving = TrainingFrames([Clip(frames)], crop=16, crop_moving=1.0).batch(seed=0, step=0, size=32)
    assert crops.shape == (32, 16, 16, 3)
    assert (moving.any((1, 2)) == (crops.max((1, 2, 3)) == 255)).all()
    assert moving.any((1, 2)).mean() > 0.9


def test_views_of_different_sizes_need_crops() -> None:
    clips = [Clip(np.zeros((2, 32, 48, 3), np.uint8)), Clip(np.zeros((2, 32, 32, 3), np.uint8))]
    with pytest.raises(UsageError, match="share_views"):
        TrainingFrames(clips)
    assert TrainingFrames(clips, crop=16).batch(seed=0, step=0, size=8)[0].shape == (8, 16, 16, 3)


@given(st.integers(1, 40), st.integers(0, 1000))
def test_spread_samples_are_vectors_of_the_set(count: int, seed: int) -> None:
    vectors = torch.arange(30.0).view(10, 3)
    picked = spread_sample(vectors, count, np.random.default_rng(seed))
    assert len(picked) == count
    assert all((vectors == row).all(1).any() for row in picked)


def test_spread_samples_reach_the_rare() -> None:
    vectors = torch.zeros(10_000, 3)
    vectors[0] = 5.0
    assert (spread_sample(vectors, 4, np.random.default_rng(0)) == 5.0).any()
