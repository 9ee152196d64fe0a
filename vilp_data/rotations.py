"""Rotations as quaternions x y z w (w last, as ROS and Foxglove have them), arrays float64 [...,4]; vectors [...,3] in radians. Pure."""

from __future__ import annotations

import numpy as np

from vilp_data.types import F64

NO_ROTATION = 1e-9
"""A quaternion shorter than this turns nothing: it was never set."""


def product(a: F64, b: F64) -> F64:
    """Turning by `b`, then by `a`."""
    aw, bw = a[..., 3:], b[..., 3:]
    av, bv = a[..., :3], b[..., :3]
    w = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    return np.concatenate([aw * bv + bw * av + np.cross(av, bv), w], axis=-1)


def conjugate(q: F64) -> F64:
    """Turning back."""
    return np.asarray(q * np.array([-1.0, -1.0, -1.0, 1.0]))


def turned(q: F64, v: F64) -> F64:
    """Vectors [...,3], turned by unit quaternions: v + 2 q × (q × v + w v)."""
    axis = q[..., :3]
    return np.asarray(v + 2 * np.cross(axis, np.cross(axis, v) + q[..., 3:] * v))


def unit(q: F64) -> F64:
    """The same rotations, of length 1; NaN where there is none."""
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(q, axis=-1, keepdims=True)
        return np.asarray(q / np.where(norm > NO_ROTATION, norm, np.nan))


def continuous(q: F64) -> F64:
    """The same rotations [M,4] in order of time, the sign of each chosen to be near the one before it; the first stays as it is.

    q and -q are one rotation, and who publishes them may flip at any time: a jump that no robot makes. All four are NaN where
    one is no number, or all are zero, as drivers send before they know better; such rows are passed over."""
    with np.errstate(over="ignore", invalid="ignore"):
        out = np.where(np.linalg.norm(q, axis=-1, keepdims=True) > NO_ROTATION, q, np.nan)  # NaN compares false
        known = np.flatnonzero(np.isfinite(out).all(axis=-1))
        turns = np.sum(out[known[1:]] * out[known[:-1]], axis=-1) < 0
    signs = np.cumprod(np.where(np.append(False, turns), -1.0, 1.0))
    out[known] *= signs[: len(known), None]
    return np.asarray(out)


def from_axis_angle(v: F64) -> F64:
    """The unit quaternion that turns about `v` by its length."""
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.concatenate([np.sinc(angle / (2 * np.pi)) / 2 * v, np.cos(angle / 2)], axis=-1)


def to_axis_angle(q: F64) -> F64:
    """The inverse of `from_axis_angle`, of at most half a turn, for one quaternion [4]."""
    q = q if q[3] >= 0 else -q
    sine = float(np.linalg.norm(q[:3]))
    if sine < 1e-12:
        return np.asarray(2 * q[:3])
    return np.asarray(q[:3] * (2 * np.arctan2(sine, q[3]) / sine))
