"""What is known again by a later ingest: logs that have grown or were written anew, ranges that were edited, episodes that were removed."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tests.faults import kill_after, tree
from tests.json_log import START_NS, S, Said, image, joints, number, transform, write_json_log
from tests.synthetic import task_spec, write_mcap
from tests.synthetic_bags import write_rosbag1, write_rosbag2
from tests.test_cut_log import GAP, task
from tests.video_logs import JOINTS, PERIOD_NS, VIDEO, Row, spec_of, write_log
from tests.video_logs import joints as video_joints
from tests.video_packets import encode, numbered_frames, video_message
from vilp_data import shards
from vilp_data.cut_identity import Cut, cut_sha256
from vilp_data.episode_entry import header_of
from vilp_data.episodes import EpisodeStore
from vilp_data.held_messages import held_sha256
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.sources import open_log
from vilp_data.sources.mcap_log import McapLog
from vilp_data.spec import TaskSpec
from vilp_data.surgery.operations import plan_trim, relabel_episodes, remove_episodes, trim_episodes
from vilp_data.surgery.undo import undo
from vilp_data.task_toml import load_task
from vilp_data.types import LogEpisode

BURSTS = ((0.0, 20), (5.0, 12), (10.0, 15))
"""Seconds, images at 10 Hz."""


def write_bursts(
    path: Path, bursts: Sequence[tuple[float, int]] = BURSTS, *, offset: Mapping[float, float] | None = None
) -> Path:
    """`offset`: start of a burst -> how much further the joint is in it."""
    said: list[Said] = []
    for start, count in bursts:
        for k in range(count):
            t = start + k / 10
            said += [image(t, index=k), joints(t, ["a"], [round(t + (offset or {}).get(start, 0), 1)])]
    return write_json_log(path, said)


def write_anew(log: Path, to: Path) -> Path:
    """The same messages in other bytes: neither compressed nor chunked alike."""
    to.parent.mkdir(parents=True, exist_ok=True)
    with log.open("rb") as old, to.open("wb") as new:
        reader, writer = make_reader(old), Writer(new, compression=CompressionType.NONE, chunk_size=9_000)
        writer.start(library="written anew")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels:
                if schema is not None and schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                known = schemas[schema.id] if schema is not None else 0
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()
    assert to.read_bytes() != log.read_bytes()
    return to


def two_runs(folder: Path) -> tuple[Path, Path, TaskSpec]:
    """A dataset of a.mcap and b.mcap; a.mcap, uncut; the spec."""
    logs = [write_mcap(folder / f"{name}.mcap", jitter_s=0.001, seed=i) for i, name in enumerate("ab")]
    spec = task_spec(logs[0])
    ingest_logs([log.path for log in logs], folder / "data", spec, workers=1)
    return folder / "data", logs[0].path, spec


def ingest(log: Path, root: Path, spec: TaskSpec, **options: bool) -> IngestReport:
    return ingest_logs([log], root, spec, workers=1, **options)


def ids(root: Path) -> list[str]:
    return [entry.id for entry in EpisodeStore(root).index()]


# --- a log that has grown --------------------------------------------------------------------------------------------------------


def test_a_cut_log_that_has_grown_adds_what_is_new_and_keeps_every_decision(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    first, second, third = ingest(log, root, task(GAP)).written
    remove_episodes(root, [first], reason="dropped")
    relabel_episodes(root, [second], labels={"operator": "anna"})
    trim_episodes(root, plan_trim(root, [third], steps=(2, 12)))
    before = tree(root)
    write_bursts(log, (*BURSTS, (20.0, 14)))
    report = ingest(log, root, task(GAP))
    assert report.written == ["run-at-00020.000s"]
    assert (report.fresh, report.removed, report.replaced, report.notes) == ([second, third], [first], [], [])
    after = tree(root)
    assert {name: after[name] for name in before if "index" not in name} == {
        name: data for name, data in before.items() if "index" not in name
    }


def test_a_demonstration_that_went_on_replaces_its_episode_and_keeps_its_labels(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    last = ingest(log, root, task(GAP)).written[-1]
    relabel_episodes(root, [last], labels={"operator": "anna"})
    trim_episodes(root, plan_trim(root, [last], steps=(2, 12)))
    before = tree(root)
    write_bursts(log, (*BURSTS[:2], (10.0, 30)))
    report = ingest(log, root, task(GAP))
    assert report.written == report.replaced == [last]
    assert len(ids(root)) == 3
    entry = EpisodeStore(root).entry(last)
    assert (entry.n_steps, entry.tags["operator"]) == (30, "anna")
    assert [note for note in report.notes if "its trim no longer holds" in note]
    undo(root)
    assert tree(root) == before


def test_a_cut_whose_messages_changed_is_ingested_anew_in_its_place(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    names = ingest(log, root, task(GAP)).written
    relabel_episodes(root, [names[1]], labels={"operator": "anna"})
    write_bursts(log, offset={5.0: 2.0})  # in as many bytes
    report = ingest(log, root, task(GAP))
    assert report.written == report.replaced == [names[1]]
    assert report.fresh == [names[0], names[2]]
    assert "its labels no longer hold" in report.notes[0]
    np.testing.assert_allclose(EpisodeStore(root).read(names[1]).low_dim[0, 0], 7.0, atol=1e-6)


def test_a_removed_demonstration_that_went_on_stays_out(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    last = ingest(log, root, task(GAP)).written[-1]
    remove_episodes(root, [last])
    write_bursts(log, (*BURSTS[:2], (10.0, 30)))
    assert ingest(log, root, task(GAP)).removed == [last]
    assert ingest(log, root, task(GAP), again=True).written == [last]
    assert len(ids(root)) == 3


@pytest.mark.parametrize("shift_s", [0.0, 100.0])
def test_another_log_of_the_same_name_and_length_replaces_nothing(tmp_path: Path, shift_s: float) -> None:
    """Simulators start their clock anew: not even the times need differ."""
    root = tmp_path / "data"
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
    one = write_bursts(tmp_path / "monday" / "run.mcap")
    before = ingest(one, root, task(GAP)).written
    bursts = tuple((start + shift_s, count) for start, count in BURSTS)
    other = write_bursts(tmp_path / "tuesday" / "run.mcap", bursts, offset={start: 3.0 for start, _ in bursts})
    report = ingest(other, root, task(GAP))
    assert (len(report.written), report.replaced) == (3, [])
    assert set(before) < set(ids(root))


def test_a_cut_log_under_another_spec_gives_the_same_episodes_with_their_labels(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    names = ingest(log, root, task(GAP)).written
    relabel_episodes(root, [names[0]], labels={"operator": "anna"})
    trim_episodes(root, plan_trim(root, [names[0]], steps=(2, 12)))
    other_topics = task(GAP, low_dim={})
    assert ingest(log, root, other_topics).written == names
    entry = EpisodeStore(root).entry(names[0])
    assert (ids(root), entry.tags["operator"], entry.n_steps) == (names, "anna", 10)


@pytest.mark.parametrize("kind", ["mcap", "rosbag1", "rosbag2"])
def test_a_cut_is_known_by_its_own_messages_however_the_log_is_packed(tmp_path: Path, kind: str) -> None:
    log = write_mcap(tmp_path / "a.mcap", height=16, width=24)
    if kind == "mcap":
        packed = [log.path, write_anew(log.path, tmp_path / "anew.mcap")]
    elif kind == "rosbag1":
        packed = [write_rosbag1(tmp_path / f"{c}.bag", log, compression=c) for c in ("none", "lz4")]  # type: ignore[arg-type]
    else:
        packed = [write_rosbag2(tmp_path / f"bag-{c}", log, compression=c) for c in ("none", "file")]  # type: ignore[arg-type]
    hashes = []
    for path in packed:
        with open_log(path) as opened:
            start_ns, topics = opened.episodes()[0].start_ns, tuple(sorted(topic.name for topic in opened.topics()))
            cuts = [Cut(start_ns, start_ns + length * S // 2, topics) for length in (1, 2)]
            hashes.append([cut_sha256(opened, cut, opened.sha256(), lambda what, find: find()) for cut in cuts])
    assert hashes[0] == hashes[1]
    assert hashes[0][0] != hashes[0][1]


def two_arms(path: Path, *, swapped: bool = False) -> Path:
    """Joints of a left arm that goes up, and of a right one that goes down, in two bursts; on each other's topics where `swapped`."""
    left, right = ("/right", "/left") if swapped else ("/left", "/right")
    said: list[Said] = []
    for t in (start + k / 10 for start in (0.0, 5.0) for k in range(15)):
        said += [image(t, index=round(t * 10)), joints(t, ["a"], [t], left), joints(t, ["a"], [-t], right)]
    return write_json_log(path, said)


@pytest.mark.parametrize("later", ["run.mcap", "other.mcap"])
def test_messages_of_two_topics_that_were_mistaken_for_each_other_are_no_copy(tmp_path: Path, later: str) -> None:
    root = tmp_path / "data"
    spec = task(GAP, low_dim={"left": {"topic": "/left"}, "right": {"topic": "/right"}})
    ingest(two_arms(tmp_path / "run.mcap", swapped=True), root, spec)
    mended = two_arms(tmp_path / later)
    report = ingest_logs([tmp_path / "run.mcap", mended] if later == "other.mcap" else [mended], root, spec, workers=1)
    assert len(report.written) == 2
    np.testing.assert_allclose(EpisodeStore(root).read(report.written[1]).low_dim[0], [5, -5], atol=1e-6)


def test_the_numbers_of_channels_in_the_files_of_a_bag_do_not_matter(tmp_path: Path) -> None:
    first = [
        joints(k / 10, ["a"], [k * way], topic) for k in range(20) for way, topic in ((1, "/left"), (-1, "/right"))
    ]
    hashes = []
    for name, swapped in (("alike", False), ("otherwise", True)):
        bag = tmp_path / name
        bag.mkdir()
        halves = first[:20], [*first[21:22], *first[20:21], *first[22:]] if swapped else first[20:]
        files = [write_json_log(bag / f"{name}_{i}.mcap", half).name for i, half in enumerate(halves)]
        listed = "".join(f"    - {file}\n" for file in files)
        (bag / "metadata.yaml").write_text(
            "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n"
            f"  relative_file_paths:\n{listed}  message_count: 40\n  compression_format: ''\n  compression_mode: ''\n"
        )
        with open_log(bag) as log:
            assert len(list(log.messages(["/left", "/right"]))) == 40
            hashes.append(
                cut_sha256(log, Cut(START_NS, START_NS + 3 * S, ("/left", "/right")), "", lambda _, find: find())
            )
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize("changed", ["static transform", "command"])
def test_a_cut_is_made_anew_where_what_holds_in_it_from_before_was_corrected(tmp_path: Path, changed: str) -> None:
    def write(x: float, command: float) -> Path:
        said = [transform(0.0, "base", "camera", x, "/tf_static"), number(0.2, command, "/command")]
        for t in (start + k / 10 for start in (0.0, 5.0, 10.0) for k in range(15)):
            said += [image(t, index=round(t * 10)), transform(t, "camera", "tool", t)]
        return write_json_log(tmp_path / "run.mcap", [*said, number(9.9, 9.0, "/command")])

    pose = {"topic": "/tf", "from_frame": "base", "to_frame": "tool"}
    spec = task(GAP, low_dim={"pose": pose}, action={"target": {"topic": "/command", "clock": "log"}})
    root = tmp_path / "data"
    names = ingest(write(1.0, 1.0), root, spec).written
    relabel_episodes(root, [names[1]], labels={"operator": "anna"})
    key = EpisodeStore(root).entry(names[1]).key
    static = changed == "static transform"
    log = write(2.0, 1.0) if static else write(1.0, 4.0)
    report = ingest(log, root, spec)
    assert report.written == report.replaced == (names if static else names[:2])
    assert ids(root) == names
    middle = EpisodeStore(root).read(names[1])
    assert middle.action is not None
    np.testing.assert_allclose((middle.low_dim[0, 0], middle.action[0, 0]), (7, 1) if static else (6, 4), atol=1e-6)
    entry = EpisodeStore(root).entry(names[1])
    assert (entry.tags["operator"], entry.key == key) == ("anna", False)
    assert ingest(log, root, spec).fresh == names


@pytest.mark.parametrize("left_out", [2, 8, 18])
def test_packets_that_a_video_s_decoder_needs_first_are_part_of_a_cut(tmp_path: Path, left_out: int) -> None:
    sent = encode(numbered_frames(20), "h264")
    cut = LogEpisode("cut", START_NS + 6 * PERIOD_NS, START_NS + 16 * PERIOD_NS)
    found = []
    for name, packets in (("all", sent), ("some", [*sent[:left_out], None, *sent[left_out + 1 :]])):
        rows = [
            Row(START_NS + i * PERIOD_NS, VIDEO, video_message(packet.data, "h264").body)
            for i, packet in enumerate(packets)
            if packet is not None
        ]
        with open_log(write_log(tmp_path / f"{name}.mcap", [*rows, *video_joints(20)])) as log:
            place = Cut(cut.start_ns, cut.end_ns, (JOINTS, VIDEO))
            forget: Any = lambda _, find: find()  # noqa: E731
            found.append((cut_sha256(log, place, "", forget), held_sha256(log, cut, spec_of(VIDEO), "", forget)))
    assert [one == other for one, other in zip(*found, strict=True)] == [left_out != 8, left_out != 2]


def test_the_times_in_a_log_are_asked_for_once_however_many_cuts_look_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = [number(0.1, 1.0, "/command")]
    for t in (3.0 * start + k / 10 for start in range(8) for k in range(5)):
        said += [image(t, index=1), joints(t, ["a"], [t])]
    log = write_json_log(tmp_path / "run.mcap", said)
    spec = task(GAP, action={"target": {"topic": "/command", "clock": "log"}})
    asked, whole = [], McapLog.message_times
    monkeypatch.setattr(McapLog, "message_times", lambda log: asked.append(log) or whole(log))
    assert len(ingest(log, tmp_path / "data", spec).written) == 8
    assert len(asked) == 3  # for the gaps, what holds in the cuts, and their episodes


@pytest.mark.parametrize("changed", [(5.0, 10.0), (0.0,)], ids=["most", "some"])
def test_an_edited_log_is_ingested_alike_wherever_an_ingest_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: tuple[float, ...]
) -> None:
    log = tmp_path / "run.mcap"
    for root in ("whole", "killed"):
        names = ingest(write_bursts(log), tmp_path / root, task(GAP)).written
        write_bursts(log, offset=dict.fromkeys(changed, 2.0))
        if root == "killed":
            with monkeypatch.context() as patch:
                kill_after(1, patch)
                with contextlib.suppress(KeyboardInterrupt):
                    ingest(log, tmp_path / root, task(GAP))
        ingest(log, tmp_path / root, task(GAP))
        assert len(ids(tmp_path / root)) == len(names) + (2 if len(changed) == 2 else 0)
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


def test_a_damaged_stretch_of_a_log_keeps_no_other_cut_back(tmp_path: Path) -> None:
    log, root = write_anew(write_bursts(tmp_path / "run.mcap"), tmp_path / "many_chunks.mcap"), tmp_path / "data"
    whole = log.read_bytes()
    with log.open("rb") as stream:
        chunks = (make_reader(stream).get_summary() or pytest.fail("no summary")).chunk_indexes
    middle = chunks[len(chunks) // 2]
    place = middle.chunk_start_offset + middle.chunk_length // 2
    log.write_bytes(whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :])
    report = ingest(log, root, task(GAP))
    assert report.written
    assert report.failed
    assert ingest(log, root, task(GAP)).fresh == report.written


def test_the_same_picture_at_another_time_is_another_episode(tmp_path: Path) -> None:
    """A camera that looks at a wall: equal content is no proof."""
    root, spec = tmp_path / "data", task({"by": "file"}, low_dim={})
    for day, start in (("monday", 0.0), ("tuesday", 60.0)):
        (tmp_path / day).mkdir()
        said = [image(start + k / 10, index=k) for k in range(8)]
        report = ingest(write_json_log(tmp_path / day / "run.mcap", said), root, spec)
        assert len(report.written) == 1
    assert len(ids(root)) == 2


# --- what a ranges file says ----------------------------------------------------------------------------------------------------


def with_ranges(folder: Path, text: str) -> TaskSpec:
    (folder / "ranges.csv").write_text(text)
    (folder / "task.toml").write_text(
        'name = "session"\nrate_hz = 10.0\n[low_dim.joints]\ntopic = "/joint_states"\n'
        '[views.front]\ntopic = "/camera/front/image"\nheight = 48\nwidth = 64\n[episodes]\nby = "ranges.csv"\n'
    )
    return load_task(str(folder / "task.toml"))


def test_corrected_labels_and_names_of_a_ranges_file_reach_the_stored_episodes(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    ingest(log, root, with_ranges(tmp_path, "start,end,name,success\n0,1.5,one,true\n5,6,two,true\n10,11,three,true\n"))
    relabel_episodes(root, ["run-two"], labels={"operator": "anna"})
    frames = {name: data for name, data in tree(root).items() if "/frames/" in name}
    before = tree(root)
    corrected = "start,end,name,success,operator\n0,1.5,uno,false,kim\n5,6,two,false,kim\n10,11,three,true,\n"
    report = ingest(log, root, with_ranges(tmp_path, corrected))
    assert (report.written, report.restated) == ([], ["run-one", "run-two"])
    one, two = (EpisodeStore(root).entry(id) for id in ("run-one", "run-two"))
    assert (one.outcome, one.tags["operator"], one.source_episode) == ("failure", "kim", "uno")
    assert (two.outcome, two.tags["operator"]) == ("failure", "anna")  # a label outranks the file
    assert {name: data for name, data in tree(root).items() if "/frames/" in name} == frames
    assert any("run-one: a failure now" in note and "remove run-one" in note for note in report.notes)
    assert any("called uno" in note for note in report.notes)
    assert ingest(log, root, with_ranges(tmp_path, corrected)).restated == []
    undo(root)
    assert {name: data for name, data in tree(root).items() if name != "dataset.json"} == {
        name: data for name, data in before.items() if name != "dataset.json"
    }


def test_a_range_that_was_edited_replaces_the_episode_that_it_overlaps(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    ingest(log, root, with_ranges(tmp_path, "start,end\n0.5,1.5\n"))
    relabel_episodes(root, ["run-at-00000.500s"], labels={"operator": "anna"})
    report = ingest(log, root, with_ranges(tmp_path, "start,end\n0.3,1.8\n10,11\n"))
    assert report.written == ["run-at-00000.500s", "run-at-00010.000s"]
    assert report.replaced == ["run-at-00000.500s"]
    entry = EpisodeStore(root).entry("run-at-00000.500s")
    assert (entry.n_steps, entry.tags["operator"], entry.source_episode) == (15, "anna", "at-00000.300s")


def test_a_stored_demonstration_that_failed_and_was_cut_otherwise_is_not_left_as_it_was(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    (name,) = ingest(log, root, with_ranges(tmp_path, "start,end,success\n0,1.5,true\n")).written
    report = ingest(log, root, with_ranges(tmp_path, "start,end,success\n0.2,1.5,false\n"))
    assert (report.replaced, report.left_out) == ([name], [])
    assert EpisodeStore(root).entry(name).outcome == "failure"
    assert any(f"{name}: a failure now" in note for note in report.notes)


def test_a_range_that_was_parted_in_two_leaves_no_overlap(tmp_path: Path) -> None:
    log, root = write_bursts(tmp_path / "run.mcap"), tmp_path / "data"
    ingest(log, root, with_ranges(tmp_path, "start,end\n0,1.9\n"))
    report = ingest(log, root, with_ranges(tmp_path, "start,end\n0,0.7\n0.8,1.9\n"))
    assert (len(report.written), len(report.replaced)) == (2, 1)
    ticks = [EpisodeStore(root).read(id).log_time_ns for id in ids(root)]
    assert len(np.intersect1d(*ticks)) == 0


# --- datasets of before -----------------------------------------------------------------------------------------------------------


def test_an_episode_stored_before_there_were_cuts_stays_fresh_byte_for_byte(tmp_path: Path) -> None:
    """Header and key as the earlier version wrote them, spelled out."""
    from vilp_data.keys import digest

    log, root = write_mcap(tmp_path / "run.mcap"), tmp_path / "data"
    spec = task_spec(log)
    ingest(log.path, root, spec)
    store = EpisodeStore(root)
    with open_log(log.path) as opened:
        sha256, name = opened.sha256(), opened.episodes()[0].name
    entry = store.entry("run")
    assert entry.source_sha256 == sha256
    assert entry.key == digest({"format": 1, "source": sha256, "episode": name, "ingest": spec.ingest_fields()})
    old: dict[str, Any] = header_of(entry)
    assert not {"cut", "edits"} & old.keys()
    shards.write_shard(store.steps_path("run"), shards.read_shard(store.steps_path("run")).arrays, old)
    before = tree(root)
    report = ingest(log.path, root, spec)
    assert (report.written, report.fresh, report.restated) == ([], ["run"], [])
    assert tree(root) == before


def test_a_list_of_removed_episodes_of_before_is_read(tmp_path: Path) -> None:
    import json

    root, log, spec = two_runs(tmp_path)
    remove_episodes(root, ["a"])
    table = json.loads((root / "removed.json").read_text())
    for one in table["episodes"].values():
        for name in ("edits", "cut", "tick_ns"):
            del one[name]
    (root / "removed.json").write_text(json.dumps(table))
    assert ingest(log, root, spec).removed == ["a"]


def test_an_ingest_of_other_logs_does_not_join_a_killed_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its command says which logs; taking the second one back must leave what the first had stored."""
    import sys

    from vilp_data import ingest as module
    from vilp_data.history import read_history

    root, _, spec = two_runs(tmp_path)
    logs = [write_mcap(tmp_path / f"{name}.mcap", jitter_s=0.001, seed=7 + i).path for i, name in enumerate("cd")]

    def killed(*_: object, **__: object) -> None:
        raise SystemExit(137)

    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", ["vilp-data", "ingest", "c.mcap"])
        patch.setattr(module, "_keep_removed", killed)
        patch.setattr("vilp_data.history._close", lambda *_, **__: None)
        with pytest.raises(SystemExit):
            ingest(logs[0], root, spec)
    monkeypatch.setattr(sys, "argv", ["vilp-data", "ingest", "d.mcap"])
    ingest(logs[1], root, spec)
    last = read_history(root)[-2:]
    assert [(entry.interrupted, entry.command.split()[-1]) for entry in last] == [(True, "c.mcap"), (False, "d.mcap")]
    undo(root)
    assert ids(root) == ["a", "b", "c"]
