"""The planner: its shortcut is exact, its condition reaches every frame, and it can learn."""

import dataclasses

import pytest
import torch
from torch import nn

from vilp_data.dataset import WindowTensors
from vilp_data.errors import UsageError
from vilp_models.contract import DataContract
from vilp_models.planner import Planner
from vilp_models.recipe import PlannerRecipe
from vilp_models.unet3d import CrossAttention, OneTokenAttention, UNet3d

VIEWS = ("side", "top")
SMALL = {
    "width": 16, "multipliers": (1, 2), "blocks": 1, "groups": 8, "convolutions": "factorised", "vision_width": 4,
    "batch_size": 2,
}  # fmt: skip
CONDITIONS = ["token", "tokens", "concat", "token+concat", "tokens+concat"]


def contract(**changes):
    """Two views of 32x48 with 4x6x3 latents, three numbers of low_dim."""
    normaliser = {f"latents/{view}": {"mean": [0.5, -1.0, 2.0], "std": [2.0, 0.5, 1.5]} for view in VIEWS}
    return DataContract(
        task="toy", views=VIEWS, geometry=dict.fromkeys(VIEWS, (32, 48, "")), rate_hz=10.0, frame_stride=2, n_plan_frames=5,
        latent_keys=dict.fromkeys(VIEWS, "key"), latent_shapes=dict.fromkeys(VIEWS, (3, 4, 6)), low_dim=({"part": "x"},),
        low_dim_size=3, normaliser={**normaliser, "low_dim": {"mean": [0.0] * 3, "std": [1.0] * 3}}, **changes,
    )  # fmt: skip


def batch(size=2, *, seed=0):
    random = torch.Generator().manual_seed(seed)
    return WindowTensors(
        frames={v: torch.randint(256, (size, 32, 48, 3), generator=random, dtype=torch.uint8) for v in VIEWS},
        present_latents={v: torch.randn(size, 3, 4, 6, generator=random).half() for v in VIEWS},
        latents={v: torch.randn(size, 5, 3, 4, 6, generator=random).half() for v in VIEWS},
        latent_mask=torch.ones(size, 5, dtype=torch.bool),
        low_dim=torch.randn(size, 3, generator=random),
        action=None,
        action_mask=torch.zeros(size, 10, dtype=torch.bool),
        episode=torch.zeros(size, dtype=torch.int64),
        step=torch.arange(size),
    )


def planner(*, seed=0, trained=True, **changes):
    torch.manual_seed(seed)
    recipe = PlannerRecipe.model_validate({**SMALL, "low_dim": changes.get("condition") != "concat", **changes})
    built = Planner(recipe, contract(), "top")
    if trained:  # layers that begin at zero would make every comparison true
        for parameter in built.parameters():
            if not parameter.any():
                nn.init.normal_(parameter, std=0.1)
    return built.eval()


def imagined(model, data, *, noise=None, **options):
    noise = torch.randn(len(data), 5, 3, 4, 6, generator=torch.Generator().manual_seed(9)) if noise is None else noise
    with torch.no_grad():
        condition = model.condition(data.frames, data.present_latents, data.low_dim)
        return model.sample(condition, noise, **options)


def plain(model):
    """The same planner, attending in full at every step."""
    for module in model.modules():
        for name, child in module.named_children():
            if isinstance(child, OneTokenAttention):
                setattr(module, name, child.as_full())
    return model


@pytest.mark.parametrize("sampler", ["ddim", "dpm++"])
def test_more_denoising_steps_than_noise_levels_are_refused(sampler):
    model = planner()
    levels = model.recipe.train_steps
    with pytest.raises(UsageError, match=rf"{levels + 1} denoising steps(.|\n)*at most {levels}"):
        imagined(model, batch(1), steps=levels + 1, sampler=sampler)


@pytest.mark.parametrize("condition", ["token", "token+concat"])
def test_attention_to_one_token_equals_full_attention(condition):
    shortcut, full = planner(condition=condition), plain(planner(condition=condition))
    assert sum(isinstance(m, CrossAttention) for m in full.modules()) == 4  # one down, the middle, two up
    assert not any(isinstance(m, CrossAttention) for m in shortcut.modules())
    assert torch.allclose(imagined(shortcut, batch()), imagined(full, batch()), rtol=1e-4, atol=1e-4)


def test_full_attention_to_one_token_gives_its_queries_and_keys_no_gradient():
    full = plain(planner(condition="token"))
    full.losses(batch(), torch.Generator().manual_seed(0))["denoising"].backward()
    for attention in (m for m in full.modules() if isinstance(m, CrossAttention)):
        assert attention.to_q.weight.grad.abs().max() < 1e-7
        assert attention.to_k.weight.grad.abs().max() < 1e-7
        assert attention.to_v.weight.grad.abs().max() > 1e-6


def test_attention_to_one_token_refuses_several():
    with pytest.raises(ValueError, match="one token, not 2"):
        OneTokenAttention(16, 8, 8).project(torch.zeros(1, 2, 8))


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("sampler", ["ddim", "dpm++"])
def test_a_plan_has_the_latents_shape_and_follows_from_its_noise(condition, sampler):
    model, data = planner(condition=condition), batch()
    first = imagined(model, data, sampler=sampler)
    assert first.shape == (2, 5, 3, 4, 6)
    assert first.dtype == torch.float32
    assert torch.isfinite(first).all()
    assert torch.equal(first, imagined(model, data, sampler=sampler))
    other = torch.randn(2, 5, 3, 4, 6, generator=torch.Generator().manual_seed(10))
    assert not torch.allclose(first, imagined(model, data, noise=other, sampler=sampler))


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("view", VIEWS)
def test_every_view_reaches_the_plan(condition, view):
    model, data = planner(condition=condition), batch()
    blind = dataclasses.replace(
        data,
        frames={**data.frames, view: torch.zeros_like(data.frames[view])},
        present_latents={**data.present_latents, view: torch.zeros_like(data.present_latents[view])},
    )
    assert not torch.allclose(imagined(model, data), imagined(model, blind), atol=1e-5)


@pytest.mark.parametrize("condition", ["token", "tokens", "token+concat"])
def test_low_dim_reaches_the_plan_unless_it_is_left_out(condition):
    data = batch()
    moved = dataclasses.replace(data, low_dim=data.low_dim + 1)
    seeing, without = planner(condition=condition), planner(condition=condition, low_dim=False)
    assert not torch.allclose(imagined(seeing, data), imagined(seeing, moved), atol=1e-5)
    assert torch.equal(imagined(without, data), imagined(without, moved))


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("clip", ["future", "present"])
def test_training_reaches_every_parameter(condition, clip):
    model = planner(condition=condition, clip=clip).train()
    model.losses(batch(), torch.Generator().manual_seed(0))["denoising"].backward()
    still = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert not still


def test_a_clip_that_begins_with_the_present_is_told_it():
    data = batch()
    other = dataclasses.replace(data, present_latents={v: x + 1 for v, x in data.present_latents.items()})
    model = planner(condition="token", clip="present")
    assert not torch.allclose(imagined(model, data), imagined(model, other), atol=1e-5)
    without = planner(condition="token", clip="future")
    assert torch.equal(imagined(without, data), imagined(without, other))


def test_each_clip_of_a_batch_is_planned_by_itself():
    model, data = planner(condition="tokens+concat"), batch()
    noise = torch.randn(2, 5, 3, 4, 6, generator=torch.Generator().manual_seed(9))
    second = data.map(lambda tensor: tensor[1:])
    together = imagined(model, data, noise=noise)
    assert torch.allclose(together[1:], imagined(model, second, noise=noise[1:]), atol=1e-4)


@pytest.mark.parametrize("prediction", ["v", "epsilon"])
def test_one_batch_is_learnt_by_heart(prediction):
    spacing = "trailing" if prediction == "v" else "leading"
    model = planner(prediction=prediction, spacing=spacing, convolutions="full", trained=False).train()
    data, random = batch(), torch.Generator()
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    losses = []
    for _ in range(70):
        loss = model.losses(data, random.manual_seed(0))["denoising"]  # the same noise each time
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.02 * losses[0]


def test_a_clip_that_was_learnt_is_imagined():
    """From pure noise, in four steps, and told by the present which of two clips it is."""
    model = planner(condition="concat", convolutions="full", trained=False, head_size=16).train()
    data, random = batch(), torch.Generator().manual_seed(0)
    colour = 3 * torch.randn(2, 3, 1, 1, generator=random).expand(2, 3, 4, 6)
    wanted = colour[:, None] * torch.linspace(0.8, -1, 5)[:, None, None, None]  # each fades into its negative
    data = dataclasses.replace(
        data, latents={"top": wanted.half()}, present_latents=dict.fromkeys(VIEWS, colour.half())
    )
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    for _ in range(150):
        loss = model.losses(data, random)["denoising"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    error = (imagined(model.eval(), data) - wanted).square().mean()
    copied = (colour[:, None] - wanted).square().mean()
    assert error < 0.05 * copied


def test_the_papers_network_has_the_papers_size():
    with torch.device("meta"):
        net = UNet3d(3, 3, channels=(128, 256, 512), blocks=2, context_size=514)
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(193.5e6, rel=0.06)


def test_latents_that_cannot_be_halved_are_refused():
    odd = dataclasses.replace(contract(), latent_shapes=dict.fromkeys(VIEWS, (3, 5, 6)))
    with pytest.raises(UsageError, match="multiples of 2"):
        Planner(PlannerRecipe.model_validate(SMALL), odd, "top")


def test_views_of_different_sizes_cannot_be_concatenated():
    odd = dataclasses.replace(contract(), latent_shapes={"side": (3, 4, 4), "top": (3, 4, 6)})
    with pytest.raises(UsageError, match="cannot be concatenated"):
        Planner(PlannerRecipe.model_validate({**SMALL, "condition": "token+concat"}), odd, "top")
