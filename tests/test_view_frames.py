"""Images are decoded as they come and only where steps see them, and memory does not hold a log: with the same result as if it did."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import synthetic
from tests.synthetic import card_frame, encode_image, task_spec, write_mcap
from vilp_data import align, view_frames
from vilp_data.assemble import assemble_episode
from vilp_data.errors import DecodeError
from vilp_data.frame_spool import FrameSpool
from vilp_data.keys import content_digest
from vilp_data.sources import open_log
from vilp_data.spec import ViewSpec
from vilp_data.types import I64, U8, Message
from vilp_data.view_frames import PASSED_BY, Seen, Ticks, ViewFrames

VIEW = ViewSpec(topic="/t", height=48, width=64)
PERIOD_NS = 100_000_000


def image(number: int, *, torn: bool = False) -> Message:
    data = encode_image(np.full((48, 64, 3), number, np.uint8), "png")
    return Message("/t", "foxglove.CompressedImage", 0, 0, {"data": data[:50] if torn else data, "format": "png"})


def expected(stamps: I64, torn: set[int], ticks: I64) -> list[int]:
    """Which image each tick sees: the latest whole one, -1 for none."""
    whole = [n for n in np.argsort(stamps, kind="stable") if n not in torn]
    index = align.observe(stamps[whole], ticks, stale_after_s=9.0).index
    return [whole[i] if i >= 0 else -1 for i in index]


def number_of(frame: U8) -> int:
    return int(frame[0, 0, 0])


def observed(stamps: I64, torn: set[int], ticks: I64, rate_hz: float | None) -> Seen:
    """What the view shows of images 0, 1, … that arrive in this order."""
    collector = ViewFrames("v", VIEW, Ticks(rate_hz, 1, start_ns=int(ticks[0])))
    for number, stamp in enumerate(stamps.tolist()):
        collector.add(image(number, torn=number in torn), stamp)
    return collector.observe(ticks)


@settings(max_examples=40, deadline=None)
@given(
    jitter=st.lists(st.integers(-150, 150), min_size=12, max_size=24),
    torn=st.sets(st.integers(0, 23), max_size=4),
    rate_hz=st.sampled_from([None, 3.0, 7.0, 10.0, 25.0]),
)
def test_steps_see_what_they_would_if_every_image_were_kept(
    jitter: list[int], torn: set[int], rate_hz: float | None
) -> None:
    stamps = np.array([10**9 + n * PERIOD_NS + j * 1_000_000 for n, j in enumerate(jitter)], np.int64)
    ticks = align.control_ticks({"v": np.sort(stamps)}, rate_hz or 10.0)
    wanted = set(expected(stamps, set(), ticks))
    if len(wanted & torn) > len(wanted) / 2:
        with pytest.raises(DecodeError, match="damaged"):
            observed(stamps, torn, ticks, rate_hz)
        return
    seen = observed(stamps, torn, ticks, rate_hz)
    for k, number in enumerate(expected(stamps, torn, ticks)):
        assert (number >= 0) == bool(np.isfinite(seen.age_s[k]))
        if number >= 0:
            assert number_of(seen.frames[seen.source_index[k]]) == number, k
            assert seen.age_s[k] == pytest.approx(max(int(ticks[k] - stamps[number]), 0) / 1e9)


@pytest.mark.parametrize("torn", [{25}, {25, 24}, {24, 25, 26}, {25, 23}])
def test_a_step_whose_image_is_damaged_sees_the_one_right_before_it_though_nobody_had_asked_for_that(
    torn: set[int],
) -> None:
    stamps = 10**9 + np.arange(60, dtype=np.int64) * PERIOD_NS // 5
    ticks = align.control_ticks({"v": stamps}, 10.0)
    seen = observed(stamps, torn, ticks, 10.0)
    expected_number = max(n for n in range(26) if n not in torn)
    assert number_of(seen.frames[seen.source_index[5]]) == expected_number
    assert seen.age_s[5] == pytest.approx((25 - expected_number) * 0.02)
    assert seen.damaged == len(torn & {25} | {n for n in torn if n < 25 and set(range(n, 25)) <= torn})


def test_more_damage_than_images_are_kept_for_leaves_an_older_one_with_its_age() -> None:
    stamps = 10**9 + np.arange(120, dtype=np.int64) * PERIOD_NS // 10
    ticks = align.control_ticks({"v": stamps}, 10.0)
    seen = observed(stamps, set(range(51 - PASSED_BY - 1, 51)), ticks, 10.0)
    assert number_of(seen.frames[seen.source_index[5]]) == 40
    assert seen.age_s[5] == pytest.approx(0.1)


@pytest.mark.parametrize(("n_torn", "refused"), [(6, False), (7, True)])
def test_an_episode_is_refused_when_more_than_half_of_its_images_are_damaged(n_torn: int, refused: bool) -> None:
    stamps = 10**9 + np.arange(12, dtype=np.int64) * PERIOD_NS
    torn = set(range(1, n_torn + 1))
    if refused:
        with pytest.raises(DecodeError, match="view v.*damaged\n.*7 of 12; the first, /t at 0 ns"):
            observed(stamps, torn, stamps, 10.0)
    else:
        assert observed(stamps, torn, stamps, 10.0).damaged == n_torn


def test_a_topic_of_nothing_but_damage_is_not_read_to_its_end() -> None:
    stamps = 10**9 + np.arange(60, dtype=np.int64) * PERIOD_NS
    collector = ViewFrames("v", VIEW, Ticks(10.0, 1, start_ns=int(stamps[0])))
    with pytest.raises(DecodeError, match="cut off"):
        for number, stamp in enumerate(stamps.tolist()):
            collector.add(image(number, torn=True), stamp)
    assert len(collector.stamps_ns) < 30


def floats(*brightest: float) -> list[Message]:
    return [Message("v", "array", n, n, np.full((48, 64, 3), value, np.float32)) for n, value in enumerate(brightest)]


def of_floats(messages: Sequence[Message]) -> Seen:
    stamps = 10**9 + np.arange(len(messages), dtype=np.int64) * PERIOD_NS
    collector = ViewFrames("v", VIEW, Ticks(10.0, 1, start_ns=int(stamps[0])))
    for message, stamp in zip(messages, stamps.tolist(), strict=True):
        collector.add(message, stamp)
    return collector.observe(stamps)


def test_a_dark_float_image_is_read_where_others_of_its_camera_are_brighter() -> None:
    seen = of_floats(floats(0.0, 1.0, 200.0, 1.0))
    assert seen.frames[:, 0, 0, 0].tolist() == [0, 1, 200, 1]
    assert seen.damaged == 0


@pytest.mark.parametrize("brightest", [(0.0, 1.0, 1.0), (0.5, 0.25, 1.0)])
def test_a_float_camera_that_never_goes_above_1_is_refused(brightest: tuple[float, ...]) -> None:
    with pytest.raises(DecodeError, match="range 0 to 1"):
        of_floats(floats(*brightest))


def test_a_float_camera_that_saw_nothing_is_black() -> None:
    assert not of_floats(floats(0.0, 0.0)).frames.any()


def test_a_camera_faster_than_the_steps_is_not_decoded_in_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = write_mcap(tmp_path / "run.mcap", camera_hz=50.0, n_frames=100)
    decoded: list[int] = []
    decode = view_frames.decode_image
    monkeypatch.setattr(
        view_frames, "decode_image", lambda message, **kw: decoded.append(message.log_time_ns) or decode(message, **kw)
    )
    with open_log(log.path) as reader:
        episode = assemble_episode(reader, reader.episodes()[0], task_spec(log), episode_id="x")
    assert episode.n_steps == 20
    assert len(decoded) <= 22


def test_a_first_image_that_comes_late_is_read_once_more_and_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = synthetic._cdr
    first = synthetic.START_NS

    def restamped(stamp: int, topic: str, value: object, codec: object) -> object:
        swapped = {first: first + PERIOD_NS // 2, first + PERIOD_NS // 2: first}
        return write(swapped.get(stamp, stamp), topic, value, codec)  # type: ignore[arg-type]

    monkeypatch.setattr(synthetic, "_cdr", restamped)
    log = write_mcap(tmp_path / "run.mcap", camera_hz=20.0, n_frames=40, image_codec="png")
    monkeypatch.undo()
    with open_log(log.path) as reader:
        episode = assemble_episode(reader, reader.episodes()[0], task_spec(log), episode_id="x")
    assert episode.log_time_ns[0] == first
    seen = episode.frames["front"][episode.source_index["front"]]
    np.testing.assert_array_equal(seen[0], log.frames["front"][1])
    np.testing.assert_array_equal(seen[1:], log.frames["front"][2::2])


@pytest.mark.parametrize("limit", [0, 3 * 48 * 64 * 3, 1 << 30], ids=["file", "both", "memory"])
@pytest.mark.parametrize("rows", [[0, 1, 2, 3, 4, 5], [5, 0, 2]])
def test_frames_come_back_from_memory_and_from_the_file(tmp_path: Path, limit: int, rows: list[int]) -> None:
    frames: list[U8] = [card_frame(n) for n in range(6)]
    spool = FrameSpool(tmp_path, in_memory_bytes=limit)
    assert [spool.append(frame) for frame in frames] == [0, 1, 2, 3, 4, 5]
    taken = spool.take(np.array(rows))
    np.testing.assert_array_equal(taken, np.stack([frames[row] for row in rows]))
    assert content_digest(taken) == content_digest(np.stack([frames[row] for row in rows]))
    assert list(tmp_path.iterdir()) == []


def test_an_episode_larger_than_the_memory_that_it_may_take_is_stored_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_mcap(tmp_path / "run.mcap", image_codec="png")

    def assembled() -> U8:
        with open_log(log.path) as reader:
            episode = assemble_episode(reader, reader.episodes()[0], task_spec(log), episode_id="x", scratch=tmp_path)
        return episode.frames["front"]

    in_memory = assembled()
    monkeypatch.setattr(view_frames, "FrameSpool", lambda folder: FrameSpool(folder, in_memory_bytes=0))
    mapped = assembled()
    assert isinstance(mapped, np.memmap)
    np.testing.assert_array_equal(mapped, in_memory)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
