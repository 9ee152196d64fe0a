"""RVL, a lossless code for depth images (Wilson 2017, "Fast Lossless Depth Image Compression"). Pure.

The code is a stream of numbers, each in nibbles of three bits of value and one that says "more follows", least significant first.
Nibbles lie in little-endian words of 32 bits, the highest first. The numbers are, over and over: how many pixels are zero, how many
are not, and for each of those its difference from the one before (zeros apart), the sign in the lowest bit.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def unpack_rvl(data: bytes, count: int) -> npt.NDArray[np.uint16]:
    """The `count` pixels of a code, uint16 [count]. Raises ValueError where it ends too early or does not fit them."""
    numbers = _numbers(data)
    pixels = np.zeros(count, np.uint16)
    place = at = last = 0
    while at < count:
        if place + 2 > len(numbers):
            raise ValueError(f"it ends after {at} of {count} pixels")
        zeros, others = int(numbers[place]), int(numbers[place + 1])
        at, place = at + zeros, place + 2
        if (zeros == others == 0) or at + others > count or place + others > len(numbers):
            raise ValueError(f"a run past its end, at pixel {at} of {count}")
        coded = numbers[place : place + others]
        values = last + np.cumsum((coded >> 1) ^ -(coded & 1))
        pixels[at : at + others] = values & 0xFFFF
        last = int(values[-1]) if others else last
        at, place = at + others, place + others
    return pixels


def _numbers(data: bytes) -> npt.NDArray[np.int64]:
    words = np.frombuffer(data, "<u4", len(data) // 4)
    nibbles = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)).ravel().astype(np.int64) & 0xF
    last = np.flatnonzero(nibbles < 8)  # the last nibble of each number
    if not len(last):
        return np.empty(0, np.int64)
    first = np.concatenate([[0], last[:-1] + 1])
    used = nibbles[: last[-1] + 1] & 7
    lengths = last - first + 1
    place = np.arange(len(used)) - np.repeat(first, lengths)
    # Longer numbers are only met in damaged data, or as the length of a run: 10 nibbles hold any that an image can have.
    return np.add.reduceat(used << np.minimum(3 * place, 60), first)
