"""Reconstructions of stored latents, each made once where the processor makes them.

A low-level policy learns from the same few thousand second frames again and again, and on a CPU decoding them costs four times what the
policy's own step does.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from vilp_models.vqgan import VqganEncoder

KEPT_BYTES = 2**30
"""Of images: 23,000 of 96 x 160."""


class Reconstructions:
    """What each view's VQGAN makes of latents, in float32, as imagined frames are decoded in use.

    On a CPU every image is decoded by itself, so that it does not depend on its batch, and kept while there is room for it, the oldest
    giving way. On a GPU a batch is decoded as it comes: to ask what is known already would wait for the device.
    """

    def __init__(self, encoders: Mapping[str, VqganEncoder], *, kept_bytes: int = KEPT_BYTES) -> None:
        self._encoders, self._kept_bytes = encoders, kept_bytes
        self._known: dict[tuple[str, bytes], Tensor] = {}
        self._bytes = 0

    def __call__(self, view: str, latents: Tensor) -> Tensor:
        """Latents [B,c,h,w] before quantisation to images uint8 [B,H,W,3], on the latents' device."""
        if self._encoders[view].device.type != "cpu":
            return self._decoded(view, latents)
        return torch.stack([self._once(view, one) for one in latents.cpu()]).to(latents.device)

    def _once(self, view: str, latent: Tensor) -> Tensor:
        key = view, latent.numpy().tobytes()
        if (image := self._known.get(key)) is None:
            image = self._known[key] = self._decoded(view, latent[None])[0]
            self._bytes += image.nbytes
            while self._bytes > self._kept_bytes:
                self._bytes -= self._known.pop(next(iter(self._known))).nbytes
        return image

    def _decoded(self, view: str, latents: Tensor) -> Tensor:
        encoder = self._encoders[view]
        with torch.autocast(encoder.device.type, enabled=False):
            return encoder.decode_tensor(latents.to(encoder.device)).to(latents.device)
