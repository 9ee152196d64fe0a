"""What a training run is made of: the tables under [models] of a task's TOML, validated and frozen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self, TypeVar

from pydantic import Field, ValidationError, model_validator

from vilp_data.errors import SpecError, UsageError, nearest
from vilp_data.spec import Frozen

Precision = Literal["f32", "bf16"]


class VqganRecipe(Frozen):
    """[models.vqgan]. The defaults are the paper's, for frames of any size that `downsampling` divides. Its weights are not averaged
    over time: those that others load are the last step's.

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
        _require_warm(self.warmup_steps, self.steps)
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


class TrainingRecipe(Frozen):
    """What every model that AdamW trains has in common.

    schedule      linear warm-up, then "constant", or "cosine" down to zero at the last step
    ema_power, ema_max
                  the weights that others load are an average: decay 1 - (1 + step)^-ema_power, at most ema_max; 0 leaves
                  averaging out
    precision     of the training arithmetic (weights and optimiser stay float32)
    """

    steps: int = Field(gt=0)
    batch_size: int = Field(gt=0)
    learning_rate: float = Field(default=1e-4, gt=0)
    betas: tuple[float, float] = (0.95, 0.999)
    weight_decay: float = Field(default=1e-6, ge=0)
    warmup_steps: int = Field(default=500, ge=0)
    schedule: Literal["constant", "cosine"] = "cosine"
    clip_norm: float | None = Field(default=1.0, gt=0)
    ema_power: float = Field(default=0.75, ge=0)
    ema_max: float = Field(default=0.9999, ge=0, lt=1)
    precision: Precision = "f32"
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _warm_in_time(self) -> Self:
        _require_warm(self.warmup_steps, self.steps)
        return self


def _require_warm(warmup_steps: int, steps: int) -> None:
    if warmup_steps > steps:
        raise ValueError(f"warmup_steps = {warmup_steps} must be at most steps = {steps}")


Condition = Literal["token", "tokens", "concat", "token+concat", "tokens+concat"]


class PlannerRecipe(TrainingRecipe):
    """[models.planner]: the latent video planner of each view. The defaults are the paper's.

    Architecture
    width, multipliers  channels of level i are width * multipliers[i]; every level but the last halves height and width, never time
    blocks              residual blocks a level on the way down; one more on the way up
    convolutions        "full" 3x3x3, or "factorised": 1x3x3 then 3x1x1
    groups, head_size   of every GroupNorm; of every attention head
    condition           how the present reaches the network (see `planner`): "token" is the paper's one pooled vector of all views and
                        low_dim, "tokens" a grid of vectors a view, "concat" the present frames' latents beside the noisy ones
    vision_width        channels of the first level of the ResNet that sees the frames
    low_dim             whether low_dim is part of the condition; long videos need a planner without
    clip                frames in the network: "future" has the N planned ones t+Δt … t+NΔt alone (the paper's), "present" N+1, of
                        which the first is the frame at t, known (as the release's); planned are the same N

    Diffusion
    train_steps         levels of noise in training, and the most denoising steps that can be asked for. Few levels learn faster:
                        those that the sampler does not visit teach it nothing
    prediction          "v" with zero terminal SNR, or "epsilon"
    spacing             of the sampler's steps: "trailing" begins at pure noise, "leading" as the release does. epsilon needs "leading"
    sampler, denoising_steps
                        "ddim" (eta 0) or "dpm++" (diffusers' second-order multistep solver), and how many steps, unless told otherwise
    """

    width: int = Field(default=64, gt=0)
    multipliers: tuple[int, ...] = Field(default=(1, 2, 4), min_length=1)
    blocks: int = Field(default=2, gt=0)
    convolutions: Literal["full", "factorised"] = "full"
    groups: int = Field(default=32, gt=0)
    head_size: int = Field(default=8, gt=0)
    condition: Condition = "token"
    vision_width: int = Field(default=64, gt=0)
    low_dim: bool = True
    clip: Literal["future", "present"] = "future"

    train_steps: int = Field(default=300, gt=1)
    prediction: Literal["v", "epsilon"] = "v"
    spacing: Literal["trailing", "leading"] = "trailing"
    sampler: Literal["ddim", "dpm++"] = "ddim"
    denoising_steps: int = Field(default=4, gt=0)

    steps: int = Field(default=300_000, gt=0)
    batch_size: int = Field(default=64, gt=0)

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of every level, finest first."""
        return tuple(self.width * m for m in self.multipliers)

    @model_validator(mode="after")
    def _values_fit(self) -> Self:
        bad = [c for c in self.channels if c % self.groups or c % self.head_size]
        if bad:
            raise ValueError(
                f"groups = {self.groups} and head_size = {self.head_size} must divide the channels of every level "
                f"(width x multipliers): {self.channels}"
            )
        if self.prediction == "epsilon" and self.spacing == "trailing":
            raise ValueError(
                'prediction = "epsilon" cannot begin at pure noise, where it is multiplied without bound: spacing = "leading", '
                'or prediction = "v"'
            )
        if self.denoising_steps > self.train_steps:
            raise ValueError(f"denoising_steps = {self.denoising_steps} is more than train_steps = {self.train_steps}")
        if self.condition == "concat" and self.low_dim:
            raise ValueError('condition = "concat" has no place for low_dim: low_dim = false, or "token+concat"')
        return self


Pool = Literal["average", "keypoints"]


class PolicyRecipe(TrainingRecipe):
    """[models.policy]: the low-level policy, two adjacent frames to the actions between. The defaults are the paper's.

    sees                 "frames", or "latents": quantised ones, which skips the decoder when imagined frames are acted on
    vision_width         channels of the first level of each view's ResNet
    pool                 "average" over the image, or "keypoints": the expected position of each channel (spatial softmax)
    shared_vision        one ResNet for both frames, or one each
    hidden               widths of the MLP
    low_dim              whether low_dim at the first frame is seen too
    reconstructed_share  share of second frames that are replaced by the VQGAN's reconstruction, as imagined ones will be
    """

    sees: Literal["frames", "latents"] = "frames"
    vision_width: int = Field(default=64, gt=0)
    pool: Pool = "average"
    shared_vision: bool = True
    hidden: tuple[int, ...] = (256, 256)
    low_dim: bool = False
    reconstructed_share: float = Field(default=0.0, ge=0, le=1)

    steps: int = Field(default=100_000, gt=0)
    batch_size: int = Field(default=256, gt=0)

    @model_validator(mode="after")
    def _values_fit(self) -> Self:
        if self.sees == "latents" and self.reconstructed_share:
            raise ValueError('latents are the VQGAN\'s already: reconstructed_share must be 0 where sees = "latents"')
        return self


class BcRecipe(TrainingRecipe):
    """[models.bc]: behaviour cloning, one observation to the same chunk of actions that VILP executes. A baseline.

    n_action_steps is VILP's ([models.vilp]); the other keys are as in [models.policy].
    """

    vision_width: int = Field(default=64, gt=0)
    pool: Pool = "average"
    hidden: tuple[int, ...] = (256, 256)
    low_dim: bool = True

    steps: int = Field(default=100_000, gt=0)
    batch_size: int = Field(default=256, gt=0)


class VilpRecipe(Frozen):
    """[models.vilp]: how the policy acts; nothing here is trained.

    n_action_steps  (paper N_e) actions executed before planning again
    """

    n_action_steps: int = Field(default=8, gt=0)


_ADAM_SMALL: Mapping[str, Any] = {"learning_rate": 1e-3, "betas": (0.9, 0.99), "weight_decay": 1e-4, "ema_max": 0.999}

PRESETS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "vqgan": VQGAN_PRESETS,
    "planner": {
        "tiny": {
            **_ADAM_SMALL, "width": 16, "multipliers": (1, 2), "blocks": 1, "groups": 8, "convolutions": "factorised",
            "condition": "token+concat", "vision_width": 8, "steps": 12, "batch_size": 4, "warmup_steps": 2,
        },
        "cpu": {
            **_ADAM_SMALL, "width": 32, "blocks": 1, "groups": 16, "head_size": 32, "condition": "concat", "low_dim": False,
            "train_steps": 4, "steps": 12_000, "batch_size": 32, "warmup_steps": 100, "precision": "bf16",
        },
        "paper": {},
    },
    "policy": {
        "tiny": {**_ADAM_SMALL, "vision_width": 8, "pool": "keypoints", "hidden": (64,), "steps": 12, "batch_size": 8, "warmup_steps": 2},
        "cpu": {
            **_ADAM_SMALL, "vision_width": 16, "pool": "keypoints", "reconstructed_share": 0.5,
            "steps": 3000, "batch_size": 64, "warmup_steps": 100, "precision": "bf16",
        },
        "paper": {},
    },
    "bc": {
        "tiny": {**_ADAM_SMALL, "vision_width": 8, "pool": "keypoints", "hidden": (64,), "steps": 12, "batch_size": 8, "warmup_steps": 2},
        "cpu": {
            **_ADAM_SMALL, "vision_width": 16, "pool": "keypoints", "low_dim": False,
            "steps": 12_000, "batch_size": 64, "warmup_steps": 100, "precision": "bf16",
        },
        "paper": {},
    },
    "vilp": {"tiny": {}, "cpu": {}, "paper": {}},
}  # fmt: skip
"""model -> preset -> what it changes in that model's recipe (the paper's), for every task."""

AnyRecipe = TypeVar("AnyRecipe", bound=Frozen)


def load_recipe(
    kind: type[AnyRecipe], name: str, models: Mapping[str, Mapping[str, Any]], *, preset: str | None, where: str
) -> AnyRecipe:
    """The recipe of model `name` ("planner", "policy", …): the preset's (the paper's for None) with the keys of
    `models[name]` (`TaskSpec.models`) on top.

    Raises UsageError for an unknown preset, SpecError that names `where`, the key and the nearest known one.
    """
    presets = PRESETS[name]
    if preset is not None and preset not in presets:
        raise UsageError(f"unknown preset {preset!r}", where=where, remedy=nearest(preset, presets))
    table = {**presets[preset or "paper"], **models.get(name, {})}
    unknown = [key for key in table if key not in kind.model_fields]
    if unknown:
        raise SpecError(
            f"unknown key models.{name}.{unknown[0]}", where=where, remedy=nearest(unknown[0], kind.model_fields)
        )
    try:
        return kind.model_validate(table)
    except ValidationError as error:
        found = "\n          ".join(
            f"{'.'.join(map(str, item['loc'])) or 'together'}: {item['msg']}" for item in error.errors()
        )
        raise SpecError(
            f"[models.{name}] cannot be used", where=where, found=found, remedy="correct these values"
        ) from error


def vqgan_recipe(models: Mapping[str, Mapping[str, Any]], *, preset: str | None, where: str) -> VqganRecipe:
    """`load_recipe` for the VQGAN."""
    return load_recipe(VqganRecipe, "vqgan", models, preset=preset, where=where)
