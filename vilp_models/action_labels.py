"""What a model that learns by an action set has to do with it: the set it is trained on, and the same one whenever it is used."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vilp_data.action_set_lock import DIGITS
from vilp_data.action_sets import effective_epochs
from vilp_data.dataset import WindowDataset
from vilp_data.dataset_action_sets import read_action_set
from vilp_data.errors import UsageError, number_of
from vilp_data.labelled_episodes import LabelledEpisodes
from vilp_data.pairs import PairDataset
from vilp_models.checkpoint import RunState
from vilp_models.recipe import TrainingRecipe

SetId = Mapping[str, str]
"""{"name", "key"}, as in `RunState.action_set`."""


def set_id(labels: LabelledEpisodes | None) -> SetId | None:
    return None if labels is None else {"name": labels.name, "key": labels.key}


def set_text(action_set: SetId | None) -> str:
    """`hybrid 1a2b3c4d5e6f`"""
    return "no action set" if action_set is None else f"{action_set['name']} {action_set['key'][:DIGITS]}"


def require_same_set(trained: RunState, now: SetId | None, *, where: Path) -> None:
    """Raise UsageError, with both keys and the command that makes it right, where the run in `where` learnt from another action set
    than `now`. What a set is called decides nothing."""
    there = trained.action_set
    if (there and there["key"]) == (now and now["key"]):
        return
    option = "" if now is None else f" --set {now['name']}"
    remedy = f"train again: `vilp-models train {trained.model}{option} --restart`, or name another run with --run"
    if there is not None and (now is None or now["name"] != there["name"]):
        remedy = f"ask for the set it learnt from, --set {there['name']}, or {remedy}"
    found = f"{set_text(there)} in the model, {set_text(now)} now"
    raise UsageError("this model was trained with another action set", where=where, found=found, remedy=remedy)


def labels_of(root: Path, trained: RunState, asked: str | None, *, where: Path) -> LabelledEpisodes | None:
    """The action set that the run in `where` learnt from, proved again; `asked` is the one that a user named, if any. None where it
    learnt from all episodes with actions.

    Raises ActionSetError where the set does not hold any more, UsageError where it is not there or is another than the run's."""
    name = asked if asked is not None or trained.action_set is None else trained.action_set["name"]
    labels = None if name is None else read_action_set(root, name)
    require_same_set(trained, set_id(labels), where=where)
    return labels


def epochs_text(labels: LabelledEpisodes, samples: PairDataset | WindowDataset, recipe: TrainingRecipe) -> str:
    """`hybrid 1a2b3c4d5e6f: gray 16 episodes, 1200 samples, 31.2 epochs; …`: how often training goes over each source."""
    distinct = samples.samples_per_episode // labels.repeats()
    ids = [entry.id for entry in labels.entries]
    sources = labels.lock.sources
    counts = [int(distinct[np.isin(ids, source.episodes)].sum()) for source in sources]
    weights = [source.weight for source in sources]
    epochs = effective_epochs(counts, weights, drawn=recipe.steps * recipe.batch_size)
    said = [
        f"{source.name} {number_of(len(source.episodes), 'episode')}, {count} samples, {over:.3g} epochs"
        for source, count, over in zip(sources, counts, epochs, strict=True)
    ]
    return f"{set_text(set_id(labels))}: {'; '.join(said)}"
