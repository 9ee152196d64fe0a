"""What a few images a second tell of a camera: black, blank or frozen. Pure."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from vilp_data import geometry
from vilp_data.check.findings import Finding, Place, Severity
from vilp_data.duplicates import THUMBNAIL_SIZE
from vilp_data.types import F32, F64, U8, Bool

SAMPLE_HZ = 2.0
"""Images a second that are decoded: a camera that freezes for less than a second or two is not lost."""

GRID_ROWS = 120
"""Rows of an image that are looked at, evenly spaced, and columns in proportion: freezing and blackness show in them."""

BLACK_LEVEL = 10.0
"""Mean grey level (of 255) of a black picture: a covered lens gives 0 to 5, a dark room at night still 15 to 30."""

FLAT_DEVIATION = 2.0
"""Standard deviation of grey levels of a picture that shows nothing: even a white wall varies by more."""

FROZEN_S = 2.0
"""The same picture, to the last bit of a sensor's noise, for so long is one that was sent again and again."""

COMPARED = 9
"""Thumbnails by which demonstrations are compared: first and last alone are alike wherever a task begins and ends the same way."""

Moved = Callable[[float, float], bool | None]
"""Whether anything moved between two times (s): True, False, or None where nothing tells."""


@dataclass(frozen=True)
class FrameSample:
    """One sampled image: when (s), its mean grey level and the largest deviation of a channel (of 255), a checksum of what was looked
    at, and a grey thumbnail float32 [8,8], by which demonstrations are compared."""

    at_s: float
    mean: float
    deviation: float
    checksum: int
    thumbnail: F32


def sample_frame(frame: U8, at_s: float) -> FrameSample:
    """Look at an image uint8 [H,W,C]."""
    stride = max(frame.shape[0] // GRID_ROWS, 1)
    seen = np.ascontiguousarray(frame[::stride, ::stride])
    mean, deviation = cv2.meanStdDev(seen)
    small = geometry.fit_image(seen, THUMBNAIL_SIZE, THUMBNAIL_SIZE, "stretch")
    grey = small.reshape(THUMBNAIL_SIZE, THUMBNAIL_SIZE, -1).mean(axis=2, dtype=np.float32)
    return FrameSample(at_s, float(mean.mean()), float(deviation.max()), zlib.crc32(seen.data), grey)


def thumbnails_of(samples: list[FrameSample]) -> F32 | None:
    """float32 [COMPARED,8,8]: thumbnails evenly spaced along a demonstration, by which two are compared; None where no image was
    sampled."""
    if not samples:
        return None
    chosen = np.linspace(0, len(samples) - 1, COMPARED).round().astype(int)
    return np.stack([samples[i].thumbnail for i in chosen.tolist()])


def camera_findings(topic: str, samples: list[FrameSample], *, moved: Moved) -> Iterator[Finding]:
    """What is wrong with a camera, by its sampled images in order of time."""
    if not samples:
        return
    at_s = np.array([g.at_s for g in samples])
    mean = np.array([g.mean for g in samples])
    flat = np.array([g.deviation for g in samples]) < FLAT_DEVIATION
    black = (mean < BLACK_LEVEL) & (np.array([g.deviation for g in samples]) < BLACK_LEVEL)
    yield from _blank(
        topic, at_s, mean, black, "black", "the picture is black", "uncover the lens, or look at exposure and light"
    )
    yield from _blank(
        topic,
        at_s,
        mean,
        flat & ~black,
        "blank",
        "the picture is of one colour",
        "look at exposure and at the driver's output",
    )
    yield from _frozen(topic, samples, at_s, black | flat, moved)


def _blank(topic: str, at_s: F64, mean: F64, bad: Bool, kind: str, what: str, act: str) -> Iterator[Finding]:
    n_bad, n = int(bad.sum()), len(bad)
    if not n_bad:
        return
    always = n_bad == n
    first, last = (int(i) for i in np.flatnonzero(bad)[[0, -1]])
    severity: Severity = "error" if always else "warning"
    remedy = f"{act}; leave this topic out of the task" if always else f"{act}; cut those seconds out"
    yield Finding(
        severity=severity, kind=kind, place=Place(topic=topic, start_s=float(at_s[first]), end_s=float(at_s[last])),
        what=what + (" throughout" if always else f" in {n_bad} of {n} samples"),
        evidence={"n_samples": n, "n_bad": n_bad, "mean_grey_of_255": round(float(mean[bad].mean()), 1)}, remedy=remedy,
    )  # fmt: skip


def _frozen(topic: str, samples: list[FrameSample], at_s: F64, blank: Bool, moved: Moved) -> Iterator[Finding]:
    """Runs of identical pictures while something moved; a whole recording of one picture even where nothing tells."""
    for first, last in _runs([g.checksum for g in samples]):
        seconds = float(at_s[last] - at_s[first])
        if seconds < FROZEN_S or last - first < FROZEN_S * SAMPLE_HZ - 1 or blank[first]:
            continue
        whole = first == 0 and last == len(samples) - 1
        motion = moved(float(at_s[first]), float(at_s[last]))
        if motion is False or (motion is None and not whole):
            continue
        evidence: dict[str, float | int | str] = {"seconds": round(seconds, 2), "n_samples": last - first + 1}
        evidence["moved_meanwhile"] = "yes" if motion else "not known"
        severity: Severity = "error" if whole and motion else "warning"
        told = "throughout" if whole else f"for {seconds:.1f} s"
        yield Finding(
            severity=severity, kind="frozen", place=Place(topic=topic, start_s=float(at_s[first]), end_s=float(at_s[last])),
            what=f"one and the same picture {told}" + (", while the robot moves" if motion else ""),
            evidence=evidence,
            remedy="the driver sends its last image again: restart the camera, and cut those seconds out",
        )  # fmt: skip


def _runs(values: list[int]) -> Iterator[tuple[int, int]]:
    """First and last index of each run of equal values."""
    start = 0
    for i in range(1, len(values) + 1):
        if i == len(values) or values[i] != values[start]:
            yield start, i - 1
            start = i
