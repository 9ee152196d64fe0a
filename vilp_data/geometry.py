"""One way to bring an image to the size a model sees, for ingest and for policies alike. Pure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar

import cv2
import numpy as np

from vilp_data.errors import UsageError
from vilp_data.types import F32, U8

Fit = Literal["crop", "pad", "stretch"]
ASPECT_TOLERANCE = 0.01
"""Relative change of aspect ratio that passes without being stated: what rounding to whole pixels makes."""


Images = TypeVar("Images", U8, F32)
COVERED = 0.5
"""Share of a stored pixel's area that must hold readings, for it to hold one."""


def fit_image(image: U8, height: int, width: int, fit: Fit | None) -> U8:
    """Resize uint8 [h,w,C] to [height,width,C] with an area filter (linear where the image grows; where one side grows and the other
    shrinks, each by its own filter).

    fit "crop" cuts the longer side evenly, "pad" adds black evenly, "stretch" changes the aspect ratio. None keeps all of the
    image and raises UsageError where that would change the aspect ratio. An image of the right size is returned as it is."""
    return _fitted(image, height, width, fit, _resized, outside=0)


def fit_depth(metres: F32, height: int, width: int, fit: Fit | None) -> F32:
    """The same for readings, float32 [h,w] with NaN where there is none: each stored pixel is the mean of the readings in its area,
    and none where they cover less than half of it. A missing reading is never mixed into a distance, nor is "pad"'s border. Where
    a side grows, the nearest reading is taken."""
    return _fitted(metres, height, width, fit, _resized_readings, outside=np.nan)


def _fitted(
    image: Images,
    height: int,
    width: int,
    fit: Fit | None,
    resized: Callable[[Images, int, int], Images],
    outside: float,
) -> Images:
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    if fit is None and abs(w * height / (h * width) - 1) > ASPECT_TOLERANCE:
        raise UsageError(
            f"images of {w}x{h} do not fit {width}x{height} without a change of aspect ratio",
            remedy='state fit = "crop", "pad" or "stretch" for this view in the task TOML',
        )
    if fit == "crop":
        image = _cropped(image, height / width)
    elif fit == "pad":
        return _padded(image, height, width, resized, outside)
    return resized(image, height, width)


def _cropped(image: Images, aspect: float) -> Images:
    h, w = image.shape[:2]
    keep_h, keep_w = min(h, round(w * aspect)), min(w, round(h / aspect))
    top, left = (h - keep_h) // 2, (w - keep_w) // 2
    return image[top : top + keep_h, left : left + keep_w]


def _padded(
    image: Images, height: int, width: int, resized: Callable[[Images, int, int], Images], outside: float
) -> Images:
    h, w = image.shape[:2]
    scale = min(height / h, width / w)
    inner_h, inner_w = min(height, max(1, round(h * scale))), min(width, max(1, round(w * scale)))
    out = np.full((height, width, *image.shape[2:]), outside, image.dtype)
    top, left = (height - inner_h) // 2, (width - inner_w) // 2
    out[top : top + inner_h, left : left + inner_w] = resized(image, inner_h, inner_w)
    return out


def _resized(image: U8, height: int, width: int) -> U8:
    h, w = image.shape[:2]
    shrunk = cv2.resize(image, (min(w, width), min(h, height)), interpolation=cv2.INTER_AREA)
    out = cv2.resize(shrunk, (width, height), interpolation=cv2.INTER_LINEAR)  # a copy, where nothing grows
    return out.reshape(height, width, *image.shape[2:])  # type: ignore[return-value]


def _resized_readings(metres: F32, height: int, width: int) -> F32:
    h, w = metres.shape
    known, shrunk = ~np.isnan(metres), (min(w, width), min(h, height))
    share = cv2.resize(known.astype(np.float32), shrunk, interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.where(known, metres, np.float32(0)), shrunk, interpolation=cv2.INTER_AREA)
    enough = share >= COVERED
    out = np.where(enough, total / np.where(enough, share, 1), np.float32(np.nan))
    # The exact one takes the reading that the new pixel's centre lies in; the other leans to the left.
    return np.asarray(cv2.resize(out, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
