"""The table of Arrange-Blocks as its camera sees it from above.

A pixel takes the colour of what covers it, by as much as is covered: edges tell where a block is to a tenth of a pixel.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from vilp_data.sims.arrange_blocks_table import BLOCK_SIDE, PUSHER_RADIUS, WALL, WORLD
from vilp_data.types import F32, F64, U8

Colour = Literal["gray", "purple"]
RGB = tuple[int, int, int]
COLOURS: dict[str, RGB] = {"gray": (119, 136, 153), "purple": (147, 88, 172)}
BACKGROUND: RGB = (255, 255, 255)
BORDER: RGB = (211, 211, 211)
PUSHER: RGB = (65, 105, 225)


def draw_table(blocks: F64, pusher: F64, colour: Colour, *, width: int) -> U8:
    """uint8 [0.6 width, width, 3] RGB, top row first: blocks at [3,3] (x, y, angle), the pusher at [2], px and radians of the world."""
    pixel = WORLD[0] / width
    x = ((np.arange(width) + 0.5) * pixel).astype(np.float32)[None]
    y = ((np.arange(round(WORLD[1] / pixel)) + 0.5) * pixel).astype(np.float32)[:, None]
    picture = np.full((len(y), width, 3), BACKGROUND, np.float32)
    _paint(picture, np.minimum(np.minimum(x, WORLD[0] - x), np.minimum(y, WORLD[1] - y)) - WALL, pixel, BORDER)
    for block_x, block_y, angle in blocks.tolist():
        cos, sin = math.cos(angle), math.sin(angle)
        along, across = cos * (x - block_x) + sin * (y - block_y), cos * (y - block_y) - sin * (x - block_x)
        _paint(picture, np.maximum(abs(along), abs(across)) - BLOCK_SIDE / 2, pixel, COLOURS[colour])
    _paint(picture, np.hypot(x - float(pusher[0]), y - float(pusher[1])) - PUSHER_RADIUS, pixel, PUSHER)
    return np.asarray(np.rint(picture), np.uint8)


def _paint(picture: F32, outside: F32, pixel: float, colour: RGB) -> None:
    """Where `outside` [H,W], the distance from a shape's edge in px of the world, is negative; an edge is a pixel wide."""
    rows, columns = (np.flatnonzero((outside < pixel).any(axis=axis)) for axis in (1, 0))
    if len(rows) == 0:
        return
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    covered = np.clip(0.5 - outside[part] / pixel, 0, 1)[..., None]
    picture[part] += covered * (np.array(colour, np.float32) - picture[part])
