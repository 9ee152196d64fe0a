"""ResNet-18 over camera images or latents (He et al. 2016), without batch statistics and without pretraining.

Shape suffixes: B batch, C channels, H height, W width, h and w of the last map, K keypoints, F features.

Two things may be read off the last map. "average" is the paper's: the mean over the image, 8 * width features. It says
what is there; where, only as far as the borders' zero padding tells. "keypoints" is the spatial softmax of Levine et al. (2016): K
maps of attention, each of which gives the position it expects, so 2 K features in [-1, 1]. It says where, and a policy that must
give a position off an image needs fewer steps with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vilp_models.recipe import Pool

_CHANNELS_A_GROUP = 16
_KEYPOINTS_A_CHANNEL = 2  # K = 2 * width, 32 for the narrowest sensible network


class ResNet18(nn.Module):
    """float [B,C,H,W], normalised by the caller (images by `vqgan.to_signed`), to float [B,F] with F = `features`.

    Four stages of two basic blocks with width, 2, 4 and 8 times width channels, behind the stem of images: 7x7 of stride 2,
    then max pooling of stride 2. With "average" three stages halve again, so that a cell of the last map covers 32 pixels. With
    "keypoints" the last stage does not: cells of 16 pixels, 6x6 of them at 96x96, between which the softmax interpolates.
    `latents=True` is for input that a VQGAN made small already: a 3x3 stem of stride 1, and with "keypoints" one halving in all.
    """

    def __init__(
        self, width: int, in_channels: int = 3, pool: Pool = "average", grid: bool = False, *, latents: bool = False
    ) -> None:
        """`grid=True` leaves pooling out: `forward` gives the last map's cells row by row, [B,h*w,F] with F = `channels`."""
        super().__init__()
        self.channels = 8 * width
        self.stem = _latent_stem(in_channels, width) if latents else _image_stem(in_channels, width)
        strides = (1, 2, 2, 2) if pool == "average" else (1, 2, 1, 1) if latents else (1, 2, 2, 1)
        self.stages = _stages(width, strides)
        self.pool: nn.Module
        if grid:
            self.pool, self.features = _Cells(), self.channels
        elif pool == "average":
            self.pool, self.features = _Average(), self.channels
        else:
            n_keypoints = _KEYPOINTS_A_CHANNEL * width
            self.pool, self.features = Keypoints(self.channels, n_keypoints), 2 * n_keypoints

    def forward(self, x_BCHW: Tensor) -> Tensor:
        features: Tensor = self.pool(self.map(x_BCHW))
        return features

    def map(self, x_BCHW: Tensor) -> Tensor:
        """The last map, float [B,`channels`,h,w]."""
        last: Tensor = self.stages(self.stem(x_BCHW))
        return last


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut, which is a 1x1 convolution where the shape changes."""

    def __init__(self, in_channels: int, channels: int, *, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 3, stride, 1, bias=False)
        self.norm1 = group_norm(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.norm2 = group_norm(channels)
        self.shortcut: nn.Module = nn.Identity()
        if stride > 1 or in_channels != channels:
            self.shortcut = nn.Sequential(nn.Conv2d(in_channels, channels, 1, stride, bias=False), group_norm(channels))

    def forward(self, x_BCHW: Tensor) -> Tensor:
        h = F.relu(self.norm1(self.conv1(x_BCHW)))
        h = self.norm2(self.conv2(h))
        return F.relu(h + self.shortcut(x_BCHW))


class Keypoints(nn.Module):
    """Spatial softmax: float [B,C,h,w] to the expected positions of K keypoints, float [B,2K], x then y of each.

    Positions are in [-1, 1] from the centre of the first cell to that of the last, left to right and top to bottom."""

    def __init__(self, in_channels: int, n_keypoints: int) -> None:
        super().__init__()
        self.logits = nn.Conv2d(in_channels, n_keypoints, 1)

    def forward(self, x_BCHW: Tensor) -> Tensor:
        logits_BKhw = self.logits(x_BCHW).float()
        height, width = logits_BKhw.shape[-2:]
        attention_BKhw = logits_BKhw.flatten(2).softmax(dim=-1).view_as(logits_BKhw)
        x = (attention_BKhw.sum(dim=2) * _positions(width, logits_BKhw)).sum(dim=-1)
        y = (attention_BKhw.sum(dim=3) * _positions(height, logits_BKhw)).sum(dim=-1)
        return torch.stack([x, y], dim=-1).flatten(1)


class _Average(nn.Module):
    def forward(self, x_BCHW: Tensor) -> Tensor:
        return x_BCHW.mean(dim=(2, 3))


class _Cells(nn.Module):
    def forward(self, x_BCHW: Tensor) -> Tensor:
        return _cells(x_BCHW)


def group_norm(channels: int) -> nn.GroupNorm:
    """About 16 channels a group, as the paper's; the nearest number of groups below that divides the channels."""
    most = max(channels // _CHANNELS_A_GROUP, 1)
    return nn.GroupNorm(next(groups for groups in range(most, 0, -1) if channels % groups == 0), channels)


def _image_stem(in_channels: int, width: int) -> nn.Module:
    conv = nn.Conv2d(in_channels, width, 7, 2, 3, bias=False)
    return nn.Sequential(conv, group_norm(width), nn.ReLU(), nn.MaxPool2d(3, 2, 1))


def _latent_stem(in_channels: int, width: int) -> nn.Module:
    return nn.Sequential(nn.Conv2d(in_channels, width, 3, 1, 1, bias=False), group_norm(width), nn.ReLU())


def _stages(width: int, strides: Sequence[int]) -> nn.Sequential:
    blocks: list[nn.Module] = []
    before = width
    for level, stride in enumerate(strides):
        channels = width << level
        blocks += [BasicBlock(before, channels, stride=stride), BasicBlock(channels, channels, stride=1)]
        before = channels
    return nn.Sequential(*blocks)


def _cells(x_BCHW: Tensor) -> Tensor:
    return x_BCHW.flatten(2).transpose(1, 2)


def _positions(n: int, like: Tensor) -> Tensor:
    return torch.linspace(-1, 1, n, device=like.device, dtype=like.dtype)
