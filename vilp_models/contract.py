"""What of a dataset a model depends on: built in, written into its checkpoint, and compared before it meets another dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from vilp_data.episode_files import open_steps
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.errors import StoreError, UsageError
from vilp_data.labelled_episodes import LabelledEpisodes
from vilp_data.latent_runs import stats_path
from vilp_data.latents import latents_path, open_latents
from vilp_data.shards import read_header
from vilp_data.spec import TaskSpec, WindowSpec
from vilp_data.stats import ChannelStats

MIN_RELATIVE_STD = 1e-6
"""A channel whose deviation is below this share of its mean (of 1 for small means) counts as one that never changes."""

SAME_STD = 1e-4
"""Statistics are the same where mean and deviation agree to this share of the deviation: sums depend on the machine."""

Fields = tuple[Mapping[str, Any], ...]


Moments = Mapping[str, Sequence[float]]
"""{"mean": [C], "std": [C]} of the channels of one kind of value. A channel that never changes has a deviation of 1, so it
stays in its own unit: dividing by its true one would not end, or blow up the first value that is different."""


@dataclass(frozen=True)
class DataContract:
    """What of a dataset a model depends on. What a model does not use is empty, 0 or None, and then decides nothing.

    task           the task's name
    views          cameras, sorted
    geometry       view -> (height, width, fit) of stored frames; fit is "" where the spec states none
    depth          view -> {unit, near_m, far_m} of the views that measure, whose frames have one channel; {} where none does
    rate_hz        of the control clock
    frame_stride   (paper Δt) steps between planned frames, or between the two frames of a pair
    n_plan_frames  (paper N); 0 for a model of pairs, and for behaviour cloning, whose windows are as long as its chunks
    max_goal_frames
                   how far past the end planned frames may repeat the last one, which decides where windows begin; None like
                   n_plan_frames = 0, and in checkpoints of before it was recorded: then it is not compared
    latent_keys    view -> key of the encoder that made the latents; {} for models that see frames alone
    latent_shapes  view -> (c, h, w)
    low_dim        the parts of low_dim in the order of its columns, as in `TaskSpec.ingest_fields`; low_dim_size: columns
    action         the same for actions; action_size
    normaliser     "latents/<view>", "low_dim", "action" -> statistics over the training episodes of the run
    """

    task: str
    views: tuple[str, ...]
    geometry: Mapping[str, tuple[int, int, str]]
    rate_hz: float
    frame_stride: int
    n_plan_frames: int = 0
    max_goal_frames: int | None = None
    depth: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    latent_keys: Mapping[str, str] = field(default_factory=dict)
    latent_shapes: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)
    low_dim: Fields = ()
    low_dim_size: int = 0
    action: Fields = ()
    action_size: int = 0
    normaliser: Mapping[str, Moments] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        root: Path,
        spec: TaskSpec,
        *,
        train: Sequence[EpisodeEntry],
        latent_keys: Mapping[str, str] | None = None,
        window: WindowSpec | None = None,
        plans: bool = True,
        low_dim: bool = True,
        action: bool = True,
        labels: LabelledEpisodes | None = None,
    ) -> Self:
        """Of the dataset at `root` as it is now; statistics over the episodes `train` alone, which must not be empty.

        `spec` is the dataset's; `window` outranks its own. `latent_keys` names the encoder of each view whose latents are
        used. `plans` False is a model without planned frames, for which n_plan_frames and max_goal_frames decide nothing;
        without `low_dim` or `action` the model never sees them. Low_dim counts valid steps alone, actions those of episodes
        that have them. With `labels` of an action set, whose episodes `train` must be, statistics of actions are those that were
        locked with the set, and steps are read through it alone. Raises UsageError without training episodes, or without actions
        where they are wanted; StoreError for latents that are missing or stale."""
        if not train:
            raise UsageError(
                "there is no training episode", where=root, remedy="ingest more, or change the split's ratio"
            )
        _require_latents(root, train, latent_keys or {})
        store, window, fields = EpisodeStore(root), window or spec.window, spec.ingest_fields()
        acting = [entry for entry in train if entry.has_action]
        if action and not acting:
            remedy = "give the task [action], or train on episodes that were recorded with commands"
            raise UsageError("no training episode has actions", where=root, remedy=remedy)
        normaliser = _normaliser(store, train, latent_keys or {}, low_dim=low_dim and bool(spec.low_dim), labels=labels)
        if action:
            stats = ChannelStats.over(_valid_steps(store, acting, "action")) if labels is None else labels.action
            normaliser["action"] = moments(stats)
        return cls(
            **_of_views(spec),
            rate_hz=spec.rate_hz or train[0].rate_hz,
            frame_stride=window.frame_stride,
            n_plan_frames=window.n_plan_frames if plans else 0,
            max_goal_frames=window.max_goal_frames if plans else None,
            latent_keys=dict(sorted((latent_keys or {}).items())),
            latent_shapes={
                view: _latent_shape(root, view, key, train[0]) for view, key in sorted((latent_keys or {}).items())
            },
            low_dim=tuple(fields["low_dim"]) if low_dim else (),
            low_dim_size=len(normaliser["low_dim"]["mean"]) if "low_dim" in normaliser else 0,
            action=tuple(fields["action"]) if action else (),
            action_size=len(normaliser["action"]["mean"]) if action else 0,
            normaliser=normaliser,
        )

    def as_said_by(self, spec: TaskSpec, *, latent_keys: Mapping[str, str] | None = None) -> DataContract:
        """This contract, with what a task and the encoders' keys alone say in place of its own: what can be compared before
        any file is read. A dataset that differs there may lack the files that the rest would be read from."""
        fields = spec.ingest_fields()
        return replace(
            self,
            **_of_views(spec),
            rate_hz=spec.rate_hz or self.rate_hz,
            frame_stride=spec.window.frame_stride,
            n_plan_frames=spec.window.n_plan_frames if self.n_plan_frames else 0,
            max_goal_frames=None if self.max_goal_frames is None else spec.window.max_goal_frames,
            latent_keys=self.latent_keys if latent_keys is None else dict(sorted(latent_keys.items())),
            low_dim=tuple(fields["low_dim"]) if self.low_dim else (),
            action=tuple(fields["action"]) if self.action else (),
        )

    def now(
        self,
        root: Path,
        spec: TaskSpec,
        train: Sequence[EpisodeEntry],
        *,
        latent_keys: Mapping[str, str] | None = None,
        labels: LabelledEpisodes | None = None,
    ) -> DataContract:
        """The same of the dataset as it is now, to compare: statistics over `train`, which should be the entries of those
        episodes that the run was trained on. `latent_keys` are those of today's encoder; None means this contract's. `labels` as of
        `of`."""
        return DataContract.of(
            root,
            spec,
            train=train,
            latent_keys=self.latent_keys if latent_keys is None else latent_keys,
            plans=self.n_plan_frames > 0,
            low_dim=self.low_dim_size > 0,
            action=self.action_size > 0,
            labels=labels,
        )

    def image_channels(self, view: str) -> int:
        """Of the view's stored frames: 3 for RGB, 1 for depth."""
        return 1 if view in self.depth else 3

    def to_json(self) -> dict[str, Any]:
        """Plain data; `from_json` reads it back."""
        return asdict(self)

    @classmethod
    def from_json(cls, table: Mapping[str, Any]) -> Self:
        """Raises StoreError where `table` is no contract."""
        try:
            return cls(
                **{
                    **table,
                    "views": tuple(table["views"]),
                    "geometry": {view: (int(h), int(w), str(fit)) for view, (h, w, fit) in table["geometry"].items()},
                    "latent_shapes": {view: (c, h, w) for view, (c, h, w) in table["latent_shapes"].items()},
                    "low_dim": tuple(table["low_dim"]),
                    "action": tuple(table["action"]),
                    "normaliser": {
                        name: {"mean": list(row["mean"]), "std": list(row["std"])}
                        for name, row in table["normaliser"].items()
                    },
                }
            )
        except (KeyError, TypeError, ValueError) as error:
            raise StoreError(
                "not what a model says of its dataset", found=repr(error), remedy="train the model again with --restart"
            ) from error

    def require_same(self, now: DataContract, *, where: object, model: str = "MODEL") -> None:
        """Raise UsageError where the dataset at hand (`now`) is not what this contract was made of: it names the first
        field that differs, both values, and what makes it right. `where` is the run; `model` its kind, for the command."""
        for name, (title, remedy) in _WORDS.items():
            there, here = _differing(name, getattr(self, name), getattr(now, name))
            if there != here:
                raise UsageError(
                    f"this model was trained with {title} than the dataset at hand",
                    where=where,
                    found=f"{name} {_plain(there)} in the model, {_plain(here)} in the dataset",
                    remedy=remedy.format(again=f"`vilp-models train {model} --restart`", value=_plain(there)),
                )


_WORDS: Mapping[str, tuple[str, str]] = {
    "task": ("another task", "name the dataset of that task with --data, or train again: {again}"),
    "views": ("other views", "ingest with the views it knows, or train again: {again}"),
    "geometry": ("another image geometry", "ingest with the task's old size and fit, or train again: {again}"),
    "depth": ("another depth of its views", "ingest with the task's old `depth` tables, or train again: {again}"),
    "rate_hz": ("another control rate", "ingest at that rate (rate_hz in the task), or train again: {again}"),
    "frame_stride": (
        "another frame stride",
        "set frame_stride = {value} in the task's [window], or train again: {again}",
    ),
    "n_plan_frames": (
        "another number of planned frames",
        "set n_plan_frames = {value} in the task's [window], or train again: {again}",
    ),
    "max_goal_frames": (
        "another number of repeated last frames",
        "set max_goal_frames = {value} in the task's [window], or train again: {again}",
    ),
    "latent_keys": (
        "latents of another VQGAN",
        "name the VQGAN run it was trained with (--vqgan RUN; `vilp-data latents --run RUN` encodes with it), "
        "or train again: {again}",
    ),
    "latent_shapes": (
        "latents of another shape",
        "encode with the VQGAN run it was trained with, or train again: {again}",
    ),
    "low_dim": ("another low_dim", "ingest with the low_dim parts it knows, in that order, or train again: {again}"),
    "low_dim_size": ("another size of low_dim", "ingest with the low_dim parts it knows, or train again: {again}"),
    "action": ("other actions", "ingest with the action parts it knows, in that order, or train again: {again}"),
    "action_size": ("another size of actions", "ingest with the action parts it knows, or train again: {again}"),
    "normaliser": (
        "another normaliser",
        "the training episodes hold other values than then: put them back as they were, or train again: {again}",
    ),
}
"""Field -> (how it differs, what makes it right), in the order in which they are compared."""


_NOT_SAID: Mapping[str, int | None] = {"n_plan_frames": 0, "max_goal_frames": None}
"""Field -> the value with which one side says nothing of it, as an older checkpoint may; then there is nothing to compare."""


def _of_views(spec: TaskSpec) -> dict[str, Any]:
    return {
        "task": spec.name,
        "views": tuple(sorted(spec.views)),
        "geometry": {name: (view.height, view.width, view.fit or "") for name, view in sorted(spec.views.items())},
        "depth": {name: view.depth.model_dump() for name, view in sorted(spec.views.items()) if view.depth is not None},
    }


def _normaliser(
    store: EpisodeStore,
    train: Sequence[EpisodeEntry],
    latent_keys: Mapping[str, str],
    *,
    low_dim: bool,
    labels: LabelledEpisodes | None,
) -> dict[str, Moments]:
    """Of what the model sees: latents and, where asked, low_dim."""
    normaliser = {
        f"latents/{view}": moments(_latent_stats(store.root, view, key, train))
        for view, key in sorted(latent_keys.items())
    }
    if low_dim:
        normaliser["low_dim"] = moments(ChannelStats.over(_valid_steps(store, train, "low_dim", labels)))
    return normaliser


def moments(stats: ChannelStats) -> Moments:
    """Mean and deviation as a network normalises with them."""
    still = stats.std <= MIN_RELATIVE_STD * np.maximum(1.0, np.abs(stats.mean))
    return {"mean": stats.mean.tolist(), "std": np.where(still, 1.0, stats.std).tolist()}


def _same_moments(one: Moments, other: Moments) -> bool:
    if len(one["mean"]) != len(other["mean"]):
        return False
    scale = SAME_STD * np.array(one["std"])
    return all(bool((np.abs(np.subtract(one[name], other[name])) <= scale).all()) for name in ("mean", "std"))


def _differing(name: str, there: Any, here: Any) -> tuple[Any, Any]:
    """What of a field is not the same, of mappings the entries; two equal values where nothing is, or where one side says nothing."""
    if name in _NOT_SAID and _NOT_SAID[name] in (there, here):
        return None, None
    if name == "normaliser":
        return _other_moments(there, here)
    return _other_entries(there, here) if isinstance(there, Mapping) else (there, here)


def _other_entries(there: Mapping[str, Any], here: Mapping[str, Any]) -> tuple[Any, Any]:
    names = [name for name in sorted({*there, *here}) if there.get(name) != here.get(name)]
    return tuple({name: table[name] for name in names if name in table} for table in (there, here))  # type: ignore[return-value]


def _other_moments(there: Mapping[str, Moments], here: Mapping[str, Moments]) -> tuple[Any, Any]:
    for name in sorted({*there, *here}):
        one, other = there.get(name), here.get(name)
        if one is None or other is None or not _same_moments(one, other):
            return {name: _rounded(one)}, {name: _rounded(other)}
    return {}, {}


def _rounded(table: Moments | None) -> str:
    if table is None:
        return "none"
    channels = [f"{mean:.6g} ± {std:.6g}" for mean, std in zip(table["mean"], table["std"], strict=True)]
    return ", ".join(channels[:4]) + (", …" if len(channels) > 4 else "")


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {_plain(item)}" for name, item in value.items()) or "none"
    if isinstance(value, tuple | list):
        return ", ".join(map(_plain, value)) or "none"
    return str(value)


def _require_latents(root: Path, train: Sequence[EpisodeEntry], latent_keys: Mapping[str, str]) -> None:
    for view, key in latent_keys.items():
        missing = [entry.id for entry in train if not latents_path(root, view, key, entry.id).is_file()]
        if missing:
            found = f"{len(missing)} of {len(train)} training episodes are not encoded, such as {missing[0]}"
            where = root / "latents" / view / key
            raise StoreError("latents are missing", where=where, found=found, remedy="run `vilp-data latents`")


def _latent_stats(root: Path, view: str, key: str, train: Sequence[EpisodeEntry]) -> ChannelStats:
    """Those that `vilp-data latents` wrote for just these episodes, else taken now; nothing is written."""
    path = stats_path(root, view, key, {entry.id: entry.key for entry in train})
    if path.is_file():
        return ChannelStats.from_json(path.read_bytes(), where=path)[0]
    return ChannelStats.over((open_latents(root, entry, view, key) for entry in train), channel_axis=1)


def _latent_shape(root: Path, view: str, key: str, entry: EpisodeEntry) -> tuple[int, int, int]:
    shape: Sequence[int] = read_header(latents_path(root, view, key, entry.id)).tensors["latents"].shape
    c, h, w = shape[1:]
    return c, h, w


def _valid_steps(
    store: EpisodeStore, entries: Sequence[EpisodeEntry], name: str, labels: LabelledEpisodes | None = None
) -> Iterator[npt.NDArray[Any]]:
    for entry in entries:
        arrays = open_steps(store, entry) if labels is None else labels.open_steps(entry)
        yield arrays[name][arrays["valid"]]


ContractOf = Callable[[Sequence[EpisodeEntry]], DataContract]
"""The contract of a dataset as it is now, with statistics over these episodes."""
