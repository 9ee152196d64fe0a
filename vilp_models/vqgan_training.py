"""One optimiser step of VQGAN training, and the state it carries from step to step."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from diffusers import VQModel
from torch import Tensor
from torch.optim import Adam, Optimizer

from vilp_data.errors import UsageError
from vilp_data.types import U8
from vilp_models.checkpoint import Arrays
from vilp_models.frames import TrainingFrames
from vilp_models.lpips import MIN_SIDE, load_lpips
from vilp_models.optimisation import learning_rate, update
from vilp_models.processes import Processes
from vilp_models.recipe import VqganRecipe
from vilp_models.training_state import arrays_of, load_arrays, load_optimizer, optimizer_arrays, under
from vilp_models.vqgan import build_vqgan, check_divisible, to_frames, to_signed
from vilp_models.vqgan_loss import PatchDiscriminator, adaptive_weight, discriminator_loss, weighted_l1

CODEBOOK_BATCHES = 8
"""Batches whose latents the first codebook is fitted to."""

K_MEANS_ROUNDS = 10

CLIP_FRAMES = 8


@dataclass(frozen=True)
class Reconstruction:
    """A forward pass: images [B,C,H,W] in [-1, 1], latents before quantisation [B,c,h,w], the codes chosen or None."""

    fake: Tensor
    latents: Tensor
    codebook_loss: Tensor
    codes: Tensor | None


class VqganTraining:
    """A VQGAN with its discriminator, optimisers and counters.

    Step i is a function of recipe, frames, i and the saved state alone: there is no hidden random state, so saving and
    restoring between any two steps changes nothing.
    """

    def __init__(self, recipe: VqganRecipe, frames: TrainingFrames, processes: Processes | None = None) -> None:
        """Raises UsageError for frames that the network cannot halve, and batches that the processes cannot share evenly."""
        self.recipe, self.frames = recipe, frames
        self.processes = processes = processes or Processes(recipe.precision)
        self.device = processes.device
        if recipe.batch_size % processes.count:
            found = f"batch_size = {recipe.batch_size} for {processes.count} processes"
            raise UsageError("a batch cannot be shared like that", found=found, remedy="batch_size must be a multiple")
        for height, width in frames.sizes():
            _check_size(recipe, height, width)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            self.model: VQModel = build_vqgan(recipe, image_channels=frames.channels).to(self.device).train()
            self.discriminator = (
                PatchDiscriminator(image_channels=frames.channels).to(self.device)
                if recipe.discriminator_weight > 0
                else None
            )
        self.perceptual = load_lpips(recipe.perceptual).to(self.device) if recipe.perceptual != "none" else None
        self.optimizers: dict[str, Optimizer] = {
            "generator": Adam(self.model.parameters(), recipe.learning_rate, recipe.betas)
        }
        if self.discriminator is not None:
            self.optimizers["discriminator"] = Adam(self.discriminator.parameters(), recipe.learning_rate, recipe.betas)
        self.uses = torch.zeros(recipe.codes, dtype=torch.int64, device=self.device)
        self.waited_s = 0.0
        self._quantises = False

    # --- one step

    def step(self, index: int) -> dict[str, Tensor]:
        """Do step `index`; its losses and gradient norms, as scalars on the device: nothing waits for it."""
        for optimizer in self.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(self.recipe, index)
        if index == self.recipe.codebook_start:
            self._fit_codebook()
        self._quantises = index >= self.recipe.codebook_start
        real, moving = self._share(*self._batch(index))
        with self.processes.autocast():
            out = self._reconstruct(real, quantise=self._quantises)
            losses = self._generator_losses(index, real, out, moving)
        norm = self._update("generator", torch.stack(list(losses.values())).sum())
        losses = {name: loss.detach() for name, loss in losses.items()} | {"gradient_norm": norm}
        if self.discriminator is not None and index >= self.recipe.discriminator_start:
            losses |= self._train_discriminator(real, out.fake.detach())
        if out.codes is not None:
            self._count_codes(index, out.codes, out.latents.detach())
        return losses

    def _batch(self, index: int) -> tuple[Tensor, Tensor]:
        """The batch that all processes share."""
        started = time.perf_counter()
        frames, moving = self.frames.batch(seed=self.recipe.seed, step=index, size=self.recipe.batch_size)
        self.waited_s += time.perf_counter() - started
        # The frames cross to the device as bytes.
        return to_signed(torch.from_numpy(frames).to(self.device)), torch.from_numpy(moving).to(self.device)

    def _share(self, real: Tensor, moving: Tensor) -> tuple[Tensor, Tensor]:
        size = self.recipe.batch_size // self.processes.count
        mine = slice(self.processes.rank * size, (self.processes.rank + 1) * size)
        return real[mine], moving[mine]

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

    def _train_discriminator(self, real: Tensor, fake: Tensor) -> dict[str, Tensor]:
        assert self.discriminator is not None
        with self.processes.autocast():
            loss = discriminator_loss(self.discriminator(real).float(), self.discriminator(fake).float())
        norm = self._update("discriminator", loss)
        return {"discriminator": loss.detach(), "discriminator_gradient_norm": norm}

    def _update(self, name: str, loss: Tensor) -> Tensor:
        return update(self.optimizers[name], loss, clip_norm=self.recipe.clip_norm, processes=self.processes)

    # --- the codebook

    @torch.no_grad()
    def _fit_codebook(self) -> None:
        """Put the codes on the encoder's outputs: diffusers starts them within 1/codes of zero, which collapses."""
        latents = [self.model.encode(self._batch(i)[0]).latents for i in range(CODEBOOK_BATCHES)]
        vectors = torch.cat([z.permute(0, 2, 3, 1).flatten(0, 2) for z in latents])
        codes = spread_sample(vectors, self.recipe.codes, self._random(0))
        embedding = self.model.quantize.embedding.weight
        embedding.copy_(k_means(vectors, codes))
        self.processes.copy_from_main([embedding])

    @torch.no_grad()
    def _count_codes(self, index: int, codes: Tensor, latents: Tensor) -> None:
        chosen = codes.flatten()  # not by bincount, which waits for the device to see how many there are
        here = torch.zeros_like(self.uses).scatter_add_(0, chosen, torch.ones_like(chosen))
        self.uses += self.processes.total(here)
        if not self.recipe.restart_every or (index + 1) % self.recipe.restart_every:
            return
        dead = self.uses == 0
        vectors = latents.permute(0, 2, 3, 1).flatten(0, 2)
        embedding = self.model.quantize.embedding.weight
        embedding[dead] = spread_sample(vectors, int(dead.sum()), self._random(index))
        for moment in self.optimizers["generator"].state[embedding].values():
            if moment.shape == embedding.shape:  # what Adam remembers of a code that is gone
                moment[dead] = 0
        self.processes.copy_from_main([embedding])  # each drew from its own latents
        self.uses.zero_()

    def _random(self, index: int) -> np.random.Generator:
        return np.random.Generator(np.random.Philox(key=self.recipe.seed, counter=[0, 0, 1, index]))

    # --- looking

    @torch.no_grad()
    def clips(self) -> Mapping[str, U8]:
        """Images of the first batch, each beside its reconstruction: uint8 [T,H,2W,C]."""
        real = self._batch(0)[0][:CLIP_FRAMES]
        fake = self._reconstruct(real, quantise=self._quantises).fake
        return {"real and reconstructed": to_frames(torch.cat([real, fake], dim=3)).cpu().numpy()}

    # --- saving

    def save(self) -> tuple[Arrays, Arrays]:
        """(the network's tensors, all else that resuming needs)."""
        trainer = arrays_of({"uses": self.uses})
        if self.discriminator is not None:
            trainer |= arrays_of(self.discriminator.state_dict(), prefix="discriminator/")
        for name, optimizer in self.optimizers.items():
            trainer |= optimizer_arrays(optimizer, prefix=f"optimizer/{name}/")
        return arrays_of(self.model.state_dict()), trainer

    def restore(self, model: Arrays, trainer: Arrays) -> None:
        """The inverse of `save`."""
        load_arrays(self.model, model)
        self.uses.copy_(torch.from_numpy(trainer["uses"]))
        if self.discriminator is not None:
            load_arrays(self.discriminator, under("discriminator/", trainer))
        for name, optimizer in self.optimizers.items():
            load_optimizer(optimizer, trainer, prefix=f"optimizer/{name}/")

    def close(self) -> None:
        """Nothing is read ahead."""


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
