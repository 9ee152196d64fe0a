"""The latent video planner of one view: from what all cameras see now to the latents of its next N frames (paper, "Latent video
diffusion").

Shape suffixes: B batch, N planned frames, C latent channels, H and W image pixels, h and w latent pixels, L context tokens,
D context size. Inside the UNet frames are the axis T. Clips are standardised per channel by training statistics before noise is added;
what comes out is in the VQGAN's own units again, not yet quantised.

How the present reaches the network is a setting (`PlannerRecipe.condition`):
  token    each view's frame through a ResNet-18, averaged; all of them and low_dim in one vector: the paper's. Attention to it is
           exact as an addition, computed once a plan (see `unet3d`)
  tokens   the cells of each view's last map, and one of low_dim, to attend to
  concat   the present frames' latents of all views, repeated over time, beside the noisy ones
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from vilp_data.dataset import WindowTensors
from vilp_data.errors import UsageError
from vilp_models import diffusion
from vilp_models.contract import DataContract
from vilp_models.normaliser import Normaliser
from vilp_models.recipe import PlannerRecipe
from vilp_models.unet3d import Projected, UNet3d
from vilp_models.vision import ResNet18
from vilp_models.vqgan import to_signed

Sampler = Literal["ddim", "dpm++"]


@dataclass(frozen=True)
class Condition:
    """What a plan starts from, computed once and used at every denoising step.

    projected  what the UNet's attention keeps of the context
    beside     present latents of all views for concatenation, standardised, [B,C',1,h,w]; None without
    present    this view's present latents, standardised, [B,C,1,h,w]: the clip's known first frame; None where clips begin after it
    """

    projected: list[Projected]
    beside: Tensor | None
    present: Tensor | None


class Planner(nn.Module):
    """A UNet over clips of one view's latents, with the encoder of its condition and its own normaliser."""

    alphas_bar: Tensor

    def __init__(self, recipe: PlannerRecipe, contract: DataContract, view: str) -> None:
        """Raises UsageError where the latents cannot be halved often enough, or views cannot be concatenated."""
        super().__init__()
        self.recipe, self.view, self.views = recipe, view, contract.views
        self.n_plan_frames = contract.n_plan_frames
        shapes = contract.latent_shapes
        self.clip_shape = (contract.n_plan_frames, *shapes[view])
        _check_sides(shapes[view], halvings=len(recipe.multipliers) - 1)
        self.latents = nn.ModuleDict({v: Normaliser(contract.normaliser[f"latents/{v}"], axis=-3) for v in shapes})
        self.sees_low_dim = recipe.low_dim and contract.low_dim_size > 0
        self.concatenates, self.attends = "concat" in recipe.condition, recipe.condition != "concat"
        beside = 0
        if self.concatenates:
            _check_equal_sides({v: shapes[v] for v in self.views})
            beside = sum(shapes[v][0] for v in self.views)
        self.context = Context(recipe, contract, low_dim=self.sees_low_dim) if self.attends else None
        self.unet = UNet3d(
            shapes[view][0] + beside,
            shapes[view][0],
            channels=recipe.channels,
            blocks=recipe.blocks,
            convolutions=recipe.convolutions,
            groups=recipe.groups,
            head_size=recipe.head_size,
            context_size=None if self.context is None else self.context.size,
            one_token=recipe.condition.startswith("token+") or recipe.condition == "token",
        )
        alphas_bar = diffusion.cosine_alphas_bar(recipe.train_steps, zero_terminal_snr=recipe.prediction == "v")
        self._schedule: list[float] = alphas_bar.tolist()  # for samplers, which would wait for a device's numbers
        self.register_buffer("alphas_bar", alphas_bar.float(), persistent=False)

    @property
    def sees_latents(self) -> bool:
        """Whether `condition` needs the present frames' latents."""
        return self.concatenates or self.recipe.clip == "present"

    def denoising_steps(self, asked: int | None = None) -> int:
        """As many as asked for, else the recipe's. Raises UsageError for more than there are noise levels to visit."""
        steps, levels = asked or self.recipe.denoising_steps, self.recipe.train_steps
        if steps > levels:
            raise UsageError(
                "more denoising steps than the planner knows noise levels",
                found=f"{steps} denoising steps, models.planner.train_steps = {levels}",
                remedy=f"ask for at most {levels}; few are enough, as the recipe's {self.recipe.denoising_steps}",
            )
        return steps

    # --- training

    def losses(self, batch: WindowTensors, generator: torch.Generator) -> dict[str, Tensor]:
        """{"denoising": mean squared error of what the network is to predict}, at a random level for each clip.

        Frames past an episode's end count too: the goal absorbs. `generator` lives on the batch's device."""
        x0 = self._standardised(self.view, batch.latents[self.view]).transpose(1, 2)
        condition = self.condition(batch.frames, batch.present_latents, batch.low_dim)
        level = torch.randint(len(self.alphas_bar), (len(x0),), generator=generator, device=x0.device)
        noise = torch.randn(x0.shape, generator=generator, device=x0.device)
        alpha_bar = self.alphas_bar[level].view(-1, 1, 1, 1, 1)
        predicted = self.predict(diffusion.add_noise(x0, noise, alpha_bar), level, condition)
        wanted = diffusion.target(x0, noise, alpha_bar, self.recipe.prediction)
        return {"denoising": (predicted.float() - wanted).square().mean()}

    # --- imagining

    def condition(
        self, frames: Mapping[str, Tensor], present_latents: Mapping[str, Tensor], low_dim: Tensor
    ) -> Condition:
        """From the present: view -> uint8 [B,H,W,3], view -> latents [B,C,h,w] of the same frames, low_dim float32 [B,L].

        What the recipe's condition does not use may be left out of the mappings."""
        projected, beside, present = [], None, None
        if self.context is not None:
            projected = self.unet.project(self.context(frames, low_dim))
        if self.concatenates:
            parts = [self._standardised(v, present_latents[v]) for v in self.views]
            beside = torch.cat(parts, dim=1).unsqueeze(2)
        if self.recipe.clip == "present":
            present = self._standardised(self.view, present_latents[self.view]).unsqueeze(2)
        return Condition(projected, beside, present)

    def predict(self, x_BCThw: Tensor, level_B: Tensor, condition: Condition) -> Tensor:
        """One call of the UNet on standardised noisy latents of the planned frames; returns the same shape."""
        x, known = x_BCThw, 0
        if self.recipe.clip == "present":
            assert condition.present is not None
            x, known = torch.cat([condition.present, x], dim=2), 1
        if condition.beside is not None:
            x = torch.cat([x, condition.beside.expand(-1, -1, x.shape[2], -1, -1)], dim=1)
        out: Tensor = self.unet(x, level_B, condition.projected)
        return out[:, :, known:]

    def sample(
        self, condition: Condition, noise: Tensor, *, steps: int | None = None, sampler: Sampler | None = None
    ) -> Tensor:
        """Imagined latents float32 [B,N,C,h,w] of frames t+Δt … t+NΔt, from unit `noise` of the same shape.

        `steps` and `sampler` are the recipe's unless told otherwise. Raises as `denoising_steps`."""
        recipe, n_steps = self.recipe, self.denoising_steps(steps)

        def network(x: Tensor, t: Tensor) -> Tensor:
            return self.predict(x, t, condition)

        start, prediction = noise.float().transpose(1, 2), recipe.prediction
        if (sampler or recipe.sampler) == "ddim":
            levels = diffusion.sampling_levels(recipe.train_steps, n_steps, recipe.spacing)
            x0 = diffusion.ddim(network, start, self._schedule, levels, prediction)
        else:
            spacing = recipe.spacing
            x0 = diffusion.dpm_solver(network, start, self._schedule, n_steps, spacing=spacing, prediction=prediction)
        return self._normaliser(self.view).restored(x0.transpose(1, 2).float())

    def _normaliser(self, view: str) -> Normaliser:
        module = self.latents[view]
        assert isinstance(module, Normaliser)
        return module

    def _standardised(self, view: str, latents: Tensor) -> Tensor:
        return self._normaliser(view).normalised(latents.float())


class Context(nn.Module):
    """Frames of all views and low_dim to tokens [B,L,D]: one, or the cells of each view's map and one of low_dim."""

    size: int

    def __init__(self, recipe: PlannerRecipe, contract: DataContract, *, low_dim: bool) -> None:
        super().__init__()
        self.views = contract.views
        self.several = recipe.condition.startswith("tokens")
        nets = {v: ResNet18(recipe.vision_width, contract.image_channels(v), grid=self.several) for v in self.views}
        self.vision = nn.ModuleDict(nets)
        self.low_dim = Normaliser(contract.normaliser["low_dim"]) if low_dim else None
        features = nets[self.views[0]].features
        if self.several:
            self.size = features
            # Which cell of which view a token is, the token itself must say.
            cells = {
                view: _cells(contract.geometry[view], contract.image_channels(view), net) for view, net in nets.items()
            }
            self.places = nn.ParameterDict({v: nn.Parameter(0.02 * torch.randn(n, features)) for v, n in cells.items()})
            self.lift = nn.Linear(contract.low_dim_size, features) if low_dim else None
        else:
            self.size = features * len(self.views) + (contract.low_dim_size if low_dim else 0)

    def forward(self, frames: Mapping[str, Tensor], low_dim: Tensor) -> Tensor:
        seen = [self.vision[view](to_signed(frames[view])) for view in self.views]
        state = None if self.low_dim is None else self.low_dim.normalised(low_dim.float())
        if not self.several:
            return torch.cat([*seen, *([] if state is None else [state])], dim=1).unsqueeze(1)
        tokens = [cells + self.places[view] for view, cells in zip(self.views, seen, strict=True)]
        if state is not None and self.lift is not None:
            tokens.append(self.lift(state).unsqueeze(1))
        return torch.cat(tokens, dim=1)


@torch.no_grad()
def _cells(geometry: tuple[int, int, str], channels: int, vision: nn.Module) -> int:
    height, width, _ = geometry
    return int(vision(torch.zeros(1, channels, height, width)).shape[1])


def _check_sides(shape: tuple[int, int, int], *, halvings: int) -> None:
    _, h, w = shape
    if h % 2**halvings or w % 2**halvings:
        raise UsageError(
            f"a planner of {halvings + 1} levels needs latents whose sides are multiples of {2**halvings}",
            found=f"{h}x{w} latent pixels",
            remedy="give models.planner.multipliers fewer levels, or models.vqgan.multipliers fewer (80x80 images: f = 4)",
        )


def _check_equal_sides(shapes: Mapping[str, tuple[int, int, int]]) -> None:
    if len({shape[1:] for shape in shapes.values()}) > 1:
        raise UsageError(
            "latents of views of different sizes cannot be concatenated",
            found=", ".join(f"{view} {h}x{w}" for view, (_, h, w) in shapes.items()),
            remedy='set models.planner.condition = "token" or "tokens"',
        )
