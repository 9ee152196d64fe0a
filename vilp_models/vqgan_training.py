"""One optimiser step of VQGAN training, and the state it carries from step to step."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from diffusers import VQModel
from torch import Tensor
from torch.optim import Adam, Optimizer

from vilp_data.errors import UsageError, VilpDataError
from vilp_models.checkpoint import Arrays
from vilp_models.frames import TrainingFrames
from vilp_models.lpips import MIN_SIDE, load_lpips
from vilp_models.recipe import VqganRecipe
from vilp_models.vqgan import build_vqgan, check_divisible, to_signed
from vilp_models.vqgan_loss import PatchDiscriminator, adaptive_weight, discriminator_loss, weighted_l1

CODEBOOK_BATCHES = 8
"""Batches whose latents the first codebook is fitted to."""

K_MEANS_ROUNDS = 10


class DivergedError(VilpDataError):
    """A loss or gradient is no longer a finite number."""


@dataclass(frozen=True)
class Reconstruction:
    """A forward pass: images [B,3,H,W] in [-1, 1], latents before quantisation [B,c,h,w], the codes chosen or None."""

    fake: Tensor
    latents: Tensor
    codebook_loss: Tensor
    codes: Tensor | None


class VqganTraining:
    """A VQGAN with its discriminator, optimisers and counters.

    Step i is a function of recipe, frames, i and the saved state alone: there is no hidden random state, so saving and
    restoring between any two steps changes nothing.
    """

    def __init__(self, recipe: VqganRecipe, frames: TrainingFrames, *, device: str | torch.device = "cpu") -> None:
        self.recipe, self.frames, self.device = recipe, frames, torch.device(device)
        for height, width in frames.sizes():
            _check_size(recipe, height, width)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            self.model: VQModel = build_vqgan(recipe).to(self.device).train()
            self.discriminator = PatchDiscriminator().to(self.device) if recipe.discriminator_weight > 0 else None
        self.perceptual = load_lpips(recipe.perceptual).to(self.device) if recipe.perceptual != "none" else None
        self.optimizers: dict[str, Optimizer] = {
            "generator": Adam(self.model.parameters(), recipe.learning_rate, recipe.betas)
        }
        if self.discriminator is not None:
            self.optimizers["discriminator"] = Adam(self.discriminator.parameters(), recipe.learning_rate, recipe.betas)
        self.uses = torch.zeros(recipe.codes, dtype=torch.int64, device=self.device)

    # --- one step

    def step(self, index: int) -> dict[str, float]:
        """Do step `index`; its losses. Raises DivergedError where one is not finite, before it reaches the weights."""
        for optimizer in self.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(self.recipe, index)
        if index == self.recipe.codebook_start:
            self._fit_codebook()
        real, moving = self._batch(index)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.recipe.precision == "bf16"):
            out = self._reconstruct(real, quantise=index >= self.recipe.codebook_start)
            losses = self._generator_losses(index, real, out, moving)
        self._update("generator", torch.stack(list(losses.values())).sum(), list(self.model.parameters()))
        if self.discriminator is not None and index >= self.recipe.discriminator_start:
            losses["discriminator"] = self._train_discriminator(real, out.fake.detach())
        if out.codes is not None:
            self._count_codes(index, out.codes, out.latents.detach())
        return {name: loss.item() for name, loss in losses.items()}

    def _batch(self, index: int) -> tuple[Tensor, Tensor]:
        frames, moving = self.frames.batch(seed=self.recipe.seed, step=index, size=self.recipe.batch_size)
        # The frames cross to the device as bytes.
        return to_signed(torch.from_numpy(frames).to(self.device)), torch.from_numpy(moving).to(self.device)

    def _reconstruct(self, real: Tensor, *, quantise: bool) -> Reconstruction:
        z = self.model.encode(real).latents.float()
        if not quantise:
            return Reconstruction(
                self.model.decode(z, force_not_quantize=True).sample.float(), z, z.new_zeros(()), None
            )
        with torch.autocast(self.device.type, enabled=False):  # distances between latents need all their digits
            z_q, codebook_loss, (_, _, codes) = self.model.quantize(z)
        fake = self.model.decoder(self.model.post_quant_conv(z_q)).float()
        return Reconstruction(fake, z, codebook_loss, codes)

    def _generator_losses(self, index: int, real: Tensor, out: Reconstruction, moving: Tensor) -> dict[str, Tensor]:
        recipe = self.recipe
        losses = {"l1": weighted_l1(real, out.fake, moving, recipe.moving_weight)}
        if self.perceptual is not None:
            few = slice(recipe.perceptual_images)
            losses["lpips"] = recipe.perceptual_weight * self.perceptual(out.fake[few], real[few]).mean()
        if self.discriminator is not None and index >= recipe.discriminator_start:
            adversarial = -self.discriminator(out.fake).float().mean()
            reconstruction = torch.stack(list(losses.values())).sum()
            weight = adaptive_weight(reconstruction, adversarial, self.model.decoder.conv_out.weight)
            losses["adversarial"] = recipe.discriminator_weight * weight * adversarial
        losses["codebook"] = recipe.codebook_weight * out.codebook_loss
        return losses

    def _train_discriminator(self, real: Tensor, fake: Tensor) -> Tensor:
        assert self.discriminator is not None
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.recipe.precision == "bf16"):
            loss = discriminator_loss(self.discriminator(real).float(), self.discriminator(fake).float())
        self._update("discriminator", loss, list(self.discriminator.parameters()))
        return loss

    def _update(self, name: str, loss: Tensor, parameters: list[torch.nn.Parameter]) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = torch.nn.utils.clip_grad_norm_(parameters, self.recipe.clip_norm or math.inf)
        if not (torch.isfinite(loss) and torch.isfinite(norm)):
            raise DivergedError(
                f"the {name}'s loss is no longer finite",
                found=f"loss {loss.item():g}, gradient norm {norm.item():g}",
                remedy="lower models.vqgan.learning_rate or set clip_norm; the last checkpoint is kept",
            )
        optimizer.step()

    # --- the codebook

    @torch.no_grad()
    def _fit_codebook(self) -> None:
        """Put the codes on the encoder's outputs: diffusers starts them within 1/codes of zero, which collapses."""
        latents = [self.model.encode(self._batch(i)[0]).latents for i in range(CODEBOOK_BATCHES)]
        vectors = torch.cat([z.permute(0, 2, 3, 1).flatten(0, 2) for z in latents])
        codes = spread_sample(vectors, self.recipe.codes, self._random(0))
        self.model.quantize.embedding.weight.copy_(k_means(vectors, codes))

    @torch.no_grad()
    def _count_codes(self, index: int, codes: Tensor, latents: Tensor) -> None:
        self.uses += torch.bincount(codes.flatten(), minlength=self.recipe.codes)
        if not self.recipe.restart_every or (index + 1) % self.recipe.restart_every:
            return
        dead = self.uses == 0
        vectors = latents.permute(0, 2, 3, 1).flatten(0, 2)
        embedding = self.model.quantize.embedding.weight
        embedding[dead] = spread_sample(vectors, int(dead.sum()), self._random(index))
        for moment in self.optimizers["generator"].state[embedding].values():
            if moment.shape == embedding.shape:  # what Adam remembers of a code that is gone
                moment[dead] = 0
        self.uses.zero_()

    def _random(self, index: int) -> np.random.Generator:
        return np.random.Generator(np.random.Philox(key=self.recipe.seed, counter=[0, 0, 1, index]))

    # --- saving

    def save(self) -> tuple[Arrays, Arrays]:
        """(the network's tensors, all else that resuming needs)."""
        trainer = {"uses": self.uses.cpu().numpy()}
        if self.discriminator is not None:
            trainer |= {f"discriminator/{name}": _array(t) for name, t in self.discriminator.state_dict().items()}
        for name, optimizer in self.optimizers.items():
            for number, moments in optimizer.state_dict()["state"].items():
                trainer |= {f"optimizer/{name}/{number}/{key}": _array(value) for key, value in moments.items()}
        return {name: _array(t) for name, t in self.model.state_dict().items()}, trainer

    def restore(self, model: Arrays, trainer: Arrays) -> None:
        """The inverse of `save`."""
        self.model.load_state_dict(_tensors(model, self.model))
        self.uses.copy_(torch.from_numpy(trainer["uses"]))
        if self.discriminator is not None:
            prefix = "discriminator/"
            own = {name.removeprefix(prefix): array for name, array in trainer.items() if name.startswith(prefix)}
            self.discriminator.load_state_dict(_tensors(own, self.discriminator))
        for name, optimizer in self.optimizers.items():
            prefix = f"optimizer/{name}/"
            state: dict[int, dict[str, Tensor]] = {}
            for path, array in trainer.items():
                if path.startswith(prefix):
                    number, key = path.removeprefix(prefix).split("/")
                    state.setdefault(int(number), {})[key] = torch.from_numpy(
                        array.reshape(()) if key == "step" else array
                    )
            optimizer.load_state_dict({**optimizer.state_dict(), "state": state})


def learning_rate(recipe: VqganRecipe, index: int) -> float:
    """Of step `index`: linear warm-up, then constant, or half a cosine down to zero at the last step."""
    if index < recipe.warmup_steps:
        return recipe.learning_rate * (index + 1) / recipe.warmup_steps
    if recipe.schedule == "constant":
        return recipe.learning_rate
    done = (index - recipe.warmup_steps) / max(1, recipe.steps - recipe.warmup_steps)
    return recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * done))


def spread_sample(vectors_NC: Tensor, count: int, random: np.random.Generator) -> Tensor:
    """`count` of the vectors [N,C]: half drawn evenly, half with odds that grow with the distance from those, so that
    what is rare in the images (a small robot on a plain table) gets codes too."""
    n = len(vectors_NC)
    first = torch.from_numpy(random.integers(n, size=count - count // 2)).to(vectors_NC.device)
    if count < 2:
        return vectors_NC[first]
    distance = (
        torch.cdist(vectors_NC.float(), vectors_NC[first].float()).amin(dim=1).square().double().cpu().numpy() + 1e-12
    )
    second = random.choice(n, size=count // 2, p=distance / distance.sum())
    return torch.cat([vectors_NC[first], vectors_NC[torch.from_numpy(second).to(vectors_NC.device)]])


def k_means(vectors_NC: Tensor, centres_KC: Tensor, *, rounds: int = K_MEANS_ROUNDS) -> Tensor:
    """Lloyd's iterations from `centres_KC`: the moved centres [K,C]; one that is nearest to no vector stays."""
    vectors, centres = vectors_NC.float(), centres_KC.float().clone()
    for _ in range(rounds):
        nearest = torch.cdist(vectors, centres).argmin(dim=1)
        count = torch.bincount(nearest, minlength=len(centres))
        total = torch.zeros_like(centres).index_add_(0, nearest, vectors)
        centres = torch.where(count[:, None] > 0, total / count[:, None].clamp(min=1), centres)
    return centres


def _check_size(recipe: VqganRecipe, height: int, width: int) -> None:
    check_divisible(height, width, recipe.downsampling)
    if recipe.perceptual == "none" or min(height, width) >= MIN_SIDE[recipe.perceptual]:
        return
    raise UsageError(
        f"LPIPS ({recipe.perceptual}) needs images of at least {MIN_SIDE[recipe.perceptual]} pixels a side",
        found=f"{height}x{width}",
        remedy="enlarge models.vqgan.crop, or set models.vqgan.perceptual",
    )


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()


def _tensors(arrays: Arrays, like: torch.nn.Module) -> dict[str, Tensor]:
    """Arrays as tensors, in the module's shapes: files hold no scalars, only vectors of one."""
    shapes = {name: tensor.shape for name, tensor in like.state_dict().items()}
    return {name: torch.from_numpy(array.reshape(shapes.get(name, array.shape))) for name, array in arrays.items()}
