"""The VQGAN: frames to latents and back (Esser et al. 2021; the paper's section on the video planner, first stage).

The network is diffusers' `VQModel`. Shape suffixes: B batch, C channels, H height, W width; latents are [B,c,h,w] with
h = H / f and w = W / f, taken after `quant_conv` and before quantisation.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from diffusers import VQModel
from pydantic import ValidationError
from torch import Tensor

from vilp_data.errors import StoreError, UsageError
from vilp_data.keys import digest
from vilp_data.types import F16, F32, I64, U8
from vilp_models.checkpoint import model_tensors, read_recipe, read_state, run_for_view
from vilp_models.recipe import Precision, VqganRecipe

CPU_BATCH = 16
"""Frames decoded at a time on a CPU: what 200 at once write no longer fits its caches, and takes four times as long."""

LATENT_SCALING = 1.0
"""Latents are stored as the encoder gives them; whoever trains on them standardises with their statistics."""


def build_vqgan(recipe: VqganRecipe, *, image_channels: int = 3) -> VQModel:
    """An untrained VQGAN. Input and output are [B,C,H,W] in [-1, 1], C = `image_channels`: 3 for RGB, 1 for depth. H and W are
    multiples of `recipe.downsampling`."""
    levels = len(recipe.channels)
    model = VQModel(
        in_channels=image_channels,
        out_channels=image_channels,
        down_block_types=("DownEncoderBlock2D",) * levels,
        up_block_types=("UpDecoderBlock2D",) * levels,
        block_out_channels=recipe.channels,
        layers_per_block=recipe.blocks,
        latent_channels=recipe.latent_channels,
        num_vq_embeddings=recipe.codes,
        norm_num_groups=recipe.groups,
        scaling_factor=LATENT_SCALING,
    )
    # diffusers hard-wires the swapped weights of the first VQGAN release: commitment belongs on the encoder's term.
    model.quantize.legacy = False
    model.quantize.beta = recipe.commitment
    return model


def check_divisible(height: int, width: int, downsampling: int) -> None:
    """Raise UsageError where the network cannot halve such images as often as it must."""
    if height % downsampling or width % downsampling:
        raise UsageError(
            f"a VQGAN that downsamples by {downsampling} needs image sides that are multiples of it",
            found=f"{height}x{width}",
            remedy="change the view's height and width, or give models.vqgan.multipliers fewer levels",
        )


def to_signed(frames_BHWC: Tensor) -> Tensor:
    """uint8 [B,H,W,C] to float32 [B,C,H,W] in [-1, 1]."""
    return frames_BHWC.permute(0, 3, 1, 2).float() / 127.5 - 1.0


def to_frames(images_BCHW: Tensor) -> Tensor:
    """[-1, 1] back to uint8 [B,H,W,C], rounded and clipped; the inverse of `to_signed`."""
    return ((images_BCHW.float() + 1.0) * 127.5).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()


def nearest_codes(z_BCHW: Tensor, codebook_KC: Tensor) -> Tensor:
    """Index of the nearest code of every latent pixel: int64 [B,h,w]."""
    z = z_BCHW.permute(0, 2, 3, 1)
    return torch.cdist(z.flatten(0, 2).float(), codebook_KC.float()).argmin(dim=1).view(z.shape[:3])


class VqganEncoder:
    """A trained VQGAN behind vilp_data's `FrameEncoder` protocol. Frames are RGB, or the one channel of a depth view; top row first.

    On a CPU the bytes of latents depend on the batch size and on torch's thread count, which the caller keeps fixed.
    """

    def __init__(
        self,
        model: VQModel,
        *,
        precision: Precision = "f32",
        trained_on: Iterable[str] = (),
        device: str | torch.device = "cpu",
    ) -> None:
        self.device = torch.device(device)
        self.precision: Precision = precision
        self.trained_on = frozenset(trained_on)
        self.model = model.eval().requires_grad_(False).to(self.device, memory_format=torch.channels_last)
        self.downsampling = 2 ** (len(model.config.block_out_channels) - 1)

    @property
    def codes(self) -> int:
        """Size of the codebook."""
        return int(self.model.quantize.n_e)

    @property
    def image_channels(self) -> int:
        """Of the frames: 3 for RGB, 1 for depth."""
        return int(self.model.config.in_channels)

    @property
    def key(self) -> str:
        """16 hex digits: the digest of `key_fields`."""
        return digest(self.key_fields)[:16]

    def key_on(self, device: str) -> str:
        """The key of latents that the same network makes on another kind of device ("cpu", "cuda"): these differ in rounding."""
        return digest({**self.key_fields, "device": device})[:16]

    @property
    def key_fields(self) -> dict[str, str]:
        """All that decides the bytes of stored latents, and nothing else: decoder and codebook have no part in it.

        The architecture is named beside the weights, since equal tensors compute other things in another one (groups)."""
        config = self.model.config
        # Only where it is another number than it used to be: latents of pictures keep the keys that they have.
        depth = {} if self.image_channels == 3 else {"image_channels": str(self.image_channels)}
        return depth | {
            "weights": encoder_digest(self.model),
            "channels": "-".join(map(str, config.block_out_channels)),
            "blocks": str(config.layers_per_block),
            "groups": str(config.norm_num_groups),
            "scaling": str(LATENT_SCALING),
            "compute": self.precision,
            "storage": "f16",
            "device": self.device.type,
        }

    @property
    def parallel(self) -> bool:
        """Processes do not share an accelerator: each would hold a copy of the network, and they would wait for each other."""
        return self.device.type == "cpu"

    def latent_shape(self, height: int, width: int) -> tuple[int, int, int]:
        """(c, h, w) for frames of this size. Raises UsageError where the size does not divide."""
        check_divisible(height, width, self.downsampling)
        return self.model.config.latent_channels, height // self.downsampling, width // self.downsampling

    def encode(self, frames: U8) -> F16:
        """uint8 [B,H,W,C] to float16 [B,c,h,w], before quantisation."""
        return self.encode_f32(frames, precision=self.precision).astype(np.float16)

    def encode_f32(self, frames: U8, *, precision: Precision = "f32") -> F32:
        """As `encode`, before rounding to float16; computed in float32 unless told otherwise."""
        latents: F32 = self.encode_tensor(torch.tensor(frames, device=self.device), precision=precision).cpu().numpy()
        return latents

    @torch.inference_mode()
    def encode_tensor(self, frames_BHWC: Tensor, *, precision: Precision | None = None) -> Tensor:
        """uint8 [B,H,W,C] on the encoder's device to float32 [B,c,h,w] there, before quantisation and rounding."""
        self.latent_shape(*frames_BHWC.shape[1:3])
        if frames_BHWC.shape[3] != self.image_channels:
            found = f"frames of {frames_BHWC.shape[3]} channels, a VQGAN of {self.image_channels}"
            remedy = "train the view's VQGAN again: `vilp-models train vqgan --restart`"
            raise UsageError(
                "the view was given or lost its `depth` since this VQGAN was trained", found=found, remedy=remedy
            )
        x = to_signed(frames_BHWC).contiguous(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=(precision or self.precision) == "bf16"):
            z: Tensor = self.model.encode(x).latents
        return z.float().contiguous()

    @torch.inference_mode()
    def codes_of(self, latents: F16 | F32) -> I64:
        """[B,c,h,w] to the indices of the nearest codes, int64 [B,h,w]."""
        z = torch.tensor(latents, device=self.device).float()
        return nearest_codes(z, self.model.quantize.embedding.weight).cpu().numpy()

    def decode(self, latents: F16 | F32) -> U8:
        """[B,c,h,w] before quantisation to uint8 [B,H,W,C]: quantised, then decoded."""
        frames: U8 = self.decode_tensor(torch.tensor(latents, device=self.device)).cpu().numpy()
        return frames

    @torch.inference_mode()
    def decode_tensor(self, z_BCHW: Tensor) -> Tensor:
        """`decode` on the encoder's device: latents of any float type to uint8 [B,H,W,C]. Under autocast codes are still chosen in
        float32, whose digits the distances need."""
        with torch.autocast(self.device.type, enabled=False):
            z_q: Tensor = self.model.quantize(z_BCHW.float())[0]
        parts = torch.split(z_q, CPU_BATCH) if self.device.type == "cpu" else (z_q,)
        return torch.cat([to_frames(self.model.decode(part, force_not_quantize=True).sample) for part in parts])


def encoder_digest(model: VQModel) -> str:
    """SHA-256 over the tensors of the encoder and of quant_conv, by sorted name."""
    sha = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        if name.startswith(("encoder.", "quant_conv.")):
            array = tensor.detach().cpu().contiguous().numpy()
            sha.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
            sha.update(array.tobytes())
    return sha.hexdigest()


def load_vqgan(run: Path) -> tuple[VQModel, VqganRecipe]:
    """The trained network in one run's folder, and its recipe. Raises StoreError where it is missing or damaged, or was
    trained with keys or values of a recipe that are none today."""
    try:
        recipe = VqganRecipe.model_validate(read_recipe(run))
    except ValidationError as error:
        found = "; ".join(f"{'.'.join(map(str, item['loc'])) or 'together'}: {item['msg']}" for item in error.errors())
        remedy = "train it again with `vilp-models train vqgan --restart`"
        raise StoreError("a VQGAN's recipe that cannot be used today", where=run, found=found, remedy=remedy) from error
    tensors = model_tensors(run)
    model = build_vqgan(recipe, image_channels=int(tensors["encoder.conv_in.weight"].shape[1]))
    model.load_state_dict({name: torch.from_numpy(array) for name, array in tensors.items()})
    return model, recipe


def load_frame_encoder(run_dir: Path, view: str, *, device: str | torch.device | None = None) -> VqganEncoder:
    """The frame encoder of one view: what the entry-point group `vilp.frame_encoders` names.

    `run_dir` is what `train_vqgan` wrote; without a `device` it is an accelerator if there is one. Raises UsageError where no VQGAN
    there was trained on this view to its end, or the run is another model's, StoreError where the checkpoint is damaged.
    """
    run = run_for_view(run_dir, view)
    state = read_state(run)
    if state is not None and state.model != "vqgan":
        raise UsageError("not a vqgan", where=run, found=state.model, remedy="name the run of a vqgan")
    if state is not None and not state.finished:
        found, remedy = f"step {state.step} of {state.steps}", "run `vilp-models train vqgan` again: it goes on there"
        raise UsageError("this network's training is not finished", where=run, found=found, remedy=remedy)
    model, recipe = load_vqgan(run)
    return VqganEncoder(
        model,
        precision=recipe.encode_precision,
        trained_on=state.train_episodes.values() if state is not None else (),
        device=device or ("cuda" if torch.cuda.is_available() else "cpu"),
    )
