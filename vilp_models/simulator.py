"""The simulator of a task, and what its environments keep to.

An environment is what `make_env` makes, and keeps to a small contract:

- `reset(seed=..., options={"state": state})` restores a recorded state; the seed is the episode's tag `seed`, if any;
- its constructor takes the task's `sim.options`, and `cameras=False` for a world that draws no images (replay needs none,
  and drawing is slow); it is not told `cameras` where images are wanted, so that is its default;
- observations are dicts that hold the views by name, as uint8 [H,W,3], and "low_dim", float32 [L], as the task's logs have it;
- every info holds "state", float64 [S], laid out like the episode's;
- for a policy to act in it (`rollout`), every info also holds "is_success" and "hold_action", float32 [A]: the action that
  keeps the robot where it is;
- how long an episode may be says `sim.max_steps` alone: a limit that was registered with gymnasium does not count, and an
  environment that says `truncated` by itself ends the episode there;
- where drawing takes long it may have a method `set_drawing(on)`: while told False, observations need not hold the views. A rollout without
  logs draws only what the policy sees, once in `n_action_steps`;
- `tags()`, where it has them, says what tells its world from others of the task ("goal", "object"), as its logs are tagged;
- its metadata may say `state_names`, `state_periods` (inf where a value does not wrap around), `controlled_state` (the
  indices that the actions command; others also depend on contacts, and on what a state leaves out) and
  `replay_tolerance`, in their unit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vilp_data.errors import UsageError
from vilp_data.sims import make_simulator
from vilp_data.spec import SimSpec, TaskSpec


def require_simulator(spec: TaskSpec) -> SimSpec:
    """The task's [sim] table. Raises UsageError where it has none."""
    if spec.sim is None:
        raise UsageError("this task has no simulator", where=spec.name, remedy="give its TOML a [sim] table with `env`")
    return spec.sim


def make_env(spec: TaskSpec, *, cameras: bool = True) -> Any:
    """The task's simulator, with or without images in its observations.

    Raises UsageError where the task names none, and as `make_simulator`."""
    sim = require_simulator(spec)
    return make_simulator(sim.env, sim.options if cameras else {**sim.options, "cameras": False})


WORLD_TAGS = ("goal", "object")
"""An episode that says another of these than an environment does was not recorded in its like."""


VARIANT_TAG = "variant"
"""Names the one of [record.variants] that an episode was recorded in; the task's own have none."""


def world_tags(env: Any) -> dict[str, str]:
    """Those of `WORLD_TAGS` that the environment says of itself."""
    tags: Mapping[str, str] = getattr(env.unwrapped, "tags", dict)()
    return {tag: tags[tag] for tag in WORLD_TAGS if tag in tags}


def is_of_world(tags: Mapping[str, str], world: Mapping[str, str]) -> bool:
    """Whether an episode of these tags may be of that world: no tag of it says otherwise, nor that it is of a variant."""
    return VARIANT_TAG not in tags and _fits(tags, world)


def _fits(tags: Mapping[str, str], world: Mapping[str, str]) -> bool:
    return all(tags.get(tag, value) == value for tag, value in world.items())


class Worlds:
    """The task's own environment and those of its variants ([record.variants]), made when they are needed."""

    def __init__(self, spec: TaskSpec, *, cameras: bool) -> None:
        self._spec, self._cameras = spec, cameras
        self._made: dict[str | None, Any] = {}

    def of(self, tags: Mapping[str, str]) -> Any:
        """The environment that an episode of these tags was recorded in: that of the variant they name; else the first that says of
        itself what they say; else the task's own."""
        if (named := tags.get(VARIANT_TAG)) in self._spec.record.variants:
            return self._env(named)
        for variant in (None, *self._spec.record.variants):
            env = self._env(variant)
            if _fits(tags, world_tags(env)):
                return env
        return self._env(None)

    def own_tags(self) -> dict[str, str]:
        """`world_tags` of the task's own."""
        return world_tags(self._env(None))

    def close(self) -> None:
        for env in self._made.values():
            env.close()

    def _env(self, variant: str | None) -> Any:
        if variant not in self._made:
            sim = self._spec.sim if variant is None else self._spec.simulated_as(variant)
            self._made[variant] = make_env(self._spec.model_copy(update={"sim": sim}), cameras=self._cameras)
        return self._made[variant]
