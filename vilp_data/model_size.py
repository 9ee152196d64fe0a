"""The size to store a camera's images at so that the models take them. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

TALL, WIDE = (64, 96, 128, 160), (64, 96, 128, 160, 192, 224)
"""Sides are multiples of 32: the encoder's downsampling by 8, times the two halvings of the planner."""

USUAL_AREA = 96 * 128
AREA_WEIGHT = 0.1  # of doubling or halving the usual area, against the share of the image that is cut off

KEEPS_ASPECT = 0.01
"""What `geometry.fit_image` lets pass without a word."""


@dataclass(frozen=True)
class ModelSize:
    """`cut`: the share of the image that a crop to this size loses; 0 where the aspect ratio stays."""

    height: int
    width: int
    cut: float


def model_size(height: int, width: int) -> ModelSize:
    """The size near 96x128 that comes nearest the aspect ratio of images of `height` x `width` pixels."""
    return min((_size(h, w, height, width) for h in TALL for w in WIDE), key=_cost)


def common_size(images: list[tuple[int, int]]) -> ModelSize:
    """One size for several cameras, since models put their latents side by side: the one that costs them least together; `cut` is
    that of the camera that loses most."""
    candidates = [[_size(h, w, *image) for image in images] for h in TALL for w in WIDE]
    best = min(
        candidates,
        key=lambda sizes: (round(sum(_cost(size)[0] for size in sizes), 6), sizes[0].height * sizes[0].width),
    )
    return max(best, key=lambda size: size.cut)


def cut_share(height: int, width: int, image_height: int, image_width: int) -> float:
    """The share of an image that is lost when it is cropped to the aspect ratio of `height` x `width`."""
    ratio = (width / height) / (image_width / image_height)
    cut = 1 - min(ratio, 1 / ratio)
    return 0.0 if abs(ratio - 1) <= KEEPS_ASPECT else cut


def _size(height: int, width: int, image_height: int, image_width: int) -> ModelSize:
    return ModelSize(height, width, cut_share(height, width, image_height, image_width))


def _cost(size: ModelSize) -> tuple[float, int]:
    area = size.height * size.width / USUAL_AREA
    return round(size.cut + AREA_WEIGHT * abs(math.log2(area)), 6), size.height * size.width
