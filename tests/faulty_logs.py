"""Logs with chosen faults: a robot that follows random targets, two joints and a free one, one camera with a sensor's noise.

    path = write_faulty(tmp_path / "run.mcap", gap=(4.0, 5.5), action_late=1)

Without faults nothing is wrong with them. Times of faults are seconds from the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from tests import synthetic
from tests.synthetic import ACTION_TOPIC, JOINT_TOPIC, START_NS, card_frame, image_topic

CAMERA = image_topic("front")
RATE_HZ = 20.0
LAG_NS = 4_000_000
Span = tuple[float, float]


@dataclass(frozen=True)
class Faults:
    """What is wrong. Spans in seconds; `action_late` in steps; `clock_back` and `clock_ahead`: (when, by how much)."""

    gap: Span | None = None
    black: Span | None = None
    frozen: Span | None = None
    stuck: Span | None = None
    stuck_joint: Span | None = None
    nan: Span | None = None
    idle: Span | None = None  # seconds at the start, and at the end
    clock_back: Span | None = None
    clock_ahead: Span | None = None
    skew_s: float = 0.0
    drift_s: float = 0.0
    jitter_s: float = 0.0
    action_late: int = 0
    repeat_stamps: bool = False
    zero_stamps: bool = False
    drop_every: int = 0


def robot(n: int, seed: int = 0, *, follow: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """States float64 [n,3] and the targets float64 [n,2] that drive the first two: s' = s + follow (a - s), and a little noise."""
    rng = np.random.default_rng(seed)
    target = np.cumsum(rng.standard_normal((n, 2)), axis=0)
    state = np.zeros((n, 3))
    for k in range(n - 1):
        state[k + 1, :2] = state[k, :2] + follow * (target[k] - state[k, :2])
        state[k + 1, 2] = np.sin(k / 15)
    return state + 1e-3 * rng.standard_normal(state.shape), target


def write_faulty(
    path: Path, *, duration_s: float = 20.0, seed: int = 0, rate_hz: float = RATE_HZ, **faults: Any
) -> Path:
    """Write one log of `duration_s` with the faults named (see Faults)."""
    wrong = Faults(**faults)
    n = round(duration_s * rate_hz)
    at_s = np.arange(n) / rate_hz
    rng = np.random.default_rng([seed, 1])
    state, action = robot(n, seed)
    state, action = _spoilt_vectors(wrong, at_s, state, action)
    messages: list[tuple[int, int, str, Any]] = []
    for k in range(n):
        stamp, header = _stamps(wrong, at_s, k, rng)
        if wrong.gap is None or not wrong.gap[0] < at_s[k] < wrong.gap[1]:
            messages.append((stamp, header, JOINT_TOPIC, state[k]))
        messages.append((stamp, stamp - LAG_NS, ACTION_TOPIC, action[k]))
        if not (wrong.drop_every and k % wrong.drop_every == 1):
            messages.append((stamp, stamp - LAG_NS, CAMERA, _picture(wrong, float(at_s[k]), k, seed)))
    _write(path, messages)
    return path


def _stamps(wrong: Faults, at_s: np.ndarray, k: int, rng: np.random.Generator) -> tuple[int, int]:
    """(log time, header stamp) of step k's joint states."""
    stamp = START_NS + LAG_NS + round(at_s[k] * 1e9)
    header = stamp - LAG_NS - round((wrong.skew_s + wrong.drift_s * at_s[k] / at_s[-1]) * 1e9)
    header += round(rng.uniform(-1, 1) * wrong.jitter_s * 1e9)
    for jump, sign in ((wrong.clock_back, -1), (wrong.clock_ahead, 1)):
        if jump is not None and at_s[k] >= jump[0]:
            header += sign * round(jump[1] * 1e9)
    if wrong.repeat_stamps:
        header -= (k % 2) * round(1e9 / RATE_HZ)
    return stamp, 0 if wrong.zero_stamps else header


def _spoilt_vectors(
    wrong: Faults, at_s: np.ndarray, state: np.ndarray, action: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    if wrong.idle is not None:
        first, last = np.searchsorted(at_s, (wrong.idle[0], at_s[-1] - wrong.idle[1]))
        for values in (state, action):
            values[:first], values[last:] = values[first], values[last]
    if wrong.stuck is not None:
        first, last = np.searchsorted(at_s, wrong.stuck)
        state[first:last] = state[first]
    if wrong.stuck_joint is not None:
        first, last = np.searchsorted(at_s, wrong.stuck_joint)
        state[first:last, 0] = state[first, 0]
    if wrong.nan is not None:
        first, last = np.searchsorted(at_s, wrong.nan)
        state[first:last, 1] = np.nan
    return state, np.roll(action, wrong.action_late, axis=0)


def _picture(wrong: Faults, t_s: float, k: int, seed: int) -> Any:
    if wrong.black is not None and wrong.black[0] <= t_s < wrong.black[1]:
        return np.zeros((48, 64, 3), np.uint8)
    if wrong.frozen is not None and wrong.frozen[0] <= t_s < wrong.frozen[1]:
        k = round(wrong.frozen[0] * RATE_HZ)
    noise = np.random.default_rng([seed, k]).integers(-4, 5, (48, 64, 3))
    return np.clip(card_frame(k + 97 * seed).astype(np.int16) + noise, 0, 255).astype(np.uint8)


def _write(path: Path, messages: list[tuple[int, int, str, Any]]) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, chunk_size=20_000)
        writer.start(profile="ros2", library="faulty")
        channels: dict[str, int] = {}
        for sequence, (log_ns, header_ns, topic, value) in enumerate(messages):
            name, encoding, definition, data = synthetic._cdr(header_ns, topic, value, "jpeg")
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, "cdr", writer.register_schema(name, encoding, definition)
                )
            writer.add_message(channels[topic], log_ns, data, log_ns, sequence)
        writer.finish()
