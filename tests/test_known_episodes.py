"""What is known again by a later ingest: logs that have grown or were written anew, ranges that were edited, episodes that were removed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tests.faults import tree
from tests.json_log import S, Said, image, joints, write_json_log
from tests.synthetic import task_spec, write_mcap
from tests.synthetic_bags import write_rosbag1, write_rosbag2
from tests.test_cut_log import GAP, task
from vilp_data import shards
from vilp_data.cut_identity import Cut, cut_sha256
from vilp_data.episode_entry import header_of
from vilp_data.episodes import EpisodeStore
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.removed import read_removed
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec, load_task
from vilp_data.surgery.operations import plan_trim, relabel_episodes, remove_episodes, trim_episodes
from vilp_data.surgery.undo import undo

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


# --- a log that was written anew --------------------------------------------------------------------------------------------------


@pytest.fixture
def runs(tmp_path: Path) -> tuple[Path, Path, TaskSpec]:
    """A dataset of a.mcap and b.mcap; a.mcap, uncut; the spec."""
    logs = [write_mcap(tmp_path / f"{name}.mcap", jitter_s=0.001, seed=i) for i, name in enumerate("ab")]
    spec = task_spec(logs[0])
    ingest_logs([log.path for log in logs], tmp_path / "data", spec, workers=1)
    return tmp_path / "data", logs[0].path, spec


def test_a_removed_episode_does_not_come_back_in_other_bytes(runs: tuple[Path, Path, TaskSpec], tmp_path: Path) -> None:
    root, log, spec = runs
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    trim_episodes(root, plan_trim(root, ["a"], steps=(3, 15)))
    remove_episodes(root, ["a"], reason="dropped")
    anew = write_anew(log, tmp_path / "anew" / "salvaged.mcap")
    report = ingest(anew, root, spec)
    assert (report.written, report.removed, ids(root)) == ([], ["a"], ["b"])
    assert read_removed(root)["a"].source == "salvaged.mcap"
    assert ingest(anew, root, spec).removed == ["a"]  # known by its bytes now
    assert ingest(anew, root, spec, again=True).written == ["a"]
    entry = EpisodeStore(root).entry("a")
    assert (entry.n_steps, entry.tags["operator"]) == (12, "anna")


def test_what_was_removed_comes_back_as_it_was_when_its_log_in_other_bytes_is_wanted_again(
    runs: tuple[Path, Path, TaskSpec], tmp_path: Path
) -> None:
    root, log, spec = runs
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    remove_episodes(root, ["a"])
    report = ingest(write_anew(log, tmp_path / "anew" / "a.mcap"), root, spec, again=True)
    assert (report.written, read_removed(root)) == (["a"], {})
    assert EpisodeStore(root).entry("a").tags["operator"] == "anna"


def test_labels_and_trim_of_a_removed_episode_are_there_when_it_is_wanted_again(
    runs: tuple[Path, Path, TaskSpec],
) -> None:
    root, log, spec = runs
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    trim_episodes(root, plan_trim(root, ["a"], steps=(3, 15)))
    steps = EpisodeStore(root).steps_path("a").read_bytes()
    remove_episodes(root, ["a"])
    assert ingest(log, root, spec, again=True).written == ["a"]
    assert EpisodeStore(root).steps_path("a").read_bytes() == steps


def test_a_stored_episode_in_other_bytes_is_known_and_not_stored_twice(
    runs: tuple[Path, Path, TaskSpec], tmp_path: Path
) -> None:
    root, log, spec = runs
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    key, before = EpisodeStore(root).entry("a").key, tree(root)
    anew = write_anew(log, tmp_path / "anew" / "a.mcap")
    report = ingest(anew, root, spec)
    assert (report.written, report.fresh, len(ids(root))) == ([], ["a"], 2)
    entry = EpisodeStore(root).entry("a")
    assert (entry.key, entry.tags["operator"]) == (key, "anna")  # a model that learnt from it still knows it
    done = tree(root)
    assert ingest(anew, root, spec).notes == []
    assert tree(root) == done
    undo(root)
    assert tree(root) == before


def test_the_same_picture_at_another_time_is_another_episode(tmp_path: Path) -> None:
    """A camera that looks at a wall: equal content is no proof."""
    root, spec = tmp_path / "data", task({"by": "file"}, low_dim={})
    for name, start in (("a", 0.0), ("b", 60.0)):
        said = [image(start + k / 10, index=k) for k in range(8)]
        report = ingest(write_json_log(tmp_path / f"{name}.mcap", said), root, spec)
        assert report.written == [name]


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


def test_a_list_of_removed_episodes_of_before_is_read(runs: tuple[Path, Path, TaskSpec]) -> None:
    import json

    root, log, spec = runs
    remove_episodes(root, ["a"])
    table = json.loads((root / "removed.json").read_text())
    for one in table["episodes"].values():
        for name in ("edits", "cut", "tick_ns"):
            del one[name]
    (root / "removed.json").write_text(json.dumps(table))
    assert ingest(log, root, spec).removed == ["a"]


def test_an_ingest_of_other_logs_does_not_join_a_killed_one(
    runs: tuple[Path, Path, TaskSpec], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its command says which logs; taking the second one back must leave what the first had stored."""
    import sys

    from vilp_data import ingest as module
    from vilp_data.history import read_history

    root, _, spec = runs
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
