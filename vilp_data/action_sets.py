"""Action sets: which training episodes give action labels (paper, "Small" and "Hybrid"); all others give video only.

A recipe is a list of sources, each some episodes of certain tags. Choosing is a function of the recipe and of the episodes' ids and
tags alone: an episode's rank is a hash keyed with the source's seed, so a source that asks for more holds what it held before, and
the same source in another recipe is the same episodes. Values in, values out: nothing here reads or writes files.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from vilp_data.errors import ActionSetError, SpecError, nearest
from vilp_data.task_toml import with_preset

_VALUES_SHOWN = 5


class SourceRecipe(BaseModel):
    """[source.NAME]: some of the training episodes that have actions, and a valid step.

    where   tag = "value", or a list of values; an episode must fit every tag. Empty: any episode
    where_not
            the same: an episode must have each of these tags, with another value
    count   how many of them; all there are where unstated
    weight  how often an epoch of the set goes over each of its samples
    seed    which of them
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    where: dict[str, tuple[str, ...]] = {}
    where_not: dict[str, tuple[str, ...]] = {}
    count: int | None = Field(default=None, gt=0, strict=True)
    weight: int = Field(default=1, gt=0, strict=True)
    seed: int = Field(default=0, ge=0, strict=True)

    @field_validator("where", "where_not", mode="before")
    @classmethod
    def _lists_of_values(cls, table: Any) -> Any:
        if not isinstance(table, dict):
            return table
        for tag, values in table.items():
            if not isinstance(values, str | list | tuple) or not values:
                raise ValueError(
                    f'{tag} = {values!r}: tags are text, such as {tag} = "{str(values).lower()}", or a list of texts'
                )
        return {tag: (values,) if isinstance(values, str) else values for tag, values in table.items()}

    def fits(self, tags: Mapping[str, str]) -> bool:
        """Whether an episode of these tags is one that the source may take."""
        among = all(tags.get(tag) in values for tag, values in self.where.items())
        return among and all(tag in tags and tags[tag] not in values for tag, values in self.where_not.items())

    def __str__(self) -> str:
        """`object = gray_blocks, goal not row or column`"""
        words = [f"{tag} = {' or '.join(values)}" for tag, values in self.where.items()]
        words += [f"{tag} not {' or '.join(values)}" for tag, values in self.where_not.items()]
        return ", ".join(words) or "any tags"


class ActionRecipe(BaseModel):
    """An action set's TOML.

    source  the sources by name, in order: an episode that fits several belongs to the first that takes it
    video   how many episodes the paper's planner was trained on. Decides nothing: every training episode is video. It is
            compared with what the dataset holds
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: dict[str, SourceRecipe]
    video: int | None = Field(default=None, gt=0, strict=True)

    @model_validator(mode="after")
    def _some_source(self) -> Self:
        if not self.source:
            raise ValueError("a recipe needs a source: [source.NAME]")
        return self


@dataclass(frozen=True)
class Candidate:
    """A training episode, as far as the choice sees it."""

    id: str
    tags: Mapping[str, str]
    has_action: bool
    n_valid: int

    @property
    def gives_labels(self) -> bool:
        """Whether there is anything to learn from it."""
        return self.has_action and self.n_valid > 0


def parse_recipe(text: str, *, where: str, preset: str | None = None) -> ActionRecipe:
    """The recipe in a TOML, with the overrides of its [presets.PRESET]. Raises SpecError that names `where`, the key and the nearest
    known one, for any of its presets too."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SpecError("not valid TOML", where=where, found=str(error), remedy="correct that line") from error
    plain = recipe_from_dict(with_preset(dict(table), None, where=where), where=where)
    for name in table.get("presets", {}):
        inside = f"{where}, [presets.{name}]"
        changed = recipe_from_dict(with_preset(dict(table), name, where=where), where=inside)
        if strangers := [source for source in changed.source if source not in plain.source]:
            what = f"it has no source {strangers[0]!r} for a preset to change"
            raise SpecError(what, where=inside, remedy=nearest(strangers[0], plain.source))
    return recipe_from_dict(with_preset(table, preset, where=where), where=where)


def recipe_from_dict(table: Mapping[str, Any], *, where: str) -> ActionRecipe:
    """A recipe as `ActionRecipe.model_dump` gives it. Raises as `parse_recipe`."""
    try:
        return ActionRecipe.model_validate(table)
    except ValidationError as error:
        found = "\n          ".join(_complaint(item["loc"], item["type"], item["msg"]) for item in error.errors())
        remedy = "docs/action_sets.md lists every key"
        raise SpecError(
            "the recipe of an action set cannot be used", where=where, found=found, remedy=remedy
        ) from error


def choose(recipe: ActionRecipe, episodes: Sequence[Candidate], *, where: object) -> dict[str, tuple[str, ...]]:
    """Source -> the ids of its episodes, sorted; `episodes` are those of the training side, in any order.

    Raises ActionSetError that names `where` for a tag or value that no episode has, and where a source asks for more episodes than
    there are: it says which tags and values, and how many, were found."""
    taken: set[str] = set()
    chosen = {}
    for name, source in recipe.source.items():
        fitting = [episode for episode in episodes if source.fits(episode.tags)]
        free = [episode for episode in fitting if episode.gives_labels and episode.id not in taken]
        if len(free) < (source.count or 1):
            raise _too_few(name, source, episodes, fitting, len(free), where=where)
        ranked = sorted(free, key=lambda episode: (_rank(source.seed, episode.id), episode.id))
        chosen[name] = tuple(sorted(episode.id for episode in ranked[: source.count]))
        taken.update(chosen[name])
    return chosen


def effective_epochs(n_samples: Sequence[int], weights: Sequence[int], *, drawn: int | None = None) -> list[float]:
    """How often each source's samples are gone over while `drawn` samples are drawn from all sources together, by weight; while as
    many are drawn as there are, where `drawn` is None. 1.0 for all of equal weights."""
    weighted = sum(n * weight for n, weight in zip(n_samples, weights, strict=True))
    total = sum(n_samples) if drawn is None else drawn
    return [weight * total / weighted for weight in weights]


def repeats(weights: Sequence[int]) -> list[int]:
    """The smallest whole numbers in the ratio of `weights`: how often a sample of each source occurs in an epoch of the set."""
    common = math.gcd(*weights)
    return [weight // common for weight in weights]


def _rank(seed: int, episode_id: str) -> bytes:
    return hashlib.sha256(f"{seed}:{episode_id}".encode()).digest()


def _too_few(
    name: str,
    source: SourceRecipe,
    episodes: Sequence[Candidate],
    fitting: Sequence[Candidate],
    n_free: int,
    *,
    where: object,
) -> ActionSetError:
    known = Counter((tag, value) for episode in episodes for tag, value in episode.tags.items())
    tags = sorted({tag for tag, _ in known})
    by_others = "write a recipe by the tags there are: --recipe FILE.toml"
    for tag in (*source.where, *source.where_not):
        label = f"`vilp-data relabel EPISODES --set {tag}=VALUE`, or `vilp-data ingest LOG --set {tag}=VALUE`, gives them one"
        if tag not in tags:
            found = f"tags {', '.join(tags) or '(none)'}, of {len(episodes)} training episodes"
            what = f"source {name!r}: no training episode has the tag {tag!r}"
            return ActionSetError(what, where=where, found=found, remedy=f"{label}; or {by_others}")
        fit = [value for value in source.where.get(tag, ()) if (tag, value) in known]
        if tag in source.where and not fit:
            there = [f"{value} ({count})" for (other, value), count in sorted(known.items()) if other == tag]
            more = f" and {len(there) - _VALUES_SHOWN} more" if len(there) > _VALUES_SHOWN else ""
            what = f"source {name!r}: no training episode has {tag} = {' or '.join(source.where[tag])}"
            found = f"{tag} = {', '.join(there[:_VALUES_SHOWN])}{more}"
            return ActionSetError(
                what, where=where, found=found, remedy=f"record or ingest such ones; {label}; or {by_others}"
            )
    mute = sum(not episode.has_action for episode in fitting)
    masked = sum(episode.has_action and not episode.gives_labels for episode in fitting)
    taken = len(fitting) - mute - masked - n_free
    found = f"{n_free} of {len(episodes)} training episodes with {source}"
    found += f"; {mute} more have no actions" if mute else ""
    found += f"; {masked} more have no valid step" if masked else ""
    found += f"; {taken} more are in a source before" if taken else ""
    wanted = f"{source.count} episodes" if source.count else "one episode"
    remedy = "record or ingest more (validation episodes give no labels)"
    if source.count:
        remedy += ", take a preset that asks for fewer (--preset tiny)"
    remedy += ", or write a recipe with another count: --recipe FILE.toml"
    return ActionSetError(f"source {name!r}: there are too few for {wanted}", where=where, found=found, remedy=remedy)


def _complaint(location: tuple[int | str, ...], kind: str, message: str) -> str:
    place = ".".join(str(part) for part in location) or "(top level)"
    if kind != "extra_forbidden":
        return f"{place}: {message}"
    table = SourceRecipe if len(location) > 1 else ActionRecipe
    return f"unknown key {place}; {nearest(str(location[-1]), table.model_fields)}"
