"""An export that was read back, against the stored episodes: how far frames are off, and what is said of one that came out different."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vilp_data.errors import StoreError
from vilp_data.types import F32, U8


def came_out_wrong(what: str, where: object, *, found: object = None) -> StoreError:
    """Of an export: `what` is wrong with it, though the dataset is as it was."""
    return StoreError(what, where=where, found=found, remedy="please report this; the dataset itself is untouched")


@dataclass
class FrameErrors:
    """Squared errors of frames that were read back, and whether row k really holds frame k.

    A codec smears, so one frame may look more like its neighbour; over an episode, the frames must be nearest to their own."""

    squared: float = 0.0
    n_values: int = 0
    worst: float = 0.0
    _own: float = 0.0
    _shifted: tuple[float, float] = (0.0, 0.0)

    def add(self, found: U8, before: U8 | None, stored: U8, after: U8 | None) -> None:
        """One frame against the stored one, and those that the rows before and after it show (None at the ends)."""
        error = _squared_error(found, stored)
        self.squared += error
        self.n_values += found.size
        self.worst = max(self.worst, error / found.size)
        earlier = _squared_error(found, before) if before is not None and error else error
        later = _squared_error(found, after) if after is not None and error else error
        self._own += error
        self._shifted = self._shifted[0] + earlier, self._shifted[1] + later

    def end_episode(self) -> bool:
        """Whether the episode's frames are nearest to their own rows; the next episode begins."""
        right = self._own <= min(self._shifted)
        self._own, self._shifted = 0.0, (0.0, 0.0)
        return right

    def psnr_db(self) -> tuple[float | None, float | None]:
        """Of all pixels, and of the worst frame; None where there was no error."""
        if not self.squared:
            return None, None
        return _psnr(self.squared / self.n_values), _psnr(self.worst)


def _squared_error(one: U8, other: U8) -> float:
    difference: F32 = one.astype(np.float32) - other
    return float(np.square(difference, out=difference).sum(dtype=np.float64))


def _psnr(mean_squared: float) -> float:
    return round(float(10 * np.log10(255.0**2 / mean_squared)), 2)
