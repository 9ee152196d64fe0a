"""One long log becomes many episodes: with names and keys of their own, shown before anything is written, noticed when they change."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.faults import tree
from tests.json_log import START_NS, S, Said, image, joints, number, write_json_log
from tests.synthetic import write_zarr, zarr_task_spec
from vilp_data import cut_log
from vilp_data.cut_log import preview
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.sources.mcap_log import McapLog
from vilp_data.spec import SplitSpec, TaskSpec
from vilp_data.staleness import stale_episodes
from vilp_data.task_toml import load_task

MARKER = "/episode"


def write_session(path: Path, *, shift_s: float = 0.0) -> Path:
    """Three bursts of 10 Hz images and joints, of 2, 1 and 0.1 s, from 0, 5 and 10 s on; /episode says 1, 0, 2, 0 at 0, 2, 5, 6 s."""
    said: list[Said] = []
    for start, count in ((0.0, 20), (5.0, 10), (10.0, 1)):
        for k in range(count):
            t = shift_s + start + k / 10
            said += [image(t, index=k), joints(t, ["a"], [t])]
    said += [number(shift_s + t, v, MARKER) for t, v in ((0.0, 1.0), (2.0, 0.0), (5.0, 2.0), (6.0, 0.0))]
    return write_json_log(path, said)


def task(episodes: dict[str, Any], **overrides: Any) -> TaskSpec:
    table = {
        "name": "session",
        "rate_hz": 10.0,
        "views": {"front": {"topic": "/camera/front/image", "height": 48, "width": 64}},
        "low_dim": {"joints": {"topic": "/joint_states"}},
        "episodes": episodes,
    }
    return TaskSpec.model_validate(table | overrides)


def ingest(log: Path, root: Path, spec: TaskSpec) -> IngestReport:
    return ingest_logs([log], root, spec, workers=1)


GAP = {"by": "gap", "gap_s": 1.5, "topics": ["/camera/front/image"]}
BY_VALUE = {"by": "topic", "topic": MARKER, "tag": "object"}


def test_silence_parts_episodes_and_a_cut_without_motion_is_reported(tmp_path: Path) -> None:
    log = write_session(tmp_path / "run.mcap")
    report = ingest(log, tmp_path / "data", task(GAP))
    assert report.written == ["run-at-00000.000s", "run-at-00005.000s"]
    ((name, why),) = report.failed
    assert name == "run-at-00010.000s"
    assert "one step" in why
    store = EpisodeStore(tmp_path / "data")
    one, two = (store.read(entry.id) for entry in store.index())
    assert (one.n_steps, two.n_steps) == (20, 10)
    np.testing.assert_allclose(two.low_dim[:, 0], 5 + np.arange(10) / 10, atol=1e-6)
    assert two.log_time_ns[0] == START_NS + 5 * S
    assert one.tags["log"] == "run"


def test_short_cuts_are_left_out_and_counted(tmp_path: Path) -> None:
    log = write_session(tmp_path / "run.mcap")
    report = ingest(log, tmp_path / "data", task(GAP | {"min_duration_s": 0.5}))
    assert (len(report.written), report.failed) == (2, [])
    assert "1 cut shorter than min_duration_s = 0.5 left out" in report.notes[0]


def test_a_topic_s_values_part_and_tag_episodes(tmp_path: Path) -> None:
    log = write_session(tmp_path / "run.mcap")
    assert len(ingest(log, tmp_path / "data", task(BY_VALUE)).written) == 2
    assert [entry.tags["object"] for entry in EpisodeStore(tmp_path / "data").index()] == ["1.0", "2.0"]


def test_ingesting_again_does_nothing_and_reads_no_marker_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_session(tmp_path / "run.mcap")
    os.utime(log, (1e9, 1e9))
    ingest(log, tmp_path / "data", task(BY_VALUE))
    before = tree(tmp_path / "data")
    monkeypatch.setattr(McapLog, "messages", lambda *args, **options: pytest.fail("read again"))
    monkeypatch.setattr(McapLog, "sha256", lambda *args: pytest.fail("read again"))
    report = ingest(log, tmp_path / "data", task(BY_VALUE))
    assert (report.written, len(report.fresh)) == ([], 2)
    assert tree(tmp_path / "data") == before


@pytest.mark.parametrize("gap_s", [4.5, 1.4], ids=["other cuts", "as it happens the same cuts"])
def test_another_rule_is_named_and_refused_whatever_it_would_cut(tmp_path: Path, gap_s: float) -> None:
    log, root = write_session(tmp_path / "run.mcap"), tmp_path / "data"
    ingest(log, root, task(GAP))
    before, changed = tree(root), task(GAP | {"gap_s": gap_s})
    stale = stale_episodes(root, changed)["run-at-00000.000s"]
    assert f"episodes.gap_s: 1.5 -> {gap_s}" in stale
    assert "--into" in stale
    with pytest.raises(UsageError, match=rf"another rule\n.*gap_s: 1.5 -> {gap_s}(.|\n)*--into"):
        ingest(log, root, changed)
    assert tree(root) == before
    assert ingest(log, tmp_path / "other", changed).written


def test_demonstrations_of_whole_logs_and_of_cuts_do_not_mix(tmp_path: Path) -> None:
    log, root = write_session(tmp_path / "run.mcap"), tmp_path / "data"
    ingest(log, root, task({"by": "file"}))
    with pytest.raises(UsageError, match="another rule\n.*episodes: added"):
        ingest(log, root, task(GAP))


def write_task(folder: Path, ranges: str) -> TaskSpec:
    (folder / "ranges.csv").write_text(ranges)
    (folder / "task.toml").write_text(
        'name = "session"\nrate_hz = 10.0\n[episodes]\nby = "ranges.csv"\n[low_dim.joints]\ntopic = "/joint_states"\n'
        '[views.front]\ntopic = "/camera/front/image"\nheight = 48\nwidth = 64\n'
    )
    return load_task(str(folder / "task.toml"))


def test_a_ranges_file_gives_names_tags_and_outcomes(tmp_path: Path) -> None:
    log = write_session(tmp_path / "run.mcap")
    spec = write_task(
        tmp_path, "start,end,name,success,operator\n0,1,good,true,kim\n1,2,bad,false,kim\n5,6,,,\n90,91,late,,\n"
    )
    report = ingest(log, tmp_path / "data", spec)
    assert report.written == ["run-at-00005.000s", "run-good"]
    assert report.left_out == ["run-bad"]
    assert report.failed == []
    assert "ranges outside the log's 10.0 s, and left out: late (90-91 s)" in report.notes[0]
    entry = EpisodeStore(tmp_path / "data").entry("run-good")
    assert (entry.outcome, entry.tags["operator"], entry.n_steps) == ("success", "kim", 10)


def test_ranges_that_reach_outside_the_log_are_cut_to_it_and_named(tmp_path: Path) -> None:
    log = write_session(tmp_path / "run.mcap")
    cuts, notes = preview(log, write_task(tmp_path, "start,end,name\n-5,-3,early\n-2,1,first\n5,900,\n1,2.0,whole\n"))
    assert [(cut.name, cut.start_s, round(cut.duration_s, 3)) for cut in cuts] == [
        ("first", 0.0, 1.0),
        ("whole", 1.0, 1.0),
        ("at-00005.000s", 5.0, 5.0),
    ]
    assert "outside the log's 10.0 s, and left out: early (-5--3 s)" in notes[0]
    assert "reaching outside the log's 10.0 s, and cut there: first (-2-1 s), 5-900 s" in notes[1]


def test_ranges_that_overlap_are_refused_unless_a_log_stays_on_one_side_of_the_split(tmp_path: Path) -> None:
    log = write_session(tmp_path / "run.mcap")
    overlapping = write_task(tmp_path, "start,end,name\n5,6,late\n0,1.5,one\n1,2,two\n")
    ((name, why),) = ingest(log, tmp_path / "data", overlapping).failed
    assert (name, "one (0-1.5 s) and two (1-2 s)" in why, 'group_by = "log"' in why) == ("run.mcap", True, True)
    grouped = overlapping.model_copy(update={"split": SplitSpec(group_by="log")})
    assert len(ingest(log, tmp_path / "data", grouped).written) == 3
    touching = write_task(tmp_path, "start,end\n0,1\n1,2\n")
    assert len(preview(log, touching)[0]) == 2


def bouncing(tmp_path: Path) -> Path:
    frames = [message for k in range(40) for message in (image(k / 10, index=k), joints(k / 10, ["a"], [k / 10]))]
    edges = ((0.5, True), (0.5002, False), (0.5004, True), (2.0, False), (2.00002, True), (2.00005, False))
    return write_json_log(tmp_path / "run.mcap", [*frames, *(number(t, value, MARKER) for t, value in edges)])


def test_a_button_that_bounces_marks_one_demonstration_and_leaves_the_rest_out(tmp_path: Path) -> None:
    cuts, notes = preview(bouncing(tmp_path), task({"by": "topic", "topic": MARKER}))
    assert [(cut.name, round(cut.duration_s, 4)) for cut in cuts] == [("at-00000.500s", 1.4996)]
    assert "2 cuts shorter than 0.001 s left out" in notes[0]
    cuts, notes = preview(bouncing(tmp_path), task({"by": "topic", "topic": MARKER, "min_duration_s": 0.5}))
    assert len(cuts) == 1
    assert "2 cuts shorter than min_duration_s = 0.5 left out" in notes[0]


def test_spans_are_found_anew_once_the_rules_of_cutting_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = write_session(tmp_path / "run.mcap")
    os.utime(log, (1e9, 1e9))
    ingest(log, tmp_path / "data", task(BY_VALUE))
    monkeypatch.setattr(cut_log, "RULES_VERSION", cut_log.RULES_VERSION + 1)
    monkeypatch.setattr(McapLog, "messages", lambda *args, **options: pytest.fail("read again"))
    with pytest.raises(pytest.fail.Exception, match="read again"):
        ingest(log, tmp_path / "data", task(BY_VALUE))


def test_times_that_the_index_does_not_tell_are_read_without_decoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_session(tmp_path / "run.mcap")
    expected = preview(log, task(GAP))[0]
    monkeypatch.setattr(McapLog, "message_times", lambda log: ({}, True))
    monkeypatch.setattr(McapLog, "decoded", lambda *args: pytest.fail("decoded"))
    found = preview(log, task(GAP))[0]
    assert [(cut.name, cut.duration_s) for cut in found] == [(cut.name, cut.duration_s) for cut in expected]
    assert [cut.messages for cut in found] == [None] * 3


def test_one_more_range_adds_one_episode_and_a_changed_one_replaces_its_own(tmp_path: Path) -> None:
    log, root = write_session(tmp_path / "run.mcap"), tmp_path / "data"
    ingest(log, root, write_task(tmp_path, "start,end,name\n0,1,a\n5,6,b\n"))
    report = ingest(log, root, write_task(tmp_path, "start,end,name\n0,1,a\n5,6,b\n1,2,c\n"))
    assert (report.written, report.fresh) == (["run-c"], ["run-a", "run-b"])
    moved = write_task(tmp_path, "start,end,name\n0,1,a\n5,5.5,b\n1,2,c\n")
    assert list(stale_episodes(root, moved)) == ["run-b"]
    report = ingest(log, root, moved)
    assert report.written == report.replaced == ["run-b"]
    assert EpisodeStore(root).entry("run-b").n_steps == 5
    fewer = write_task(tmp_path, "start,end,name\n0,1,a\n1,2,c\n")
    assert "no longer in ranges.csv" in stale_episodes(root, fewer)["run-b"]
    assert "run-b: stored, and no longer in ranges.csv" in ingest(log, root, fewer).notes[0]


def test_the_dataset_remembers_its_ranges_without_the_file(tmp_path: Path) -> None:
    log, root = write_session(tmp_path / "run.mcap"), tmp_path / "data"
    ingest(log, root, write_task(tmp_path, "start,end,name\n0,1,a\n"))
    (tmp_path / "ranges.csv").unlink()
    assert ingest(log, root, EpisodeStore(root).spec()).fresh == ["run-a"]
    with pytest.raises(UsageError, match="the ranges file cannot be read"):
        load_task(str(tmp_path / "task.toml"))


def test_a_renamed_log_is_known_by_its_ranges(tmp_path: Path) -> None:
    log, root = write_session(tmp_path / "run.mcap"), tmp_path / "data"
    ingest(log, root, task(BY_VALUE))
    log.rename(tmp_path / "renamed.mcap")
    assert ingest(tmp_path / "renamed.mcap", root, task(BY_VALUE)).fresh == ["run-at-00000.000s", "run-at-00005.000s"]


def test_a_later_log_with_cuts_at_the_same_seconds_is_kept_beside_the_first(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    one, two = write_session(tmp_path / "run.mcap"), write_session(tmp_path / "b" / "run.mcap", shift_s=3600)
    report = ingest_logs([one, two], tmp_path / "data", task(BY_VALUE), workers=1)
    assert len(report.written) == 4


def test_the_preview_shows_what_ingest_takes_and_writes_nothing(tmp_path: Path) -> None:
    log = write_session(tmp_path / "run.mcap")
    before = tree(tmp_path)
    cuts, notes = preview(log, task(GAP | {"min_duration_s": 0.5}))
    assert [(cut.name, cut.start_s, round(cut.duration_s, 6), cut.messages) for cut in cuts] == [
        ("at-00000.000s", 0.0, 1.9, 40),
        ("at-00005.000s", 5.0, 0.9, 20),
    ]
    assert "left out" in notes[0]
    assert tree(tmp_path) == before
    assert [cut.tags["object"] for cut in preview(log, task(BY_VALUE))[0]] == ["1.0", "2.0"]


@pytest.mark.parametrize(
    ("episodes", "said"),
    [
        ({"by": "topic", "topic": "/episod"}, "did you mean '/episode'"),
        ({"by": "gap", "gap_s": 1, "topics": ["/camera"]}, "which the log lacks"),
        ({"by": "topic", "topic": "/joint_states"}, "episodes.field"),
        ({"by": "topic", "topic": "/joint_states", "field": "posi[0]"}, "did you mean 'position'"),
    ],
)
def test_a_log_that_cannot_be_cut_is_reported_with_what_to_do(
    tmp_path: Path, episodes: dict[str, Any], said: str
) -> None:
    log = write_session(tmp_path / "run.mcap")
    ((name, why),) = ingest(log, tmp_path / "data", task(episodes)).failed
    assert name == "run.mcap"
    assert said in why


def test_a_marker_may_be_a_field_a_word_or_a_message_without_fields(tmp_path: Path) -> None:
    def events(*said: Said) -> Path:
        frames = [message for k in range(40) for message in (image(k / 10, index=k), joints(k / 10, ["a"], [k / 10]))]
        return write_json_log(tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap", [*frames, *said])

    def starts(log: Path, **rule: Any) -> list[tuple[float, float]]:
        return [(cut.start_s, round(cut.duration_s, 6)) for cut in preview(log, task({"by": "topic", **rule}))[0]]

    nested = events(
        *(Said(t, "/m", "own/Event", {"info": {"event": e}, "x": 0}) for t, e in ((1.0, "begin"), (2.0, "end")))
    )
    assert starts(nested, topic="/m", field="info.event", start="begin", stop="end") == [(1.0, 1.0)]
    words = events(number(1.0, "start", "/m"), number(3.0, "stop", "/m"))
    assert starts(words, topic="/m") == [(1.0, 2.0)]
    empty = {"structure_needs_at_least_one_member": 0}
    calls = events(Said(0.5, "/begin", "std_msgs/msg/Empty", empty), Said(2.5, "/end", "std_msgs/msg/Empty", empty))
    assert starts(calls, topic="/begin", stop_topic="/end") == [(0.5, 2.0)]


def test_demonstrations_that_a_log_tells_apart_are_cut_further_and_never_joined(tmp_path: Path) -> None:
    store = write_zarr(tmp_path / "replay.zarr", episode_lengths=(12, 9))
    spec = zarr_task_spec(episodes={"by": "gap", "gap_s": 50.0})
    names = [cut.name for cut in preview(store.path, spec)[0]]
    rows = [{"start": 0, "end": 0.5}, {"start": 1.0, "end": 1.5}, {"start": 50, "end": 51}]
    cuts, notes = preview(store.path, zarr_task_spec(episodes={"by": "r.csv", "rows": rows}))
    assert [(cut.name, round(cut.duration_s, 6)) for cut in cuts] == [
        ("episode_000-at-00000.000s", 0.5),
        ("episode_000-at-00001.000s", 0.2),
        ("episode_001-at-00001.000s", 0.3),
    ]
    assert "reaching outside the log's 2.1 s of 2 demonstrations" not in notes[0]
    assert "outside the log's 2.1 s of 2 demonstrations, and left out: " in notes[0]
    assert names == ["episode_000-at-00000.000s", "episode_001-at-00001.200s"]
    assert len(ingest(store.path, tmp_path / "data", spec).written) == 2
