"""Episodes as film strips: a few small frames of each view, evenly along the steps that may be used, as JPEG for a page.

A strip is made as large as the page can bear: `fitting_strip` tries a few frames and takes the first form whose bytes fit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vilp_data import geometry
from vilp_data.contact_sheet import jpeg_uri
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import VilpDataError
from vilp_data.types import U8

PAGE_BYTES = 16 << 20
"""Of all pictures of a page together, as text: what a phone still opens."""

SAMPLED = 12
"""Episodes by which the bytes of a strip are estimated."""


@dataclass(frozen=True)
class StripForm:
    """How an episode is shown: so many frames of each view, at most so many rows, at this JPEG quality. Frames are never enlarged."""

    n_frames: int
    rows: int
    quality: int


FORMS = (
    StripForm(12, 192, 80),
    StripForm(9, 128, 78),
    StripForm(9, 96, 74),
    StripForm(7, 96, 70),
    StripForm(5, 80, 66),
    StripForm(3, 72, 60),
    StripForm(3, 48, 55),
)
"""Largest first; the last is taken where none fits. All odd or long: the middle frame is among them."""


@dataclass(frozen=True)
class StripFrame:
    """One picture of a strip: its step, when that is (s from the first step), its size in pixels, and it as a `data:` address."""

    step: int
    at_s: float
    width: int
    height: int
    uri: str


def fitting_strip(store: EpisodeStore, entries: Sequence[EpisodeEntry], *, page_bytes: int = PAGE_BYTES) -> StripForm:
    """The largest form by which all episodes stay within `page_bytes`, estimated over a few of them; the smallest where none does."""
    chosen = [entries[i] for i in sorted(set(np.linspace(0, len(entries) - 1, SAMPLED).round().astype(int).tolist()))]
    for form in FORMS[:-1]:
        each = [_bytes(store, entry, form) for entry in chosen]
        if sum(each) / len(each) * len(entries) <= page_bytes:
            return form
    return FORMS[-1]


def film_strip(store: EpisodeStore, entry: EpisodeEntry, view: str, form: StripForm) -> Iterator[StripFrame]:
    """The frames of one view. StoreError where its files are missing, cut off or foreign; bytes are not checksummed."""
    arrays, frames = open_steps(store, entry, [view]), open_frames(store, entry, view)
    at_ns = arrays["log_time_ns"]
    usable = np.flatnonzero(arrays["valid"])
    if not usable.size or not len(frames):
        return
    for step in dict.fromkeys(usable[np.linspace(0, usable.size - 1, form.n_frames).round().astype(int)].tolist()):
        small = _small(frames[arrays[f"source_index/{view}"][step]], form.rows)
        uri = jpeg_uri(small, quality=form.quality)
        yield StripFrame(step, float(at_ns[step] - at_ns[0]) / 1e9, small.shape[1], small.shape[0], uri)


def _bytes(store: EpisodeStore, entry: EpisodeEntry, form: StripForm) -> int:
    """Of all views of an episode; none for one that cannot be read."""
    try:
        return sum(len(frame.uri) for view in entry.frames_sha256 for frame in film_strip(store, entry, view, form))
    except VilpDataError:
        return 0


def _small(frame: U8, rows: int) -> U8:
    """At most `rows` high and twice as wide, uint8 [h,w,C]."""
    height, width = frame.shape[:2]
    scale = min(rows / height, 2 * rows / width, 1.0)
    small = geometry.fit_image(
        np.ascontiguousarray(frame), max(round(height * scale), 1), max(round(width * scale), 1), "stretch"
    )
    return small if small.ndim == 3 else small[..., None]
