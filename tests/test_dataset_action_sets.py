"""The lock of an action set in a dataset folder: what it proves, what it outlasts, what it is refused for; who may open what."""

from __future__ import annotations

import json
import math
import pickle
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stored_episodes import KEYS, add_episodes, episode, write_dataset, write_latents
from vilp_data.action_set_lock import ActionSetLock
from vilp_data.action_sets import recipe_from_dict
from vilp_data.dataset import WindowDataset
from vilp_data.dataset_action_sets import (
    check_sets,
    find_action_set,
    lock_action_set,
    read_action_set,
    set_names,
    set_path,
)
from vilp_data.dataset_split import check_dataset_split, lock_path, read_split, update_split
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.errors import ActionSetError, UsageError
from vilp_data.open_episodes import OpenEpisodes
from vilp_data.pairs import PairDataset
from vilp_data.shards import write_atomic
from vilp_data.spec import WindowSpec
from vilp_data.split_lock import SplitLock, assignment_hash
from vilp_data.surgery.operations import plan_trim, relabel_episodes, remove_episodes, trim_episodes
from vilp_data.surgery.undo import undo
from vilp_data.twins import twin_hashes
from vilp_data.types import Episode

N = 16


def tagged(number: int) -> Episode:
    """Every third is purple; every fifth has no actions; lengths differ, and some steps are invalid."""
    one = episode(f"e{number:02}", 9 + number % 4, with_action=number % 5 != 4, invalid=(3,) if number % 7 == 0 else ())
    return replace(one, tags={"object": "purple" if number % 3 == 0 else "gray"})


def twin(store: EpisodeStore, id: str, name: str) -> Episode:
    """What `id` did, under other pictures and another name."""
    original = store.read(id)
    return replace(original, id=name, frames={view: 255 - frames for view, frames in original.frames.items()})


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_dataset(tmp_path, *map(tagged, range(N)))
    split(tmp_path, redraw=True)
    return tmp_path


def split(root: Path, **options: Any) -> SplitLock:
    settings = {"ratio": 0.75, "ratio_from": "task", "seed": 0, "group_by": None, "strata": (), "redraw": False}
    return update_split(root, **(settings | options))


def recipe(gray: int = 3, *, weight: int = 1) -> Any:
    sources = {
        "gray": {"where": {"object": "gray"}, "count": gray, "weight": weight},
        "purple": {"where": {"object": "purple"}},
    }
    return recipe_from_dict({"source": sources}, where="test")


def locked(root: Path, **options: Any) -> ActionSetLock:
    return lock_action_set(root, "hybrid", recipe(**options), given="hybrid")


# --- what it holds


def test_labels_are_training_episodes_of_their_source_and_all_others_are_listed_as_giving_none(root: Path) -> None:
    lock, split_now = locked(root), read_split(root)
    entries = {entry.id: entry for entry in EpisodeStore(root).index()}
    gray, purple = lock.sources
    assert len(gray.episodes) == 3
    assert all(entries[id].tags["object"] == "gray" for id in gray.episodes)
    assert set(purple.episodes) == {
        id for id in split_now.ids("train") if entries[id].tags["object"] == "purple" and entries[id].has_action
    }
    assert set(lock.episodes) == {*gray.episodes, *purple.episodes} <= set(split_now.ids("train"))
    assert set(lock.validation) == set(split_now.ids("val"))
    assert set(lock.video_only) == set(split_now.ids("train")) - set(lock.episodes)
    assert lock.assignment() == split_now.assignment
    assert assignment_hash(lock.assignment()) == lock.split_hash


def test_its_statistics_are_of_the_actions_of_its_episodes_alone(root: Path) -> None:
    lock, store = locked(root), EpisodeStore(root)
    read = [store.read(id) for id in lock.episodes]
    actions = np.concatenate([one.action[one.valid] for one in read if one.action is not None]).astype(np.float64)
    np.testing.assert_allclose(lock.action.mean, actions.mean(axis=0))
    np.testing.assert_allclose(lock.action.std, actions.std(axis=0))
    assert lock.action.count == len(actions) == sum(source.n_steps for source in lock.sources)


def test_locking_again_writes_the_same_bytes_and_reading_gives_them_back(root: Path) -> None:
    lock = locked(root)
    before = set_path(root, "hybrid").read_bytes()
    assert locked(root).to_json() == lock.to_json()
    assert set_path(root, "hybrid").read_bytes() == before == lock.to_json()
    assert ActionSetLock.from_json(before, name="hybrid", dataset=root, where="x").to_json() == before
    assert set_names(root) == ["hybrid"]
    set_path(root, "hybrid").unlink()
    locked(root)
    assert set_path(root, "hybrid").read_bytes() == before


def test_a_set_outlasts_new_episodes_and_a_split_that_grew(root: Path) -> None:
    lock = locked(root)
    add_episodes(root, *(replace(tagged(N + i), tags={"object": "gray"}) for i in range(6)))
    split(root)
    assert read_split(root).hash != lock.split_hash
    assert check_sets(root)["hybrid"][1] == []
    assert locked(root).to_json() == lock.to_json()
    assert len(lock_action_set(root, "hybrid", recipe(5), given="hybrid", redraw=True).sources[0].episodes) == 5


def test_the_key_is_of_episodes_and_weights_alone(root: Path) -> None:
    one = locked(root)
    other = lock_action_set(root, "same", recipe(), given="elsewhere/same.toml")
    assert one.key == other.key
    assert lock_action_set(root, "weighed", recipe(weight=2), given="x").key != one.key
    assert lock_action_set(root, "more", recipe(4), given="x").key != one.key


# --- what it is refused for


def vanish(root: Path, lock: ActionSetLock) -> str:
    remove_episodes(root, [min(lock.episodes)])
    return f"episodes of it are gone\n   found: {min(lock.episodes)}\n"


def trim(root: Path, lock: ActionSetLock) -> str:
    trim_episodes(root, plan_trim(root, [min(lock.episodes)], threshold=0.02, margin_s=0.5, steps=(1, -1)))
    return f"episodes of it changed\n   found: {min(lock.episodes)}: key"


def change(root: Path, lock: ActionSetLock) -> str:
    store, id = EpisodeStore(root), min(lock.episodes)
    other = store.read(id)
    assert other.action is not None
    store.write(replace(other, action=2 * other.action), Origin("test", "", id, f"key of {id}", {}))
    store.write_index()
    return f"episodes of it changed\n   found: {id}: content"


def lose_actions(root: Path, lock: ActionSetLock) -> str:
    store, id = EpisodeStore(root), min(lock.episodes)
    store.write(replace(store.read(id), action=None), Origin("test", "", id, f"key of {id}", {}))
    store.write_index()
    return f"found: {id}: has no actions any more"


def relabel(root: Path, lock: ActionSetLock) -> str:
    id = lock.sources[0].episodes[0]
    relabel_episodes(root, [id], labels={"object": "green"})
    return f"lost the tags of their source\n   found: {id} is not object = gray\n"


def redraw(root: Path, lock: ActionSetLock) -> str:
    assert any(set(split(root, redraw=True, seed=seed).ids("val")) & set(lock.episodes) for seed in range(1, 99))
    return "the split was drawn anew since\n   found: "


def redraw_around_the_labels(root: Path, lock: ActionSetLock) -> str:
    """Every label still trains, but others changed sides."""
    draws = (split(root, redraw=True, seed=seed, ratio=0.9) for seed in range(1, 999))
    assert any(not set(now.ids("val")) & set(lock.episodes) and now.assignment != lock.assignment() for now in draws)
    return "the split was drawn anew since\n   found: "


def validate_by_another_name(root: Path, lock: ActionSetLock) -> str:
    """A copy that was put onto the validation side by hand, its lock's hash with it."""
    store, id = EpisodeStore(root), min(lock.episodes)
    store.write(replace(store.read(id), id="copy"), Origin("test", "", "copy", "another key", {}))
    store.write_index()
    now = read_split(root)
    assignment = {**now.assignment, "copy": "val"}
    write_atomic(lock_path(root), replace(now, assignment=assignment, hash=assignment_hash(assignment)).to_json())  # type: ignore[arg-type]
    return f"episodes of it validate by another name\n   found: copy is {id}\n"


def validate_under_other_pictures(root: Path, lock: ActionSetLock) -> str:
    """A twin on the validation side, in a split that was drawn before there were any."""
    store, id = EpisodeStore(root), min(lock.episodes)
    store.write(twin(store, id, "purple"), Origin("test", "", "purple", "another key", {}))
    store.write_index()
    now = read_split(root)
    assignment = {**now.assignment, "purple": "val"}
    older = replace(now, assignment=assignment, hash=assignment_hash(assignment), twins={})  # type: ignore[arg-type]
    write_atomic(lock_path(root), older.to_json())
    return f"validation episodes have the same actions as episodes of it, step for step\n   found: purple does what {id} does\n"


def edit_by_hand(root: Path, lock: ActionSetLock) -> str:
    table = json.loads(lock.to_json())
    table["sources"][0]["weight"] = 9
    set_path(root, "hybrid").write_text(json.dumps(table))
    return "the lock was changed by hand\n"


def forge(root: Path, lock: ActionSetLock) -> str:
    """A validation episode among the labels, and the seal made anew: its own lists give it away."""
    stranger = next(entry for entry in EpisodeStore(root).index() if entry.id in lock.validation)
    episodes = {
        **lock.episodes,
        stranger.id: type(lock.episodes[min(lock.episodes)])(stranger.key, stranger.content_sha256),
    }
    first = replace(lock.sources[0], episodes=(*lock.sources[0].episodes, stranger.id))
    forged = replace(lock, episodes=episodes, sources=(first, *lock.sources[1:])).sealed()
    assert forged.is_intact
    write_atomic(set_path(root, "hybrid"), forged.to_json())
    return f"episodes that give labels are listed as giving none\n   found: {stranger.id}\n"


def forge_with_care(root: Path, lock: ActionSetLock) -> str:
    """The validation episode is taken off the list of those too."""
    forge(root, lock)
    forged = find_action_set(root, "hybrid")
    forged = replace(forged, validation=tuple(id for id in lock.validation if id not in forged.episodes)).sealed()
    write_atomic(set_path(root, "hybrid"), forged.to_json())
    return "its lists are not the split that it was chosen in\n"


def forge_the_split_hash_too(root: Path, lock: ActionSetLock) -> str:
    """Then today's split says otherwise."""
    forge_with_care(root, lock)
    forged = find_action_set(root, "hybrid")
    write_atomic(
        set_path(root, "hybrid"), replace(forged, split_hash=assignment_hash(forged.assignment())).sealed().to_json()
    )
    return "the split was drawn anew since\n   found: "


WRONGS: list[Callable[[Path, ActionSetLock], str]] = [
    vanish, trim, change, lose_actions, relabel, redraw, redraw_around_the_labels, validate_by_another_name, validate_under_other_pictures,
    edit_by_hand, forge, forge_with_care, forge_the_split_hash_too,
]  # fmt: skip


@pytest.mark.parametrize("make_wrong", WRONGS, ids=lambda one: one.__name__)
def test_a_set_that_does_not_hold_is_refused_wherever_it_is_read(
    root: Path, make_wrong: Callable[[Path, ActionSetLock], str]
) -> None:
    said = make_wrong(root, locked(root))
    for read in (lambda: read_action_set(root, "hybrid"), lambda: locked(root)):
        with pytest.raises(ActionSetError) as refused:
            read()
        assert said in f"{refused.value}\n"
        assert str(set_path(root, "hybrid")) in str(refused.value)
        assert f"vilp-data actions {root} --recipe hybrid --redraw" in str(refused.value)
    assert check_sets(root)["hybrid"][1]


def test_no_set_is_locked_that_would_not_hold(root: Path) -> None:
    validating = read_split(root).ids("val")[0]
    store = EpisodeStore(root)
    for id in read_split(root).ids("train"):
        store.write(twin(store, validating, id), Origin("test", "", id, f"key of {id}", {}))
    store.write_index()
    with pytest.raises(
        ActionSetError, match=rf"found: {validating} does what e\d\d does\n(.|\n)*vilp-data split .* --redraw"
    ):
        lock_action_set(root, "all", recipe_from_dict({"source": {"all": {}}}, where="x"), given="x")
    assert set_names(root) == []


def test_a_trimmed_twin_is_known_by_what_it_was(root: Path) -> None:
    store, split_now = EpisodeStore(root), read_split(root)
    acting = {entry.id for entry in store.index() if entry.has_action}
    labelled, validating = (next(id for id in split_now.ids(side) if id in acting) for side in ("train", "val"))
    store.write(twin(store, labelled, validating), Origin("test", "", validating, f"key of {validating}", {}))
    store.write_index()
    trim_episodes(root, plan_trim(root, [labelled], steps=(2, None)))
    hashes = twin_hashes(store, store.index(), None)
    assert hashes[labelled] != hashes[validating]  # of what is left
    assert twin_hashes(store, store.index(), split_now)[labelled] == hashes[validating]
    assert any(finding.startswith("identical actions") for finding in check_dataset_split(root))
    with pytest.raises(ActionSetError, match=f"{validating} does what {labelled} does"):
        lock_action_set(root, "all", recipe_from_dict({"source": {"all": {}}}, where="x"), given="x")


def test_twins_are_on_one_side_of_a_split_that_is_drawn(root: Path) -> None:
    store = EpisodeStore(root)
    add_episodes(root, *(replace(twin(store, f"e{number:02}", f"twin-{number:02}")) for number in range(4)))
    for seed in range(8):
        now = split(root, redraw=True, seed=seed)
        assert all(now.assignment[f"e{number:02}"] == now.assignment[f"twin-{number:02}"] for number in range(4))
        assert now.twin_groups == [[f"e{number:02}", f"twin-{number:02}"] for number in range(4)]
    assert check_dataset_split(root) == []


def test_commands_that_choose_anew_can_be_pasted_as_they_are(tmp_path: Path) -> None:
    root = tmp_path / "my data"
    write_dataset(root, *map(tagged, range(N)))
    split(root, redraw=True)
    lock = lock_action_set(root, "mine", recipe(), given="my recipes/mine.toml --preset tiny")
    (note,) = remove_episodes(root, [min(lock.episodes)]).notes
    with pytest.raises(ActionSetError) as refused:
        read_action_set(root, "mine")
    for said in (note, str(refused.value)):
        command = said[said.index("`vilp-data actions") + 1 :].partition("`")[0]
        assert shlex.split(command)[2:] == [
            str(root), "--recipe", "my recipes/mine.toml", "--preset", "tiny", "--redraw"
        ]  # fmt: skip


def test_episodes_without_a_valid_step_give_no_labels(tmp_path: Path) -> None:
    masked = [replace(tagged(n), id=f"masked{n}", valid=np.zeros(9 + n % 4, np.bool_)) for n in range(N)]
    write_dataset(tmp_path, *map(tagged, range(N)), *(one for one in masked if one.action is not None))
    split(tmp_path, redraw=True)
    lock = lock_action_set(tmp_path, "all", recipe_from_dict({"source": {"all": {}}}, where="x"), given="x")
    assert any(id.startswith("masked") for id in lock.video_only)
    assert not any(id.startswith("masked") for id in lock.episodes)


def test_surgery_names_the_sets_that_it_breaks_and_no_others(root: Path) -> None:
    lock = lock_action_set(root, "mine", recipe(), given="mine.toml")
    set_path(root, "broken").write_text("{")
    labelled, video_only = sorted(lock.episodes)[0], lock.video_only[0]
    assert remove_episodes(root, [video_only]).notes == []
    (note,) = remove_episodes(root, [labelled]).notes
    said = f"the action set 'mine' no longer holds: {labelled} gave it labels, and "
    assert note.startswith(said + "episodes of it are gone; `vilp-data undo`, or ")
    assert f"`vilp-data actions {root} --recipe mine.toml --redraw`" in note
    undo(root)

    (note,) = relabel_episodes(root, [labelled], labels={"object": "green"}).notes
    assert note.startswith(said + "episodes of it lost the tags of their source; ")
    undo(root)
    assert relabel_episodes(root, [labelled], labels={"weather": "fine"}).notes == []  # no source asks for it
    (note,) = trim_episodes(root, plan_trim(root, [labelled], steps=(2, None))).notes
    assert note.startswith(said + "episodes of it changed; ")


def test_another_recipe_of_the_same_name_is_refused_until_it_is_wanted(root: Path) -> None:
    lock = locked(root)
    with pytest.raises(UsageError, match=r"chosen by another recipe(.|\n)*--redraw"):
        locked(root, gray=2)
    assert find_action_set(root, "hybrid").to_json() == lock.to_json()


def test_a_set_that_is_not_there_names_those_there_are(root: Path) -> None:
    locked(root)
    with pytest.raises(UsageError, match=r"no action set called 'hybird'(.|\n)*did you mean 'hybrid'"):
        read_action_set(root, "hybird")


def test_what_is_no_lock_is_refused_in_words(root: Path) -> None:
    locked(root)
    good = set_path(root, "hybrid").read_text()

    def changed(*path: str | int, to: Any) -> str:
        table = json.loads(good)
        inner = table
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = to
        return json.dumps(table)

    broken = [
        "", "[]", '{"format": 9}', '{"format": 1}', "[" * 100_000, good.replace('"weight": 1', '"weight": 1e999', 1),
        changed("action", "mean", 0, to=math.nan), changed("action", "sum_sq", 0, to=-1.0), changed("name", to="\ud800"),
        changed("sources", 0, "effective_epochs", to="x"), changed("validation", to=[["e01"]]), changed("split_hash", to=3),
        changed("sources", 0, "episodes", to="e01"), changed("episodes", "e01", to={"key": 3, "content": "x"}),
        changed("recipe", "source", "gray", "count", to=True),
    ]  # fmt: skip
    for text in broken:
        set_path(root, "hybrid").write_text(text)
        with pytest.raises(ActionSetError, match="not the lock of an action set that can be read"):
            read_action_set(root, "hybrid")


# --- who may open what


def test_an_episode_outside_is_refused_before_its_file_is_touched(root: Path) -> None:
    locked(root)
    labels, store = read_action_set(root, "hybrid"), EpisodeStore(root)
    inside = {entry.id for entry in labels.entries}
    entries = store.index()
    for entry in entries:
        if entry.id in inside:
            assert np.array_equal(labels.open_steps(entry)["action"], store.read(entry.id).action)  # type: ignore[arg-type]
            continue
        store.steps_path(entry.id).unlink()
        with pytest.raises(ActionSetError, match=rf"does not give the actions of '{entry.id}'"):
            labels.open_steps(entry)
    disguised = replace(next(entry for entry in entries if entry.id not in inside), id=min(inside))
    with pytest.raises(ActionSetError, match="does not give"):
        labels.open_steps(disguised)


def test_masked_steps_are_counted_through_the_set_too(root: Path) -> None:
    locked(root)
    labels, store = read_action_set(root, "hybrid"), EpisodeStore(root)
    foreign = next(entry for entry in store.index() if entry.id not in labels.lock.episodes)
    foreign = replace(foreign, n_valid=foreign.n_steps - 1)
    store.steps_path(foreign.id).unlink()
    opened = OpenEpisodes(
        store, [labels.entries[0], foreign], latent_keys={}, frame_views=(), has_action=np.ones(2, np.bool_), labels=labels
    )  # fmt: skip
    with pytest.raises(ActionSetError, match=rf"does not give the actions of '{foreign.id}'"):
        opened.valid_runs()


def test_pairs_are_of_the_set_alone_each_as_often_as_its_source_weighs(root: Path) -> None:
    lock = locked(root, weight=2)
    labels = read_action_set(root, "hybrid")
    pairs = PairDataset(root, split="train", frame_stride=2, latent_keys=KEYS, labels=labels)
    assert pairs.episode_ids == sorted(lock.episodes)
    every = PairDataset(root, split="train", frame_stride=2, latent_keys=KEYS)
    batch, plain = pairs.read(range(len(pairs))), every.read(range(len(every)))
    seen = list(zip((pairs.episode_ids[i] for i in batch.episode.tolist()), batch.step.tolist(), strict=True))
    there = list(zip((every.episode_ids[i] for i in plain.episode.tolist()), plain.step.tolist(), strict=True))
    expected = [pair for pair in there for _ in range(lock.weights.get(pair[0], 0))]
    assert sorted(seen) == sorted(expected)
    for row, pair in enumerate(seen):
        assert np.array_equal(batch.action[row], plain.action[there.index(pair)])
    assert pairs.samples_per_episode.sum() == len(pairs)
    in_a_worker = pickle.loads(pickle.dumps(pairs)).read([0, len(pairs) - 1])
    assert np.array_equal(in_a_worker.action, pairs.read([0, len(pairs) - 1]).action)


def test_a_set_of_all_episodes_is_the_training_side_as_it_is_without(root: Path) -> None:
    lock_action_set(root, "all", recipe_from_dict({"source": {"all": {"weight": 3}}}, where="x"), given="x")
    labels = read_action_set(root, "all")
    window = WindowSpec(n_plan_frames=2, frame_stride=2)
    for kind, options in ((PairDataset, {"frame_stride": 2}), (WindowDataset, {"window": window, "acting": True})):
        with_set, without = (
            kind(root, split="train", latent_keys=KEYS, labels=one, **options)
            for one in (labels, None)  # type: ignore[operator]
        )
        assert with_set.episode_ids == without.episode_ids
        a, b = with_set.read(range(len(with_set))), without.read(range(len(without)))
        assert np.array_equal(a.step, b.step)
        assert np.array_equal(a.action, b.action)


def test_a_set_is_of_the_training_side(root: Path) -> None:
    locked(root)
    labels = read_action_set(root, "hybrid")
    for side in ("val", "all"):
        with pytest.raises(ActionSetError, match="are training episodes"):
            PairDataset(root, split=side, frame_stride=2, labels=labels)  # type: ignore[arg-type]


def test_pairs_of_a_set_are_chosen_by_the_set_alone(root: Path) -> None:
    locked(root)
    labels = read_action_set(root, "hybrid")
    with pytest.raises(UsageError, match=r"says itself which tags(.|\n)*purple"):
        PairDataset(root, split="train", frame_stride=2, labels=labels, where={"object": "purple"})


def test_latents_of_video_only_episodes_are_not_asked_for(root: Path) -> None:
    locked(root)
    labels = read_action_set(root, "hybrid")
    for path in (root / "latents").glob("*/*/*.safetensors"):
        path.unlink()
    for entry in labels.entries:
        write_latents(root, entry.id)
    assert len(PairDataset(root, split="train", frame_stride=2, latent_keys=KEYS, labels=labels).read([0])) == 1
