"""LPIPS v0.1: a perceptual distance between images (Zhang et al. 2018, arXiv:1801.03924).

Shape suffixes: B batch, C channels, H height, W width.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vilp_models.lpips_weights import LpipsNetwork, lpips_weights

# (out channels, kernel, stride, padding) of a convolution, or (size, stride) of a max pooling; "tap" ends a stage whose
# features are compared.
_Layer = tuple[int, int, int, int] | tuple[int, int] | Literal["tap"]
_ALEX: tuple[_Layer, ...] = (
    (64, 11, 4, 2), "tap", (3, 2), (192, 5, 1, 2), "tap", (3, 2), (384, 3, 1, 1), "tap",
    (256, 3, 1, 1), "tap", (256, 3, 1, 1), "tap",
)  # fmt: skip
_VGG: tuple[_Layer, ...] = (
    (64, 3, 1, 1), (64, 3, 1, 1), "tap", (2, 2), (128, 3, 1, 1), (128, 3, 1, 1), "tap",
    (2, 2), (256, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1), "tap",
    (2, 2), (512, 3, 1, 1), (512, 3, 1, 1), (512, 3, 1, 1), "tap",
    (2, 2), (512, 3, 1, 1), (512, 3, 1, 1), (512, 3, 1, 1), "tap",
)  # fmt: skip
_LAYERS: dict[LpipsNetwork, tuple[_Layer, ...]] = {"alex": _ALEX, "vgg": _VGG}
MIN_SIDE: dict[LpipsNetwork, int] = {"alex": 31, "vgg": 16}
"""Smallest image side each backbone can take."""


class Lpips(nn.Module):
    """Distance d [B] >= 0 between two batches [B,3,H,W] of RGB images in [-1, 1], or [B,1,H,W] of grey ones; 0 for equal images.

    The weights are frozen; gradients flow to both images. Fill them with `load_lpips`.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, network: LpipsNetwork) -> None:
        super().__init__()
        self.layers = _LAYERS[network]
        self.convs, self.heads = nn.ModuleList(), nn.ModuleList()
        channels = 3
        for layer in self.layers:
            if layer == "tap":
                self.heads.append(nn.Conv2d(channels, 1, 1, bias=False))
            elif len(layer) == 4:
                out, kernel, stride, padding = layer
                self.convs.append(nn.Conv2d(channels, out, kernel, stride, padding))
                channels = out
        # The ImageNet normalisation of [0, 1] images, rewritten for [-1, 1].
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None], persistent=False)
        self.requires_grad_(False)
        self.eval()

    def forward(self, a_BCHW: Tensor, b_BCHW: Tensor) -> Tensor:
        distance = torch.zeros(len(a_BCHW), device=a_BCHW.device)
        for head, a, b in zip(self.heads, self.features(a_BCHW), self.features(b_BCHW), strict=True):
            distance = distance + head((_unit(a) - _unit(b)).square()).float().mean(dim=(1, 2, 3))
        return distance

    def features(self, x_BCHW: Tensor) -> list[Tensor]:
        """Activations after the last ReLU of every stage, finest first."""
        x = (x_BCHW - self.shift) / self.scale  # one channel is taken as grey: the constants have three
        taps, convs = [], iter(self.convs)
        for layer in self.layers:
            if layer == "tap":
                taps.append(x)
            elif len(layer) == 4:
                x = F.relu(next(convs)(x))
            else:
                x = F.max_pool2d(x, kernel_size=layer[0], stride=layer[1])
        return taps


def _unit(x_BCHW: Tensor) -> Tensor:
    """Every pixel's feature vector scaled to length one; the small sum keeps the root's gradient finite at zero."""
    return x_BCHW / (x_BCHW.square().sum(dim=1, keepdim=True) + 1e-20).sqrt().add(1e-10)


def load_lpips(network: LpipsNetwork) -> Lpips:
    """LPIPS with its published weights. Raises WeightsError where they are not installed."""
    model = Lpips(network)
    model.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in lpips_weights(network).items()})
    return model
