"""Dataset surgery: what leaves, what stays readable, what a model still sees, and which words refuse the rest."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.fake_encoder import BlockMeans, encode_all, install
from tests.faults import tree
from tests.stored_episodes import KEYS, VIEWS, episode, write_dataset
from tests.synthetic import task_spec, write_mcap, write_zarr, zarr_task_spec
from vilp_data import shards
from vilp_data.dataset import WindowDataset
from vilp_data.dataset_split import check_dataset_split, find_split, update_split
from vilp_data.episode_files import open_frames, open_steps
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import BusyError, UsageError
from vilp_data.idle import moving_range
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.latents import latents_path, open_latents, read_latents
from vilp_data.pairs import PairDataset
from vilp_data.removed import read_removed
from vilp_data.spec import TaskSpec, WindowSpec
from vilp_data.surgery.operations import parse_steps, plan_trim, remove_episodes, trim_episodes
from vilp_data.types import Episode
from vilp_data.writer_lock import writer_lock


def moving(name: str, *, idle: int, moves: int, after: int) -> Episode:
    """Rests, moves evenly, rests again: low_dim and action alike."""
    one = episode(name, idle + moves + after)
    ramp = np.concatenate([np.zeros(idle), np.linspace(0, 1, moves), np.ones(after)])
    noise = np.random.default_rng(5).normal(0, 1e-4, (len(ramp), 4))
    low_dim = (ramp[:, None] * np.array([1, -2, 3, 0]) + noise).astype(np.float32)
    return dataclasses.replace(one, low_dim=low_dim, action=low_dim[:, :2].copy())


def split(root: Path, *, redraw: bool = False) -> None:
    update_split(root, ratio=0.5, ratio_from="task", seed=0, group_by=None, strata=(), redraw=redraw)


def ingest(logs: list[Path], root: Path, spec: TaskSpec, **options: bool) -> IngestReport:
    return ingest_logs(logs, root, spec, workers=1, **options)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Episodes a, b, c, d with latents and a split."""
    write_dataset(tmp_path / "data", *(episode(name, 20 + i) for i, name in enumerate("abcd")))
    return tmp_path / "data"


def ids(root: Path) -> list[str]:
    return [entry.id for entry in EpisodeStore(root).index()]


# --- remove ----------------------------------------------------------------------------------------------------------------


def test_removed_episodes_are_gone_and_the_others_untouched(root: Path) -> None:
    before, lock = tree(root), find_split(root)
    report = remove_episodes(root, ["b", "d"], reason="the gripper was open")
    assert (report.changed, ids(root)) == (["b", "d"], ["a", "c"])
    after = tree(root)
    kept = {
        name: data for name, data in before.items() if "/b." not in name and "/d." not in name and "index" not in name
    }
    assert kept.items() <= after.items()
    assert find_split(root) == lock
    assert read_removed(root)["b"].reason == "the gripper was open"
    assert EpisodeStore(root).index_path.is_file()


def test_removing_twice_does_nothing_and_an_unknown_id_names_the_nearest(root: Path) -> None:
    remove_episodes(root, ["b"])
    before = tree(root)
    again = remove_episodes(root, ["b"])
    assert (again.operation, again.notes) == (None, ["b: removed already, by operation 2"])
    assert tree(root) == before
    with pytest.raises(UsageError, match=r"no episode called 'aa'(.|\n)*did you mean 'a'"):
        remove_episodes(root, ["aa"])
    with pytest.raises(UsageError, match="no episode would be left"):
        remove_episodes(root, ["a", "c", "d"])


def test_a_dataset_that_another_process_writes_is_not_operated_on(root: Path) -> None:
    with writer_lock(root), pytest.raises(BusyError):
        remove_episodes(root, ["a"])


def test_a_removed_episode_stays_out_of_the_next_ingest_until_it_is_wanted_again(tmp_path: Path) -> None:
    log, root = write_zarr(tmp_path / "replay.zarr"), tmp_path / "data"
    ingest([log.path], root, zarr_task_spec())
    split(root)
    before = tree(root)
    remove_episodes(root, ["replay-episode_001"])
    report = ingest([log.path], root, zarr_task_spec())
    assert (report.written, report.removed) == ([], ["replay-episode_001"])
    assert len(ids(root)) == 2
    report = ingest([log.path], root, zarr_task_spec(), again=True)
    assert report.written == ["replay-episode_001"]
    assert read_removed(root) == {}
    assert {name: data for name, data in tree(root).items() if name != "removed.json"} == before


def test_a_new_log_does_not_take_the_name_of_a_removed_episode(tmp_path: Path) -> None:
    for folder, seed in (("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        log = write_mcap(tmp_path / folder / "run.mcap", jitter_s=0.001, seed=seed)
    other = write_mcap(tmp_path / "other.mcap", jitter_s=0.001, seed=3)
    root = tmp_path / "data"
    ingest([tmp_path / "a", other.path], root, task_spec(log))
    remove_episodes(root, ["run"])
    (new,) = ingest([tmp_path / "b"], root, task_spec(log)).written
    assert new.startswith("run-")


def test_what_was_removed_is_no_finding_of_the_split(root: Path) -> None:
    split(root, redraw=True)
    lock = find_split(root)
    assert lock is not None
    remove_episodes(root, [lock.ids("train")[0]])
    assert not [finding for finding in check_dataset_split(root) if "in the lock but not in the dataset" in finding]


# --- trim ------------------------------------------------------------------------------------------------------------------


def test_idle_ends_are_found_and_a_margin_is_kept(tmp_path: Path) -> None:
    write_dataset(tmp_path, moving("a", idle=30, moves=40, after=20), moving("b", idle=0, moves=40, after=0))
    cuts = {cut.id: cut for cut in plan_trim(tmp_path, margin_s=0.5)}
    assert abs(cuts["a"].first - 25) <= 2
    assert abs(cuts["a"].end - 75) <= 2
    assert not cuts["b"].cuts
    assert plan_trim(tmp_path, ["a"], margin_s=0)[0].first > cuts["a"].first
    trim_episodes(tmp_path, list(cuts.values()))
    assert not any(cut.cuts for cut in plan_trim(tmp_path, margin_s=0.5))


def test_a_short_rest_stays_whole(tmp_path: Path) -> None:
    write_dataset(tmp_path, moving("a", idle=8, moves=40, after=9), moving("b", idle=8, moves=40, after=30))
    cuts = {cut.id: cut for cut in plan_trim(tmp_path, margin_s=0.2)}
    assert not cuts["a"].cuts
    assert (cuts["b"].first, cuts["b"].end < 55) == (0, True)


def test_an_episode_in_which_nothing_moves_is_left_and_said(tmp_path: Path) -> None:
    write_dataset(tmp_path, moving("a", idle=20, moves=20, after=0), moving("still", idle=30, moves=0, after=0))
    cuts = {cut.id: cut for cut in plan_trim(tmp_path)}
    assert not cuts["still"].moves
    assert not cuts["still"].cuts


def test_invalid_steps_are_no_motion() -> None:
    values = np.concatenate([np.zeros(20), np.linspace(0, 1, 20), np.ones(20)])[:, None]
    valid = np.ones(60, np.bool_)
    values[[5, 50]], valid[[5, 50]] = 77.0, False
    first, end = moving_range(values, valid) or (0, 0)
    assert 18 <= first <= 22
    assert 38 <= end <= 42


def test_a_trim_rewrites_the_steps_file_alone_and_latents_stay_valid(root: Path) -> None:
    before, store = tree(root), EpisodeStore(root)
    whole, entry = store.read("c"), store.entry("c")
    latents = {view: np.array(open_latents(root, entry, view, KEYS[view])) for view in VIEWS}
    trim_episodes(root, plan_trim(root, ["c"], steps=(5, 17)))
    changed = {name for name in before if tree(root)[name] != before[name]}
    assert changed == {"episodes/steps/c.safetensors", "episodes/index.parquet"}
    trimmed, entry = store.read("c"), store.entry("c")
    assert (trimmed.n_steps, entry.n_frames) == (12, {"front": 12, "side": 7})
    np.testing.assert_array_equal(trimmed.low_dim, whole.low_dim[5:17])
    for view in VIEWS:
        seen = whole.frames[view][whole.source_index[view][5:17]]
        np.testing.assert_array_equal(trimmed.frames[view][trimmed.source_index[view]], seen)
        np.testing.assert_array_equal(open_frames(store, entry, view), trimmed.frames[view])
        index = open_steps(store, entry, VIEWS)[f"source_index/{view}"]
        expected = latents[view][whole.source_index[view][5:17]]
        np.testing.assert_array_equal(open_latents(root, entry, view, KEYS[view])[index], expected)
        np.testing.assert_array_equal(read_latents(root, entry, view, KEYS[view])[index], expected)


def test_windows_and_pairs_of_a_trimmed_episode_are_those_of_the_whole_one_there(root: Path) -> None:
    window = WindowSpec(n_plan_frames=3, frame_stride=2, max_goal_frames=0)

    def everything() -> tuple[WindowDataset, PairDataset]:
        planned = WindowDataset(root, split="all", latent_keys=KEYS, window=window)
        return planned, PairDataset(root, split="all", frame_stride=2, latent_keys=KEYS)

    def named(data: WindowDataset | PairDataset) -> dict[tuple[str, int], object]:
        batches = [data.read([i]) for i in range(len(data))]
        return {(data.episode_ids[int(one.episode[0])], int(one.step[0])): one for one in batches}

    whole = [named(data) for data in everything()]
    trim_episodes(root, plan_trim(root, ["b"], steps=(4, 18)))
    for before, data in zip(whole, everything(), strict=True):
        after = named(data)
        assert {key for key in after if key[0] != "b"} == {key for key in before if key[0] != "b"}
        for (name, step), batch in after.items():
            same = before[name, step + 4 if name == "b" else step]
            for view in VIEWS:
                assert (batch.frames[view] == same.frames[view]).all()  # type: ignore[attr-defined]
                assert (batch.latents[view] == same.latents[view]).all()  # type: ignore[attr-defined]
            assert (batch.action == same.action).all()  # type: ignore[attr-defined]


def test_a_second_trim_counts_as_the_first_did_and_the_same_again_does_nothing(root: Path) -> None:
    whole = EpisodeStore(root).read("d")
    trim_episodes(root, plan_trim(root, ["d"], steps=(3, None)))
    trim_episodes(root, plan_trim(root, ["d"], steps=(5, -4)))
    assert trim_episodes(root, plan_trim(root, ["d"], steps=(5, -4))).operation is None
    entry, kept = EpisodeStore(root).entry("d"), EpisodeStore(root).read("d")
    np.testing.assert_array_equal(kept.action, whole.action[5:19])  # type: ignore[index]
    assert entry.key.endswith(":5-19")
    assert (entry.edits["trim"]["first_step"], entry.edits["trim"]["of_steps"]) == (5, 23)
    assert entry.ingest_key == "key of d"
    np.testing.assert_array_equal(
        kept.frames["side"][kept.source_index["side"]], whole.frames["side"][whole.source_index["side"][5:19]]
    )


@pytest.mark.parametrize(
    ("steps", "message"), [((4, 5), "no motion"), ((30, 40), "no such range"), ((9, 3), "no such range")]
)
def test_a_trim_that_leaves_too_little_is_refused_and_changes_nothing(
    root: Path, steps: tuple[int, int], message: str
) -> None:
    before = tree(root)
    with pytest.raises(UsageError, match=message):
        trim_episodes(root, plan_trim(root, ["a"], steps=steps))
    assert tree(root) == before


def test_a_trim_that_would_be_refused_is_refused_when_planned(root: Path) -> None:
    for steps in ((100, 200), (4, 5)):
        with pytest.raises(UsageError, match=r"no such range|no motion"):
            plan_trim(root, ["a"], steps=steps)
    trim_episodes(root, plan_trim(root, ["a"], steps=(8, 15)))
    with pytest.raises(UsageError, match=r"trimmed off before\n.*0:5; steps 8 to 14 are left"):
        plan_trim(root, ["a"], steps=(0, 5))
    with pytest.raises(UsageError, match="12:9 of an episode of 20 steps"):  # as it was typed and ingested
        plan_trim(root, ["a"], steps=(12, 9))


def test_a_range_past_the_last_step_is_said(root: Path) -> None:
    assert [cut.past_end for end in (20, 9999) for cut in plan_trim(root, ["a"], steps=(10, end))] == [False, True]


def test_ranges_of_steps_are_slices() -> None:
    assert [parse_steps(text) for text in ("10:140", "10:", ":-5")] == [(10, 140), (10, None), (None, -5)]
    for wrong in ("10", "a:b", "1:2:3", ""):
        with pytest.raises(UsageError, match="FIRST:END"):
            parse_steps(wrong)


def test_training_never_sees_what_was_trimmed_off(root: Path) -> None:
    from vilp_models.frames import open_clips

    store = EpisodeStore(root)
    trim_episodes(root, plan_trim(root, ["a"], steps=(6, 12)))
    entry = store.entry("a")
    (clip,) = open_clips(store, [entry], ["front"])
    assert len(clip.frames) == 6
    assert len(shards.read_shard(store.frames_path("front", "a")).arrays["frames"]) == 20


def test_latents_of_a_trimmed_episode_are_those_of_its_whole_frames_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vilp_data import latent_runs, latents, staleness

    for module in (latents, latent_runs, staleness):
        monkeypatch.setattr(module, "load_encoder", module.load_encoder)
    install(BlockMeans())
    log, root = write_zarr(tmp_path / "replay.zarr"), tmp_path / "data"
    ingest([log.path], root, zarr_task_spec())
    first = ids(root)[0]
    encode_all(root)
    made = latents_path(root, "top", BlockMeans().key, first).read_bytes()
    trim_episodes(root, plan_trim(root, [first], steps=(2, 9)))
    assert sum(encode_all(root).written.values()) == 0
    latents_path(root, "top", BlockMeans().key, first).unlink()
    encode_all(root)
    again = shards.read_shard(latents_path(root, "top", BlockMeans().key, first)).arrays["latents"]
    (tmp_path / "made.safetensors").write_bytes(made)
    np.testing.assert_array_equal(again, shards.read_shard(tmp_path / "made.safetensors").arrays["latents"])


def test_the_split_knows_a_trimmed_episode_as_what_it_was(root: Path) -> None:
    split(root, redraw=True)
    before = find_split(root)
    trim_episodes(root, plan_trim(root, ["a"], steps=(2, 15)))
    split(root)
    after = find_split(root)
    assert before is not None
    assert after is not None
    assert (after.assignment, after.contents) == (before.assignment, before.contents)


# --- models that were trained before ------------------------------------------------------------------------------------------


def test_a_model_that_learnt_from_an_episode_is_not_judged_on_what_is_left_of_it(root: Path) -> None:
    from vilp_models.checkpoint import refuse_trained_on_validation

    learnt = SimpleNamespace(model="planner", train_episodes={"elsewhere": "key of a"})
    trim_episodes(root, plan_trim(root, ["a"], steps=(2, 15)))
    entry = EpisodeStore(root).entry("a")
    assert entry.key != "key of a"
    with pytest.raises(Exception, match="trained on 1 of the episodes"):
        refuse_trained_on_validation(learnt, [entry], where=root)  # type: ignore[arg-type]


# --- unchanged bytes -----------------------------------------------------------------------------------------------------------


def test_an_episode_without_edits_has_the_header_it_always_had(root: Path) -> None:
    metadata = shards.read_header(EpisodeStore(root).steps_path("a")).metadata
    assert "edits" not in metadata
    assert set(metadata) == {
        "content_sha256", "findings", "format", "frames_sha256", "has_action", "has_state", "id", "ingest", "key", "n_frames", "n_steps",
        "n_valid", "outcome", "rate_hz", "sha256", "source", "source_episode", "source_sha256", "tags",
    }  # fmt: skip
    assert json.loads(metadata["n_frames"]) == {"front": 20, "side": 10}


def test_an_index_of_an_older_version_is_read(root: Path) -> None:
    import pyarrow.parquet as pq

    store = EpisodeStore(root)
    entries = store.index()
    table = pq.read_table(store.index_path)
    pq.write_table(table.drop_columns(["edits"]), store.index_path)
    os.utime(store.index_path)
    assert store.index() == entries
