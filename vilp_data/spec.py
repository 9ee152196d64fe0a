"""TaskSpec: one TOML a task, validated into frozen models before anything runs."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from vilp_data.episodes_spec import EpisodesSpec
from vilp_data.errors import SpecError, nearest
from vilp_data.types import Clock

PRESETS = ("tiny", "cpu", "paper")


class Frozen(BaseModel):
    """A table of the TOML: immutable, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TopicSpec(Frozen):
    """Where a value comes from and which clock stamps it.

    clock          "header" (the message's own stamp), "log" (when the recorder received it) or "publish"
    offset_s       added to the stamp, for a clock known to be off
    stale_after_s  an older value makes the step invalid
    """

    topic: str
    clock: Clock = "header"
    offset_s: float = 0.0
    stale_after_s: float = Field(default=0.5, gt=0)


class DepthSpec(Frozen):
    """What the numbers of a depth view mean, and which distances its stored levels span.

    unit           of the numbers in the messages: "mm" or "m"
    near_m, far_m  stored as 1 and as 255; nearer and farther readings are clipped to them. 0 is stored where there is no reading
    """

    unit: Literal["mm", "m"]
    near_m: float = Field(ge=0, allow_inf_nan=False)
    far_m: float = Field(gt=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.near_m >= self.far_m:
            raise ValueError(f"near_m = {self.near_m} must be less than far_m = {self.far_m}")
        return self


class ViewSpec(TopicSpec):
    """A camera, and the size its images are stored at. `fit` says what to do with another aspect ratio; unstated is refused.

    depth   the topic measures distance: frames are stored with one channel instead of three
    levels  (black, white) of a camera of one channel and 16 bits, whose messages do not say how bright white is
    """

    height: int = Field(gt=0)
    width: int = Field(gt=0)
    fit: Literal["crop", "pad", "stretch"] | None = None
    depth: DepthSpec | None = None
    levels: tuple[int, int] | None = None

    @model_validator(mode="after")
    def _one_meaning(self) -> Self:
        if self.depth is not None and self.levels is not None:
            raise ValueError("`depth` is of distances and `levels` of grey pictures: a view has one of them")
        if self.levels is not None and not 0 <= self.levels[0] < self.levels[1] <= 65535:
            raise ValueError(f"levels = {list(self.levels)}: black comes before white, both within 0 to 65535")
        return self

    @model_serializer(mode="wrap")
    def _as_stated(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """`depth` and `levels` only where they are stated: a view without them keeps the key that it had before there were any."""
        unstated = [name for name in ("depth", "levels") if getattr(self, name) is None]
        return {name: value for name, value in plain(self).items() if name not in unstated}

    @property
    def channels(self) -> int:
        """Of the stored frames: 1 for depth, 3 (RGB) for pictures."""
        return 3 if self.depth is None else 1


class TransformSpec(Frozen):
    """For topics of transforms (tf): the vector is where `to_frame` lies in `from_frame`, translation x y z and unit quaternion x y z w
    of continuous sign, resolved through the tree of frames. Transforms of the topic with `_static` after its name hold always.
    """

    from_frame: str | None = None
    to_frame: str | None = None

    @model_validator(mode="after")
    def _two_frames(self) -> Self:
        if (self.from_frame is None) != (self.to_frame is None):
            raise ValueError("from_frame and to_frame go together: the vector is where to_frame lies in from_frame")
        if self.from_frame is not None and self.from_frame.lstrip("/") == str(self.to_frame).lstrip("/"):
            raise ValueError(f"from_frame and to_frame are both {self.from_frame!r}: a frame never moves in itself")
        return self

    @model_serializer(mode="wrap")
    def _with_frames_if_stated(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the two frames where none is stated: such a vector keeps the key that it had before there were any."""
        unstated = ("from_frame", "to_frame") if self.from_frame is None else ()
        return {name: value for name, value in plain(self).items() if name not in unstated}


class VectorSpec(TopicSpec, TransformSpec):
    """A vector read from a topic's messages.

    fields  paths into the message, concatenated: "pose.position.x", "position[0:7]", "pose" (its seven numbers), "[0:2]" for a
            bare array; unstated: what is usual for the message's type. Of two frames: "translation", "rotation", "translation.x", …
    names   for messages with parallel `name` lists (JointState): which joints, in this order; a robot may publish any order, and
            messages of other joints only are passed over
    """

    fields: tuple[str, ...] = ()
    names: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _no_names_of_frames(self) -> Self:
        if self.from_frame is not None and self.names:
            raise ValueError("`names` is of joints, from_frame of transforms: a vector is one of them")
        return self


class ActionSpec(TransformSpec):
    """One part of the action vector: a command topic, or a state some steps ahead for logs that recorded no commands.

    kind "absolute": the last command issued in [t_k, t_{k+1}), else the one still held (grippers too)
    kind "delta": commands issued in the interval summed, zero where there was none; never held
    kind "delta_rotation": axis-angle vectors in radians, composed as rotations over the interval; `frame` says in which order:
                 "base" and "world" (fixed) or "tool" (moving with the tool)
    holds        of absolute commands: the low_dim part that, given as a command, keeps the robot where it is. Decides nothing in
                 ingested files
    """

    topic: str | None = None
    fields: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    clock: Clock = "header"
    offset_s: float = 0.0
    kind: Literal["absolute", "delta", "delta_rotation"] = "absolute"
    unit: str = ""
    frame: str = ""
    from_: str | None = Field(default=None, alias="from")
    shift: int = Field(default=1, ge=1)
    holds: str | None = None

    @model_validator(mode="after")
    def _one_origin(self) -> Self:
        if (self.topic is None) == (self.from_ is None):
            raise ValueError(
                "an action part needs exactly one of `topic` (recorded commands) and `from` (a low_dim part, `shift` steps ahead)"
            )
        if self.from_frame is not None and (self.topic is None or self.kind != "absolute" or self.names):
            raise ValueError(
                'an action between two frames is `topic`, from_frame and to_frame, of kind "absolute", without `names`'
            )
        if self.kind == "delta_rotation" and self.frame not in ("base", "world", "tool"):
            raise ValueError(
                f'a delta_rotation composes differently by its frame: frame = "base", "world" or "tool", not {self.frame!r}'
            )
        if self.from_ is not None and self.kind != "absolute":
            raise ValueError(f"`from = {self.from_!r}` gives absolute targets, but kind = {self.kind!r}")
        if self.holds is not None and self.kind != "absolute":
            raise ValueError(f"`holds = {self.holds!r}` is of absolute commands, but kind = {self.kind!r}")
        return self


class SplitSpec(Frozen):
    """ratio: share of training episodes. group_by, strata: tag names; episodes of one group stay on one side."""

    ratio: float = Field(default=0.9, gt=0, lt=1)
    seed: int = 0
    group_by: str | None = None
    strata: tuple[str, ...] = ()


class WindowSpec(Frozen):
    """n_plan_frames (paper N) frames, frame_stride (paper Δt) steps apart. `max_goal_frames` limits how far past the end a clip
    may repeat the last frame."""

    n_plan_frames: int = Field(default=6, gt=0)
    frame_stride: int = Field(default=2, gt=0)
    max_goal_frames: int = Field(default=6, ge=0)


class SimSpec(Frozen):
    """The simulator of this task: a gymnasium id, keyword arguments for it, and how many steps a policy may take in it. `expert`
    ("module:Class") is who `record` lets drive it, where it is none of ours."""

    env: str
    options: dict[str, Any] = {}
    max_steps: int = Field(default=300, gt=0)
    expert: str | None = Field(default=None, pattern=r"^[\w.]+:\w+$")

    @model_serializer(mode="wrap")
    def _with_expert_if_stated(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without it where none is stated, as before there was any."""
        return {name: value for name, value in plain(self).items() if name != "expert" or value}


class VariantSpec(Frozen):
    """Episodes of the same simulator with other options (those of `[sim]` stay where these say nothing), in logs with a name and a tag of
    their own: demonstrations off target."""

    episodes: int = Field(gt=0)
    first_seed: int = Field(ge=0)
    options: dict[str, Any]

    @property
    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.episodes)


class RecordSpec(Frozen):
    """How many episodes `record` makes, from which seed on; and of which variants of the task, by name. Policies are tuned and judged on
    other seeds (0:50, 100000:100050), so that no start was trained on."""

    episodes: int = Field(default=24, gt=0)
    first_seed: int = Field(default=1000, ge=0)
    variants: dict[str, VariantSpec] = {}

    @property
    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.episodes)

    def require_apart(self, variant: str | None, seeds: range, *, where: str) -> None:
        """Raise SpecError where `seeds` for `variant` (None: the task itself) run into those of another part of this table. An expert draws
        from the seed alone: two episodes of one seed may have the same actions, one of them in validation."""
        parts: dict[str | None, range] = {None: self.seeds, **{name: one.seeds for name, one in self.variants.items()}}
        for other, others in parts.items():
            if other != variant and seeds.start < others.stop and others.start < seeds.stop:
                free = max(part.stop for part in parts.values())
                raise SpecError(
                    f"{_part(variant)} and {_part(other)} would be recorded from the same seeds",
                    where=where,
                    found=f"{_shown(seeds)} and {_shown(others)}: one seed gives both the same start and the same actions",
                    remedy=f"another first_seed for {_part(variant)}, such as {free}, or fewer episodes",
                )

    @model_serializer(mode="wrap")
    def _with_variants_if_stated(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without variants where none are stated, as before there were any."""
        return {name: value for name, value in plain(self).items() if name != "variants" or value}

    @model_validator(mode="after")
    def _names_fit(self) -> Self:
        for name in self.variants:
            if not name.replace("_", "").isalnum():
                raise ValueError(f"variant {name!r} becomes part of a file's name: letters, digits and _ only")
        return self


def _part(variant: str | None) -> str:
    return "[record]" if variant is None else f"[record.variants.{variant}]"


def _shown(seeds: range) -> str:
    return f"{seeds.start} to {seeds.stop - 1}"


class TaskSpec(Frozen):
    """A task: what its logs hold, on which clock, at which size, and how models train on it.

    rate_hz None means the rate of the slowest camera. A task without views is of logs without cameras: it can be ingested, looked at,
    checked and exported, and only behaviour cloning trains on it. `models` holds the tables of vilp_models, which validates them.
    `tags` are of demonstrations in logs that do not say what they show: file name, or a pattern of it ("*.zarr") -> tag -> value.
    """

    name: str
    rate_hz: float | None = Field(default=None, gt=0)
    views: dict[str, ViewSpec] = {}
    low_dim: dict[str, VectorSpec] = {}
    action: dict[str, ActionSpec] = {}
    state: VectorSpec | None = None
    episodes: EpisodesSpec = EpisodesSpec()
    split: SplitSpec = SplitSpec()
    window: WindowSpec = WindowSpec()
    sim: SimSpec | None = None
    record: RecordSpec = RecordSpec()
    models: dict[str, dict[str, Any]] = {}
    tags: dict[str, dict[str, str]] = {}

    @model_serializer(mode="wrap")
    def _with_tags_if_stated(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without tags where none are stated, as before there were any."""
        return {name: value for name, value in plain(self).items() if name != "tags" or value}

    @model_validator(mode="after")
    def _names_fit(self) -> Self:
        for part, spec in self.action.items():
            for key, named in (("from", spec.from_), ("holds", spec.holds)):
                if named is not None and named not in self.low_dim:
                    raise ValueError(
                        f"action.{part}: {key} = {named!r} is no low_dim part; {nearest(named, self.low_dim)}"
                    )
        topics = [view.topic for view in self.views.values()]
        if twice := {topic for topic in topics if topics.count(topic) > 1}:
            raise ValueError(f"two views read topic {min(twice)!r}; a topic is one view")
        for view in [*self.views, self.name]:
            if not view.replace("_", "").replace("-", "").isalnum():
                raise ValueError(f"{view!r} becomes a folder's name: letters, digits, - and _ only")
        return self

    @model_validator(mode="after")
    def _something_to_step_by(self) -> Self:
        if not self.views and not self.low_dim:
            raise ValueError(
                "a task needs a view ([views.NAME]), or for logs without cameras a low_dim part ([low_dim.NAME])"
            )
        if not self.views and self.rate_hz is None:
            raise ValueError("a task without views states its rate_hz: there is no camera to take it from")
        return self

    @model_validator(mode="after")
    def _one_reading_a_topic(self) -> Self:
        readings: dict[str, bool] = {}
        for spec in self._topic_specs():
            frames = getattr(spec, "from_frame", None) is not None
            if readings.setdefault(str(spec.topic), frames) != frames:
                raise ValueError(f"topic {spec.topic!r} is read both as transforms (from_frame) and otherwise")
        return self

    @model_validator(mode="after")
    def _one_clock_a_topic(self) -> Self:
        for spec in self._topic_specs():
            first = self.clocks()[str(spec.topic)]
            if (spec.clock, spec.offset_s) != (first.clock, first.offset_s):
                raise ValueError(
                    f"topic {spec.topic!r} is read by two clocks: {first.clock} {first.offset_s:+} s and {spec.clock} {spec.offset_s:+} s"
                )
        return self

    def clocks(self) -> dict[str, TopicSpec | ActionSpec]:
        """Topic -> the table that says which clock stamps it."""
        return {str(spec.topic): spec for spec in reversed(self._topic_specs())}

    def topics(self) -> list[str]:
        """Every topic the spec reads, each once."""
        return list(dict.fromkeys(str(spec.topic) for spec in self._topic_specs()))

    def _topic_specs(self) -> list[TopicSpec | ActionSpec]:
        specs: list[TopicSpec | ActionSpec] = [
            *self.views.values(),
            *self.low_dim.values(),
            *self.action.values(),
            *([self.state] if self.state else []),
        ]
        return [spec for spec in specs if spec.topic is not None]

    def simulated_as(self, name: str) -> SimSpec:
        """The simulator of one of the task's [record.variants]: with the variant's options. SpecError for a name it does not have."""
        if self.sim is None or name not in self.record.variants:
            known = nearest(name, self.record.variants) if self.record.variants else "it has none"
            raise SpecError(f"the task has no variant {name!r}", where=self.name, remedy=known)
        options = {**self.sim.options, **self.record.variants[name].options}
        return self.sim.model_copy(update={"options": options})

    def tags_of(self, log: str) -> dict[str, str]:
        """The tags that the task gives the demonstrations in a log of this file name."""
        matching = [tags for pattern, tags in self.tags.items() if fnmatchcase(log, pattern)]
        return {tag: value for tags in matching for tag, value in tags.items()}

    def ingest_fields(self) -> dict[str, Any]:
        """What decides the bytes of an ingested episode, as plain data: part of every episode's key.

        The parts of vectors are lists, since their order is the order of the columns."""
        fields = self.model_dump(mode="json", by_alias=True, include={"rate_hz", "views", "low_dim", "action", "state"})
        for vector in ("low_dim", "action"):
            fields[vector] = [{"part": name, **table} for name, table in fields[vector].items()]
        for part in fields["action"]:
            del part["holds"]
        cuts = self.episodes.ingest_fields()
        return fields if cuts is None else fields | {"episodes": cuts}
