"""A FrameEncoder that needs no training: block means as latents, repeated back to pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vilp_data import latent_runs, latents, staleness
from vilp_data.types import F16, U8

FACTOR = 8


class BlockMeans:
    """Latent (c, h, w) = mean of each 8x8 block, times `gain`. The gain stands for the weights."""

    def __init__(self, gain: float = 1.0, trained_on: frozenset[str] = frozenset()) -> None:
        self.gain = np.float32(gain)
        self.trained_on = trained_on

    @property
    def parallel(self) -> bool:
        return True

    @property
    def key(self) -> str:
        return f"gain{self.gain:g}"

    @property
    def key_fields(self) -> dict[str, str]:
        return {"weights": f"{self.gain:g}", "storage": "f16"}

    def latent_shape(self, height: int, width: int) -> tuple[int, int, int]:
        return 3, height // FACTOR, width // FACTOR

    def encode(self, frames: U8) -> F16:
        n, height, width, _ = frames.shape
        blocks = frames.reshape(n, height // FACTOR, FACTOR, width // FACTOR, FACTOR, 3).astype(np.float32)
        return (self.gain * blocks.mean(axis=(2, 4))).transpose(0, 3, 1, 2).astype(np.float16)

    def decode(self, latents: F16) -> U8:
        pixels = (latents.astype(np.float32) / self.gain).round().clip(0, 255).astype(np.uint8)
        return pixels.transpose(0, 2, 3, 1).repeat(FACTOR, axis=1).repeat(FACTOR, axis=2)


def install(encoder: BlockMeans) -> None:
    """Make every run's encoder this one, in this process. Tests undo it with `monkeypatch`; a process about to be killed need not."""
    for module in (latents, latent_runs, staleness):
        module.load_encoder = lambda name, run_dir, view: encoder  # type: ignore[attr-defined]
    latents._encoders.clear()


def encode_all(root: Path, *, workers: int = 1) -> latent_runs.EncodedDataset:
    """`latent_runs.encode_dataset` with the dataset's own spec."""
    from vilp_data.episodes import EpisodeStore

    return latent_runs.encode_dataset(
        root, EpisodeStore(root).spec(), "fake", root / "runs" / "fake-run", workers=workers
    )
