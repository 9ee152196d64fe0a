"""What a training run is made of: the tables under [models] of a task's TOML, validated and frozen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from vilp_data.errors import SpecError, UsageError, nearest
from vilp_data.spec import Frozen

Precision = Literal["f32", "bf16"]


class VqganRecipe(Frozen):
    """[models.vqgan]. The defaults are the paper's, for frames of any size that `downsampling` divides.

    Architecture
    width, multipliers  channels of level i are width * multipliers[i]; every level but the last halves the image, so
                        four levels downsample by 8 and three by 4
    blocks              residual blocks a level in the encoder (the decoder has one more)
    groups              of every GroupNorm; must divide the channels of every level
    latent_channels     channels of the latent, which is also the length of a code
    codes               size of the codebook
    share_views         one VQGAN for all views instead of one a view

    Losses, all on images in [-1, 1]
    perceptual          LPIPS backbone, "none" to leave LPIPS out
    perceptual_images   LPIPS sees this many images of each batch (all when None); the batch is already a random draw
    moving_weight       L1 weighs a moving pixel 1 + this, then the weights are normalised; 0 is the paper's plain mean.
                        Frames that are mostly background otherwise spend the whole loss on it
    discriminator_weight, discriminator_start
                        adaptive PatchGAN from this step on; weight 0 leaves it out

    Data and optimisation
    crop                side in pixels of the random square a frame is cut to in training, None for whole frames
    crop_moving         share of crops that are centred on a moving pixel; without `crop` it has no effect
    schedule            "constant" after the warm-up, or "cosine" down to zero at the last step
    codebook_start      steps before quantisation begins; the codebook is then fitted to the encoder's outputs
    restart_every       every so many steps codes unused since the last time are moved onto encoder outputs; 0 is never
    precision           of the training arithmetic (weights and optimiser stay float32)
    encode_precision    of the arithmetic behind stored latents: part of their key
    """

    width: int = Field(default=128, gt=0)
    multipliers: tuple[int, ...] = Field(default=(1, 1, 2, 4), min_length=2)
    blocks: int = Field(default=2, gt=0)
    groups: int = Field(default=32, gt=0)
    latent_channels: int = Field(default=3, gt=0)
    codes: int = Field(default=1024, gt=1)
    share_views: bool = False

    perceptual: Literal["none", "alex", "vgg"] = "vgg"
    perceptual_weight: float = Field(default=1.0, ge=0)
    perceptual_images: int | None = Field(default=None, gt=0)
    moving_weight: float = Field(default=0.0, ge=0)
    codebook_weight: float = Field(default=1.0, ge=0)
    commitment: float = Field(default=0.25, ge=0)
    discriminator_weight: float = Field(default=0.8, ge=0)
    discriminator_start: int = Field(default=50_000, ge=0)

    crop: int | None = Field(default=None, gt=0)
    crop_moving: float = Field(default=0.5, ge=0, le=1)
    steps: int = Field(default=200_000, gt=0)
    batch_size: int = Field(default=64, gt=0)
    learning_rate: float = Field(default=3.6e-5, gt=0)
    betas: tuple[float, float] = (0.5, 0.9)
    warmup_steps: int = Field(default=0, ge=0)
    schedule: Literal["constant", "cosine"] = "constant"
    clip_norm: float | None = Field(default=None, gt=0)
    codebook_start: int = Field(default=0, ge=0)
    restart_every: int = Field(default=200, ge=0)
    precision: Precision = "f32"
    encode_precision: Precision = "f32"
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _values_fit(self) -> Self:
        bad = [c for c in self.channels if c % self.groups]
        if bad:
            raise ValueError(
                f"groups = {self.groups} must divide the channels of every level (width x multipliers): {self.channels}"
            )
        if self.crop is not None and self.crop % self.downsampling:
            raise ValueError(f"crop = {self.crop} must be a multiple of the downsampling, {self.downsampling}")
        if self.codebook_start >= self.steps:
            raise ValueError(f"codebook_start = {self.codebook_start} must be less than steps = {self.steps}")
        return self

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of every level, finest first."""
        return tuple(self.width * m for m in self.multipliers)

    @property
    def downsampling(self) -> int:
        """Image pixels a latent pixel covers in each direction (paper f)."""
        return 1 << (len(self.multipliers) - 1)


# What small machines change: no discriminator (which needs far more steps), a narrower network for all views at once, crops
# around what moves, and a learning rate for few steps.
_SMALL: Mapping[str, Any] = {
    "share_views": True,
    "width": 16,
    "blocks": 1,
    "groups": 8,
    "perceptual": "alex",
    "moving_weight": 4.0,
    "discriminator_weight": 0.0,
    "crop_moving": 0.7,
    "betas": (0.9, 0.99),
    "schedule": "cosine",
    "clip_norm": 1.0,
}

VQGAN_PRESETS: Mapping[str, Mapping[str, Any]] = {
    "tiny": {  # seconds: every stage runs, nothing is learnt well
        **_SMALL,
        "multipliers": (1, 1, 2, 2),
        "codes": 256,
        "crop": 32,
        "steps": 60,
        "batch_size": 16,
        "learning_rate": 3e-3,
        "warmup_steps": 10,
        "codebook_start": 20,
        "restart_every": 20,
    },
    "cpu": {  # two cores, about twenty minutes
        **_SMALL,
        "multipliers": (1, 2, 4, 4),
        "crop": 48,
        "steps": 4000,
        "batch_size": 32,
        "learning_rate": 2e-3,
        "warmup_steps": 50,
        "codebook_start": 500,
        "restart_every": 50,
        "precision": "bf16",
    },
    "paper": {},
}
"""What each preset changes in the paper's recipe, for every task. A task's own [models.vqgan], its preset's table included,
comes on top."""


def vqgan_recipe(models: Mapping[str, Mapping[str, Any]], *, preset: str | None, where: str) -> VqganRecipe:
    """The preset's recipe (the paper's for None) with the keys of `models["vqgan"]` (`TaskSpec.models`) on top.

    Raises UsageError for an unknown preset, SpecError that names `where`, the key and the nearest known one.
    """
    if preset is not None and preset not in VQGAN_PRESETS:
        raise UsageError(f"unknown preset {preset!r}", where=where, remedy=nearest(preset, VQGAN_PRESETS))
    table = {**VQGAN_PRESETS[preset or "paper"], **models.get("vqgan", {})}
    unknown = [key for key in table if key not in VqganRecipe.model_fields]
    if unknown:
        raise SpecError(
            f"unknown key models.vqgan.{unknown[0]}", where=where, remedy=nearest(unknown[0], VqganRecipe.model_fields)
        )
    try:
        return VqganRecipe.model_validate(table)
    except ValidationError as error:
        found = "\n          ".join(
            f"{'.'.join(map(str, item['loc'])) or 'together'}: {item['msg']}" for item in error.errors()
        )
        raise SpecError(
            "[models.vqgan] cannot be used", where=where, found=found, remedy="correct these values"
        ) from error
