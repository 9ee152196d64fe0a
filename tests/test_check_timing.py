"""Stamps judged: a clean stream is left alone, each fault is found where it was put."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vilp_data.check.findings import Finding
from vilp_data.check.timing import (
    GAP_FLOOR_S,
    drift_findings,
    log_order_findings,
    measure,
    silence_findings,
    timing_findings,
)
from vilp_data.message_rate import GAP_FACTOR

START_NS = 1_700_000_000_000_000_000
rates = st.sampled_from([5.0, 10.0, 29.97, 50.0, 200.0])
seeds = st.integers(0, 2**16)
few = settings(max_examples=40)


def stream(
    n: int, rate_hz: float, *, jitter: float = 0.0, lag_s: float = 0.004, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """(log times, header stamps) of n messages; `jitter` of an interval either way in the header, and half a millisecond in transport."""
    rng = np.random.default_rng(seed)
    header = START_NS + np.round((np.arange(n) + rng.uniform(-jitter, jitter, n)) / rate_hz * 1e9).astype(np.int64)
    log = header + round(lag_s * 1e9) + rng.integers(0, 500_000, n)
    return np.maximum.accumulate(log), header


def judged(log: np.ndarray, header: np.ndarray | None, *, camera: bool = True) -> list[Finding]:
    return list(timing_findings("/t", log, header, origin_ns=int(log[0]), camera=camera))


def kinds(findings: list[Finding]) -> set[str]:
    return {finding.kind for finding in findings}


@few
@given(rates, st.integers(2, 400), st.floats(0, 0.2), seeds, st.booleans())
def test_a_clean_stream_gives_no_finding(rate_hz: float, n: int, jitter: float, seed: int, with_header: bool) -> None:
    log, header = stream(n, rate_hz, jitter=jitter, seed=seed)
    assert judged(log, header if with_header else None) == []


def in_bursts(n_bursts: int, of: int) -> np.ndarray:
    """Log times of messages half a millisecond apart, a few tens at a time, twice in a second."""
    return np.concatenate([START_NS + k * 500_000_000 + np.arange(of) * 500_000 for k in range(n_bursts)])


def test_what_comes_in_bursts_has_no_gaps_and_no_missing_messages() -> None:
    log = in_bursts(20, 30)
    assert judged(log, log - 1_000_000, camera=False) == []
    assert (measure(log, None).periodic, measure(log, None).rate_hz) == (False, None)
    assert kinds(judged(log, None)) == {"irregular-camera"}


@few
@given(rates, st.integers(40, 300), st.data(), seeds)
def test_an_inserted_gap_is_found_at_its_place(rate_hz: float, n: int, data: st.DataObject, seed: int) -> None:
    at = data.draw(st.integers(1, n - 1))
    least_s = max(GAP_FACTOR / rate_hz, GAP_FLOOR_S)
    gap_s = data.draw(st.floats(1.3 * least_s, 20 * least_s))
    log, header = stream(n, rate_hz, jitter=0.05, seed=seed)
    log[at:] += round(gap_s * 1e9)
    header[at:] += round(gap_s * 1e9)
    (gap,) = judged(log, header)
    assert gap.kind == "gap"
    assert gap.severity == "warning"
    start_s = (log[at - 1] - log[0]) / 1e9
    assert abs((gap.place.start_s or 0.0) - start_s) < 1e-6
    assert abs(float(gap.evidence["gap_s"]) - gap_s) < 2 / rate_hz


@few
@given(st.integers(1, 80), st.floats(1.5, 1000), st.booleans())
def test_a_clock_that_jumps_is_found_where_it_does(at: int, by_s: float, back: bool) -> None:
    log, header = stream(100, 10.0)
    header[at:] += round(by_s * 1e9) * (-1 if back else 1)
    found = [finding for finding in judged(log, header) if finding.kind.startswith("clock-jump")]
    assert [finding.kind for finding in found] == ["clock-jump" if back else "clock-jump-ahead"]
    assert abs((found[0].place.start_s or 0.0) - (log[at] - log[0]) / 1e9) < 1e-6
    assert found[0].severity == ("error" if back else "warning")


@few
@given(st.integers(30, 200), st.floats(0.02, 0.4))
def test_missing_messages_are_counted(n: int, share: float) -> None:
    keep = np.ones(n, np.bool_)
    keep[1 : -1 : max(round(1 / share), 2)] = False
    log, header = stream(n, 30.0)
    found = judged(log[keep], header[keep])
    missing = int((~keep).sum())
    if missing > 0.03 * n and missing < 0.2 * n:
        assert "missing-messages" in kinds(found)
        assert next(f for f in found if f.kind == "missing-messages").evidence["n_missing"] == missing


def test_a_topic_on_events_has_no_gaps() -> None:
    rng = np.random.default_rng(0)
    log = START_NS + np.cumsum(rng.exponential(0.5, 300) * 1e9).astype(np.int64)
    assert judged(log, None, camera=False) == []
    assert not measure(log, None).periodic


def test_a_camera_without_a_rate_is_named() -> None:
    rng = np.random.default_rng(0)
    log = START_NS + np.cumsum(rng.exponential(0.1, 300) * 1e9).astype(np.int64)
    assert kinds(judged(log, None)) == {"irregular-camera"}


def test_repeated_header_stamps_are_found() -> None:
    log, header = stream(200, 20.0)
    header[1::2] = header[::2]
    assert "duplicate-stamps" in kinds(judged(log, header))


def test_stamps_out_of_order_are_a_note() -> None:
    log, header = stream(200, 20.0)
    header[[50, 51]] = header[[51, 50]]
    (found,) = judged(log, header)
    assert (found.kind, found.severity, found.evidence["n_out_of_order"]) == ("out-of-order", "note", 1)


def test_unset_stamps_are_read_by_arrival() -> None:
    log, header = stream(50, 20.0)
    for stamps in (np.zeros_like(header), np.full_like(header, START_NS)):
        (found,) = judged(log, stamps)
        assert found.kind == "header-unset"
        assert 'topic = "/t", clock = "log"' in str(found.remedy)


@few
@given(st.floats(1.1, 5000), st.booleans())
def test_a_header_of_another_clock_is_found(by_s: float, behind: bool) -> None:
    log, header = stream(50, 20.0)
    found = judged(log, header + round(by_s * 1e9) * (-1 if behind else 1))
    assert kinds(found) == {"skew"}
    assert abs(abs(float(found[0].evidence["lag_s"])) - by_s) < 0.01


def test_a_stamp_after_its_arrival_is_found() -> None:
    log, header = stream(50, 20.0, lag_s=-0.08)
    assert kinds(judged(log, header)) == {"stamped-ahead"}


def test_simulated_time_beside_wall_time_is_a_note() -> None:
    log, header = stream(50, 20.0)
    (found,) = judged(log, header - START_NS + 10**9)
    assert (found.kind, found.severity) == ("two-clocks", "note")


@few
@given(st.floats(0.03, 0.9), st.booleans(), seeds)
def test_a_drift_is_found_and_noise_is_not(by_s: float, shrinks: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    at_s, lag_s = np.linspace(0, 60, 200), 0.02 + rng.normal(0, 0.002, 200)
    assert list(drift_findings("/t", at_s, lag_s)) == []
    (found,) = drift_findings("/t", at_s, lag_s + np.linspace(0, by_s, 200) * (-1 if shrinks else 1))
    assert found.kind == "drift"
    assert abs(abs(float(found.evidence["drift_s"])) - 0.9 * by_s) < 0.1 * by_s + 0.005


def test_a_step_of_the_lag_is_no_drift() -> None:
    lag_s = np.where(np.arange(200) < 180, 0.02, 0.2)
    assert list(drift_findings("/t", np.linspace(0, 60, 200), lag_s)) == []


def test_a_topic_that_ends_early_is_found() -> None:
    span = (START_NS, START_NS + 60 * 10**9)
    (found,) = silence_findings("/t", START_NS, START_NS + 40 * 10**9, span_ns=span, rate_hz=30.0)
    assert found.kind == "ends-early"
    assert (found.place.start_s, found.place.end_s) == (40.0, 60.0)
    assert list(silence_findings("/t", START_NS, span[1] - 10**8, span_ns=span, rate_hz=30.0)) == []


@few
@given(st.lists(st.integers(0, 50), min_size=2, max_size=60))
def test_log_times_that_fall_along_the_file_are_counted(steps: list[int]) -> None:
    times = START_NS + np.array(steps, np.int64) * 1_000_000
    found = list(log_order_findings("/t", times))
    falls = sum(b < a for a, b in pairwise(steps))
    assert [finding.evidence["n_falls"] for finding in found] == ([falls] if falls else [])
