from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.models.conftest import HEIGHT, WIDTH, card_frames, tiny_recipe
from tests.synthetic import colour_card
from vilp_data.errors import UsageError
from vilp_models.frames import Clip, TrainingFrames
from vilp_models.metrics import psnr
from vilp_models.vqgan import VqganEncoder, build_vqgan, nearest_codes, to_frames, to_signed
from vilp_models.vqgan_training import VqganTraining


@pytest.fixture(scope="module")
def overfitted() -> VqganEncoder:
    """A tiny VQGAN that has seen the colour card and nothing else."""
    torch.set_num_threads(1)
    shape = {"width": 16, "groups": 8, "codes": 64}
    schedule = {"steps": 150, "batch_size": 1, "learning_rate": 5e-3, "schedule": "cosine", "warmup_steps": 10}
    recipe = tiny_recipe(**shape, **schedule, restart_every=20)
    training = VqganTraining(recipe, TrainingFrames([Clip(colour_card(HEIGHT, WIDTH)[None])]))
    for index in range(recipe.steps):
        training.step(index)
    return VqganEncoder(training.model)


def _round_trip(encoder: VqganEncoder, frames: np.ndarray) -> np.ndarray:
    return encoder.decode(encoder.encode(frames))


def test_signed_images_are_the_inverse_of_frames() -> None:
    frames = torch.arange(256, dtype=torch.uint8).view(1, 16, 16, 1).expand(-1, -1, -1, 3).contiguous()
    signed = to_signed(frames)
    assert (signed.min().item(), signed.max().item()) == (-1.0, 1.0)
    assert torch.equal(to_frames(signed), frames)


def test_the_colour_card_keeps_its_corners_through_the_latents(overfitted: VqganEncoder) -> None:
    card = colour_card(HEIGHT, WIDTH)
    back = _round_trip(overfitted, card[None])[0]
    for rows in (slice(0, 8), slice(-8, None)):
        for columns in (slice(0, 12), slice(-12, None)):
            expected, found = card[rows, columns].mean((0, 1)), back[rows, columns].mean((0, 1))
            assert np.abs(expected - found).max() < 30
    assert psnr(card, back) > 20


@pytest.mark.parametrize("damage", ["channels", "rows", "columns"])
def test_a_swapped_channel_or_a_flip_would_not_pass_as_the_card(overfitted: VqganEncoder, damage: str) -> None:
    card = colour_card(HEIGHT, WIDTH)
    back = _round_trip(overfitted, card[None])[0]
    damaged = {"channels": back[..., ::-1], "rows": back[::-1], "columns": back[:, ::-1]}[damage]
    assert psnr(card, damaged) < 15


def test_latents_are_float16_of_the_promised_shape(overfitted: VqganEncoder) -> None:
    frames = np.zeros((3, HEIGHT, WIDTH, 3), np.uint8)
    latents = overfitted.encode(frames)
    assert latents.dtype == np.float16
    assert latents.shape == (3, *overfitted.latent_shape(HEIGHT, WIDTH)) == (3, 3, HEIGHT // 4, WIDTH // 4)
    assert _round_trip(overfitted, frames).shape == frames.shape


def test_read_only_frames_are_encoded(overfitted: VqganEncoder) -> None:
    frames = np.zeros((1, HEIGHT, WIDTH, 3), np.uint8)
    frames.flags.writeable = False
    np.testing.assert_array_equal(overfitted.encode(frames), overfitted.encode(frames.copy()))


def test_encoding_twice_gives_the_same_bytes(overfitted: VqganEncoder) -> None:
    frames, _ = card_frames().batch(seed=0, step=0, size=4)
    assert overfitted.encode(frames).tobytes() == overfitted.encode(frames).tobytes()


def test_sizes_that_cannot_be_halved_are_refused() -> None:
    encoder = VqganEncoder(build_vqgan(tiny_recipe(multipliers=(1, 1, 2, 2))))
    with pytest.raises(UsageError, match="multiples"):
        encoder.latent_shape(84, 80)
    with pytest.raises(UsageError, match="84x80"):
        encoder.encode(np.zeros((1, 84, 80, 3), np.uint8))


def test_the_key_changes_with_every_encoder_tensor_and_with_no_other() -> None:
    encoder = VqganEncoder(build_vqgan(tiny_recipe()))
    key = encoder.key
    assert len(key) == 16
    for name, tensor in encoder.model.state_dict().items():
        before = tensor.clone()
        tensor[(0,) * tensor.ndim] += 0.5
        decides_latents = name.startswith(("encoder.", "quant_conv."))
        assert (encoder.key != key) == decides_latents, name
        tensor.copy_(before)
    assert encoder.key == key


def test_the_key_changes_with_the_arithmetic() -> None:
    model = build_vqgan(tiny_recipe())
    assert VqganEncoder(model, precision="f32").key != VqganEncoder(model, precision="bf16").key


def test_the_key_changes_with_groups_that_leave_every_tensor_as_it_is() -> None:
    few, many = (build_vqgan(tiny_recipe(groups=groups)) for groups in (4, 8))
    many.load_state_dict(few.state_dict())
    frames = card_frames().batch(seed=0, step=0, size=1)[0]
    encoders = VqganEncoder(few), VqganEncoder(many)
    assert not np.array_equal(encoders[0].encode(frames), encoders[1].encode(frames))
    assert encoders[0].key != encoders[1].key
    assert encoders[0].key_fields["weights"] == encoders[1].key_fields["weights"]


def test_the_key_names_the_kind_of_device_and_accelerators_are_not_shared() -> None:
    encoder = VqganEncoder(build_vqgan(tiny_recipe()))
    assert (encoder.key_fields["device"], encoder.parallel) == ("cpu", True)
    key = encoder.key
    encoder.device = torch.device("cuda", 0)  # no tensor moves: the key asks for the device's kind alone
    assert (encoder.key_fields["device"], encoder.parallel) == ("cuda", False)
    assert encoder.key != key


def test_nearest_codes_are_nearest() -> None:
    codebook = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    z = torch.tensor([[0.9, 0.1, 0.0], [0.1, 0.9, 0.8]]).T.view(1, 3, 1, 2)
    assert nearest_codes(z, codebook).tolist() == [[[1, 2]]]
