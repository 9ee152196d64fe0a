"""The action sets of a dataset folder: action_sets/<name>.lock.json chosen from the stored episodes, written, read back and proved."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from importlib import resources
from pathlib import Path

from vilp_data import shards
from vilp_data.action_set_lock import (
    ActionSetLock,
    LockedEpisode,
    LockedSource,
    actions_command,
    check_action_set,
    redraw_command,
)
from vilp_data.action_sets import ActionRecipe, Candidate, choose, effective_epochs, parse_recipe
from vilp_data.dataset_split import read_split, side_episodes
from vilp_data.episode_files import open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import ActionSetError, SpecError, StoreError, UsageError, VilpDataError, nearest, some_of
from vilp_data.labelled_episodes import LabelledEpisodes
from vilp_data.split_lock import SplitLock
from vilp_data.stats import ChannelStats
from vilp_data.twins import twin_hashes
from vilp_data.writer_lock import writer_lock

FOLDER = "action_sets"
SUFFIX = ".lock.json"


def set_path(root: Path, name: str) -> Path:
    return root / FOLDER / f"{name}{SUFFIX}"


def set_names(root: Path) -> list[str]:
    """The sets that were locked in this dataset."""
    files = (path for path in (root / FOLDER).glob(f"[!.]*{SUFFIX}") if path.is_file())
    return sorted(path.name.removesuffix(SUFFIX) for path in files)


# --- recipes -----------------------------------------------------------------------------------------------------------------


def recipe_names(task: str) -> list[str]:
    """The built-in recipes of a task."""
    folder = resources.files("pipelines") / FOLDER / task
    if not folder.is_dir():
        return []
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_recipe(name_or_path: str, task: str, *, preset: str | None = None) -> tuple[str, ActionRecipe]:
    """The name of the set, and its recipe: a built-in one of `task` ("small", "hybrid", "off_target"), or that of a TOML, whose set
    is called after the file; with a preset's overrides. Raises SpecError."""
    if not name_or_path.endswith(".toml"):
        known = recipe_names(task)
        if name_or_path not in known:
            hint = nearest(name_or_path, known) + "; or " if known else ""
            what = f"the task {task!r} has no recipe called {name_or_path!r}"
            raise SpecError(what, remedy=f"{hint}give a path ending in .toml (docs/action_sets.md)")
        text = (resources.files("pipelines") / FOLDER / task / f"{name_or_path}.toml").read_text(encoding="utf-8")
        where = f"pipelines/{FOLDER}/{task}/{name_or_path}.toml"
        return name_or_path, parse_recipe(text, where=where, preset=preset)
    path = Path(name_or_path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        found = getattr(error, "strerror", None) or "not text in UTF-8"
        raise SpecError("the recipe cannot be read", where=path, found=found, remedy="give a path to a TOML") from error
    if not path.stem.replace("_", "").replace("-", "").isalnum():
        remedy = "letters, digits, - and _ only: it becomes the name of the set"
        raise SpecError("a recipe's file name names its set", where=path, found=path.stem, remedy=remedy)
    return path.stem, parse_recipe(text, where=str(path), preset=preset)


# --- locks -------------------------------------------------------------------------------------------------------------------


def lock_action_set(root: Path, name: str, recipe: ActionRecipe, *, given: str, redraw: bool = False) -> ActionSetLock:
    """The set `name` of the dataset: the one that is locked, where it still holds; else chosen by `recipe` now, and written. `given` is
    how the recipe was named on the command line. `redraw` chooses anew whatever is there.

    Raises UsageError where the lock there is of another recipe, or a folder is where it belongs, ActionSetError where it does not hold or
    none that holds can be chosen, SplitError without a split that covers the episodes, BusyError where another process writes it."""
    path = set_path(root, name)
    with writer_lock(root):
        if path.is_file() and not redraw:
            lock = read_action_set(root, name).lock
            if lock.recipe != recipe or list(lock.recipe.source) != list(recipe.source):
                raise UsageError(
                    f"the action set {name!r} was chosen by another recipe",
                    where=path,
                    found=f"recipe {lock.given} then, {given} now",
                    remedy="choose anew with --redraw (models trained on it no longer fit), or give the file another name",
                )
            return lock
        if path.is_dir():
            raise UsageError("a folder where the lock belongs", where=path, remedy="move it away")
        lock = _chosen(root, name, recipe, given)
        for wrong in wrong_with(root, name, lock, read_split(root), EpisodeStore(root).index()):
            raise wrong
        if not path.is_file() or path.read_bytes() != lock.to_json():
            shards.write_atomic(path, lock.to_json())
    return lock


def find_action_set(root: Path, name: str) -> ActionSetLock:
    """The lock as it stands, whether it holds or not. Raises UsageError where there is none, naming those there are."""
    path = set_path(root, name)
    if not path.is_file():
        known = set_names(root)
        remedy = f"lock it with `{actions_command(root, name)}`" + (f"; {nearest(name, known)}" if known else "")
        raise UsageError(f"this dataset has no action set called {name!r}", where=root, remedy=remedy)
    try:
        data = path.read_bytes()
    except OSError as error:
        remedy = "let it be read, or put it back from a backup"
        raise ActionSetError("the lock cannot be read", where=path, found=error.strerror, remedy=remedy) from error
    return ActionSetLock.from_json(data, name=name, dataset=root, where=path)


def read_action_set(root: Path, name: str) -> LabelledEpisodes:
    """The episodes of the set `name`, proved to be in it today.

    Raises UsageError where it is not locked, ActionSetError for the first thing that is wrong (see `check_action_set`), SplitError
    without a split, StoreError where the steps of an episode that the proof needs cannot be read."""
    lock = find_action_set(root, name)
    store = EpisodeStore(root)
    entries = store.index()
    for wrong in wrong_with(root, name, lock, read_split(root), entries):
        raise wrong
    return LabelledEpisodes(store, lock, entries)


def wrong_with(
    root: Path, name: str, lock: ActionSetLock, split: SplitLock, entries: Sequence[EpisodeEntry]
) -> Iterator[VilpDataError]:
    """Everything that is wrong with the lock of the set `name` for this split and these stored episodes (`check_action_set`). Raises
    nothing: steps that cannot be read to prove it are wrong with it too."""
    shown = [entry for entry in entries if entry.id in lock.episodes or split.assignment.get(entry.id) == "val"]
    try:
        twins = twin_hashes(EpisodeStore(root), shown, split)
    except StoreError as error:
        yield error
        return
    yield from check_action_set(lock, split, entries, twins=twins, dataset=root, where=set_path(root, name))


def check_sets(root: Path) -> dict[str, tuple[ActionSetLock | None, list[VilpDataError]]]:
    """Of every set that was locked: its lock, where that can be read, and everything that is wrong with it. Raises for nothing that one of
    the sets or the split holds."""
    found: dict[str, tuple[ActionSetLock | None, list[VilpDataError]]] = {}
    store = EpisodeStore(root)
    for name in set_names(root):
        lock = None
        try:
            lock = find_action_set(root, name)
            found[name] = lock, list(wrong_with(root, name, lock, read_split(root), store.index()))
        except VilpDataError as error:
            found[name] = lock, [error]
    return found


def sets_broken_by(root: Path, episodes: Collection[str]) -> list[str]:
    """A sentence for each set that some of `episodes`, which just changed, give labels to, and that does not hold. A lock that cannot
    be read tells nothing."""
    notes = []
    for name, (lock, wrong) in check_sets(root).items():
        if lock is not None and wrong and (labelled := sorted(lock.episodes.keys() & set(episodes))):
            again = f"`{redraw_command(lock, root)}` and train again"
            why = "; ".join(error.what.removeprefix(f"action set {lock.name!r}: ") for error in wrong)
            why = f"{some_of(labelled, 5)} gave it labels, and {why}"
            notes.append(f"the action set {name!r} no longer holds: {why}; `vilp-data undo`, or {again}")
    return notes


def _chosen(root: Path, name: str, recipe: ActionRecipe, given: str) -> ActionSetLock:
    store, split = EpisodeStore(root), read_split(root)
    train = {entry.id: entry for entry in side_episodes(store, "train")}
    candidates = [Candidate(entry.id, entry.tags, entry.has_action, entry.n_valid) for entry in train.values()]
    ids = choose(recipe, candidates, where=root)
    episodes = {id: train[id] for id in sorted(id for chosen in ids.values() for id in chosen)}
    return ActionSetLock(
        name=name,
        given=given,
        recipe=recipe,
        sources=_sources(recipe, ids, train),
        episodes={id: LockedEpisode(entry.key, entry.content_sha256) for id, entry in episodes.items()},
        video_only=tuple(id for id in split.ids("train") if id not in episodes),
        validation=tuple(split.ids("val")),
        split_hash=split.hash,
        action=_action_stats(store, list(episodes.values())),
    ).sealed()


def _sources(
    recipe: ActionRecipe, ids: dict[str, tuple[str, ...]], train: dict[str, EpisodeEntry]
) -> tuple[LockedSource, ...]:
    n_steps = [sum(train[id].n_valid for id in chosen) for chosen in ids.values()]
    epochs = effective_epochs(n_steps, [recipe.source[name].weight for name in ids])
    return tuple(
        LockedSource(name, recipe.source[name].weight, ids[name], n, effective)
        for name, n, effective in zip(ids, n_steps, epochs, strict=True)
    )


def _action_stats(store: EpisodeStore, entries: list[EpisodeEntry]) -> ChannelStats:
    steps = (open_steps(store, entry) for entry in entries)
    return ChannelStats.over(arrays["action"][arrays["valid"]] for arrays in steps)
