"""The history of a dataset: what is recorded, what an undo brings back, what gc gives up, what kill -9 leaves."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.faults import tree
from tests.stored_episodes import KEYS, VIEWS, episode, write_dataset
from tests.surgery_operations import operate, other_dataset, split
from tests.synthetic import task_spec, write_mcap, write_zarr, zarr_task_spec
from vilp_data import shards
from vilp_data.dataset_split import find_split
from vilp_data.dataset_state import DatasetState, read_state
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import StoreError, UsageError
from vilp_data.history import read_history, state_after
from vilp_data.ingest import ingest_logs
from vilp_data.latents import latents_path
from vilp_data.surgery import garbage
from vilp_data.surgery.garbage import collect_garbage
from vilp_data.surgery.merge import merge_datasets
from vilp_data.surgery.operations import plan_trim, relabel_episodes, remove_episodes, trim_episodes
from vilp_data.surgery.state_diff import compare_states
from vilp_data.surgery.undo import undo


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Episodes a, b, c, d with latents and a split, written by no verb."""
    write_dataset(tmp_path / "data", *(episode(name, 20 + i) for i, name in enumerate("abcd")))
    return tmp_path / "data"


# --- log ---------------------------------------------------------------------------------------------------------------------


def test_every_verb_that_changes_a_dataset_is_in_its_log(tmp_path: Path) -> None:
    log, root = write_zarr(tmp_path / "replay.zarr", episode_lengths=(12, 9, 5, 8)), tmp_path / "data"
    ingest_logs([log.path], root, zarr_task_spec(), workers=1)
    split(root)
    relabel_episodes(root, ["replay-episode_000"], labels={"operator": "anna"})
    remove_episodes(root, ["replay-episode_003"], reason="dull")
    ingest_logs([log.path], root, zarr_task_spec(), workers=1)  # nothing to do: nothing to say
    split(root)
    entries = read_history(root)
    assert [(entry.number, entry.what, entry.n_episodes) for entry in entries] == [
        (1, "ingest", 4), (2, "split", 4), (3, "relabel", 4), (4, "remove", 3),
    ]  # fmt: skip
    assert entries[3].note == "1 episode (replay-episode_003) removed: dull"
    assert all(later.before == earlier.after for earlier, later in pairwise(entries))
    assert entries[0].before == DatasetState().digest
    assert entries[-1].after == read_state(root).digest


def test_what_no_verb_did_is_found_and_recorded(root: Path) -> None:
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    EpisodeStore(root).steps_path("d").unlink()
    relabel_episodes(root, ["a"], labels={"operator": "ben"})
    assert [(entry.what, entry.n_episodes) for entry in read_history(root)] == [
        ("found", 4), ("relabel", 4), ("found", 3), ("relabel", 3),
    ]  # fmt: skip
    assert [undo(root).undoes, undo(root).undoes] == [4, 2]  # what was changed by hand is none of theirs
    with pytest.raises(UsageError, match="no operation to take back"):
        undo(root)


def test_a_damaged_history_says_so_and_the_dataset_still_reads(root: Path) -> None:
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    (root / "history" / "0002.json").write_text('{"format": 1, "number": 2')
    with pytest.raises(StoreError, match="0002.json"):
        read_history(root)
    assert len(EpisodeStore(root).index()) == 4
    damaged: list[str] = []
    assert [entry.number for entry in read_history(root, damaged)] == [1]
    assert "0002.json" in damaged[0]


def test_a_damaged_entry_hinders_no_operation_after_it(root: Path) -> None:
    before = tree(root)
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    (root / "history" / "0001.json").write_text("{")
    operate(root, "trim")
    assert (undo(root).undoes, undo(root).undoes) == (3, 2)
    assert tree(root) == before
    (root / "history" / "0005.json").write_text("{")
    operate(root, "trim")
    entries = read_history(root, [])
    assert [(entry.number, entry.what) for entry in entries[-2:]] == [(6, "found"), (7, "trim")]
    assert undo(root).undoes == 7
    with pytest.raises(UsageError, match=r"operation 3 cannot be taken back(.|\n)*damaged"):
        undo(root, 3)


# --- diff --------------------------------------------------------------------------------------------------------------------


def test_a_diff_names_episodes_labels_content_and_sides(root: Path) -> None:
    split(root, redraw=True)
    operate(root, "remove")
    operate(root, "trim")
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    difference = compare_states(state_after(root, 1), read_state(root))
    assert (difference.only_first, difference.only_second) == (("b", "d"), ())
    assert difference.labels == {"a": {"operator": (None, "anna")}}
    assert difference.content == {"a": "20 -> 12 steps", "c": "22 -> 12 steps"}
    assert "removed.json" in difference.files
    assert compare_states(read_state(root), read_state(root)).same


def test_a_diff_of_two_datasets_knows_an_episode_by_its_content(root: Path) -> None:
    there = root.parent / "there"
    write_dataset(there, episode("a", 20), episode("b", 21))
    state = read_state(there)
    renamed = DatasetState({"z": state.episodes["a"], "b": state.episodes["b"]}, state.files)
    difference = compare_states(read_state(root), renamed)
    assert difference.renamed == (("a", "z"),)
    assert difference.only_first == ("c", "d")


# --- merge -------------------------------------------------------------------------------------------------------------------


def test_a_merge_takes_what_is_new_with_its_latents_by_links(root: Path) -> None:
    other, lock = other_dataset(root.parent / "other"), find_split(root)
    there = tree(other)
    report = merge_datasets(other, root)
    assert report.here == ["b"]
    assert report.renamed.keys() == {"c"}
    named = report.renamed["c"]
    assert report.added == sorted([named, "e"])
    assert report.latents == 4
    assert tree(other) == there
    assert find_split(root) == lock
    store, theirs = EpisodeStore(root), EpisodeStore(other)
    for here, was in ((named, "c"), ("e", "e")):
        assert store.read(here).low_dim.tobytes() == theirs.read(was).low_dim.tobytes()
        for view in VIEWS:
            assert store.frames_path(view, here).samefile(theirs.frames_path(view, was))
            one, two = (latents_path(folder, view, KEYS[view], id) for folder, id in ((root, here), (other, was)))
            assert one.samefile(two)
    assert merge_datasets(other, root).operation is None


def test_a_merge_keeps_what_was_decided_here(root: Path) -> None:
    other = other_dataset(root.parent / "other")
    relabel_episodes(other, ["b"], labels={"operator": "ben"})
    trim_episodes(other, plan_trim(other, ["b"], steps=(2, 12)))
    merge_datasets(other, root)
    remove_episodes(root, ["e"])
    report = merge_datasets(other, root)
    assert (report.added, report.removed) == ([], ["e"])
    assert report.notes == ["b: trimmed to other steps and labelled otherwise there; it stays as it is here"]


def test_datasets_that_do_not_fit_are_refused_in_words(root: Path, tmp_path: Path) -> None:
    logs = [write_mcap(tmp_path / f"{i}.mcap", jitter_s=0.001, seed=i) for i in range(2)]
    spec = task_spec(logs[0])
    ingest_logs([logs[0].path], tmp_path / "one", spec, workers=1)
    table = spec.model_dump(by_alias=True)
    table["views"]["front"] |= {"height": 24, "width": 32}
    ingest_logs([logs[1].path], tmp_path / "two", spec.model_validate(table), workers=1)
    before = tree(tmp_path / "one")
    with pytest.raises(UsageError, match=r"different specs(.|\n)*views.front.height: 48 -> 24"):
        merge_datasets(tmp_path / "two", tmp_path / "one")
    with pytest.raises(UsageError, match="into itself"):
        merge_datasets(tmp_path / "one", tmp_path / "one" / ".." / "one")
    with pytest.raises(UsageError, match="not a dataset"):
        merge_datasets(tmp_path / "nowhere", tmp_path / "one")
    assert tree(tmp_path / "one") == before
    assert not (tmp_path / "nowhere").exists()
    other = other_dataset(tmp_path / "other")
    EpisodeStore(other).frames_path("front", "e").unlink()
    with pytest.raises(StoreError, match="nothing was taken"):
        merge_datasets(other, root)
    assert len(EpisodeStore(root).index()) == 4


def test_a_merge_takes_nothing_of_a_dataset_with_damaged_bytes(root: Path) -> None:
    other, before = other_dataset(root.parent / "other"), tree(root)
    damaged = EpisodeStore(other).frames_path("side", "e")
    data = bytearray(damaged.read_bytes())
    data[-5] ^= 1
    damaged.write_bytes(data)
    with pytest.raises(StoreError, match="checksum"):
        merge_datasets(other, root)
    assert tree(root) == before


def test_damaged_latents_are_left_behind_by_a_merge(root: Path) -> None:
    other = other_dataset(root.parent / "other")
    damaged = latents_path(other, "side", KEYS["side"], "e")
    data = bytearray(damaged.read_bytes())
    data[-5] ^= 1
    damaged.write_bytes(data)
    assert merge_datasets(other, root).latents == 3
    assert not latents_path(root, "side", KEYS["side"], "e").exists()


def test_a_merge_across_file_systems_copies(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: Path, target: Path) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(Path, "hardlink_to", refused)
    merge_datasets(other_dataset(root.parent / "other"), root)
    theirs = EpisodeStore(root.parent / "other").frames_path("front", "e")
    assert not EpisodeStore(root).frames_path("front", "e").samefile(theirs)
    shards.verify_shard(EpisodeStore(root).frames_path("front", "e"))


# --- gc ----------------------------------------------------------------------------------------------------------------------


def test_gc_deletes_what_nothing_refers_to_and_says_how_much(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(garbage, "run_encoder", lambda run, view: None)  # the run of another kind of model
    for folder in ("logs", "runs/vqgan-tiny"):
        (root / folder).mkdir(parents=True)
        (root / folder / "kept.bin").write_bytes(b"x" * 100)
        (root / folder / ".new.tmp").write_bytes(b"x")
    operate(root, "remove")
    stray = EpisodeStore(root).frames_path("front", "gone")
    shards.write_shard(stray, {"frames": episode("gone", 5).frames["front"]}, {})
    everything = tree(root)
    dry = collect_garbage(root, keep=0, dry_run=True)
    assert not dry.deleted
    assert tree(root) == everything
    whys = {one.why for one in dry.found}
    assert whys == {"held for the undo of operation 2", "frames without an episode", "latents of frames that are gone"}
    assert dry.size > 2 * (20 * 8 * 16 * 3)
    kept = collect_garbage(root)
    assert {one.why for one in kept.found} == {"frames without an episode"}  # the removed ones can still come back
    done = collect_garbage(root, keep=0)
    assert not any("/b." in name or "/d." in name for name in tree(root))
    assert not (root / "history" / "held").exists()
    assert done.size > 0
    for folder in ("logs", "runs/vqgan-tiny"):
        assert sorted(path.name for path in (root / folder).iterdir()) == [".new.tmp", "kept.bin"]
    with pytest.raises(UsageError, match="given up|can no longer"):
        undo(root)
    assert [entry.what for entry in read_history(root)] == ["found", "remove", "gc", "gc"]
    assert collect_garbage(root, keep=0).found == []


def test_a_dry_run_of_gc_deletes_nothing_not_even_what_a_killed_writer_left(root: Path) -> None:
    left = [EpisodeStore(root).steps_path("a").with_name(".x.safetensors.99.tmp"), root / "action_sets" / ".y.9.tmp"]
    for path in left:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x" * 1000)
    dry = collect_garbage(root, dry_run=True)
    assert sorted(one.path for one in dry.found) == sorted(left)
    assert dry.size == 2000
    assert all(path.is_file() for path in left)
    collect_garbage(root)
    assert not any(path.exists() for path in left)


def test_gc_refuses_a_run_that_is_none(root: Path, tmp_path: Path) -> None:
    (tmp_path / "vqgan-empty").mkdir()
    for run in (tmp_path / "nowhere", tmp_path / "vqgan-empty"):
        with pytest.raises(UsageError, match="not the run of a frame encoder"):
            collect_garbage(root, runs=[run], dry_run=True)


def test_gc_keeps_the_latents_of_known_encoders_only(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fields = {"weights": "w1", "device": "cuda", "compute": "bf16"}
    frames = EpisodeStore(root).entry("a").frames_sha256["front"]
    for key, made_by in (("same", {**fields, "device": "cpu"}), ("other", {**fields, "weights": "w2"})):
        header = {"source_frames_sha256": frames, "encoder": json.dumps(made_by)}
        latents = shards.read_shard(latents_path(root, "front", KEYS["front"], "a")).arrays
        shards.write_shard(latents_path(root, "front", key, "a"), latents, header)
    assert not collect_garbage(root, dry_run=True).found  # no run: nobody can tell
    (root / "runs" / "vqgan").mkdir(parents=True)
    monkeypatch.setattr(garbage, "run_encoder", lambda run, view: SimpleNamespace(key_fields=fields))
    found = {one.path.parent.name for one in collect_garbage(root, dry_run=True).found}
    assert found == {"other", *KEYS.values()}  # those of the fixture say nothing of their encoder
