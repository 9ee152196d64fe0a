"""Closed loop: a policy acts in many environments at once, and each episode becomes a result and, where asked for, a log.

    observe -> plan a chunk of n_action_steps actions -> execute it -> observe …      until done, or `max_steps`

Environments run in lockstep, in batches of `Environments.size`. What comes of a start does not depend on which others run beside
it, as far as the policy keeps to that: networks round a little differently at another batch size, and contacts amplify it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

import numpy as np

from vilp_data.errors import UsageError
from vilp_data.recorder import EpisodeRecorder
from vilp_data.sims.episode_log import START_NS, TickWriter, tick_writer
from vilp_data.spec import TaskSpec
from vilp_data.types import F32, ROLLOUT_TAG
from vilp_models.environments import Environments, Outcome
from vilp_models.policies.base import Observation, Policy
from vilp_models.starts import Start

REWARD_TOPIC = "/rollout/reward"

Progress = Callable[[int, int], None]
"""Told (environment steps done, in all)."""


@dataclass(frozen=True)
class EpisodeResult:
    """What one start came to. `policy_seed`: the start's; `max_reward`: the highest reward of any step; `success`: at any step."""

    name: str
    policy_seed: int
    max_reward: float
    success: bool
    n_steps: int


@dataclass
class Timing:
    """Seconds. `plan` is the time within `Policy.act`, of which `parts` are what the policy told; `n_plans` counts its calls,
    `n_steps` the steps of all environments together."""

    plan: float = 0.0
    environments: float = 0.0
    logs: float = 0.0
    n_plans: int = 0
    n_steps: int = 0
    parts: Counter[str] = field(default_factory=Counter)

    @property
    def steps_per_s(self) -> float:
        """Environment steps a second of everything together."""
        total = self.plan + self.environments + self.logs
        return self.n_steps / total if total else 0.0


@dataclass(frozen=True)
class LogPlan:
    """Where logs go, one `<start's name>.mcap` each, and what their tags say beside task, start, seeds, success and reward."""

    folder: Path
    tags: Mapping[str, str]

    def path(self, start: Start) -> Path:
        return self.folder / f"{start.name}.mcap"


def roll_out(
    spec: TaskSpec,
    policy: Policy,
    starts: Sequence[Start],
    *,
    max_steps: int,
    environments: int,
    logs: LogPlan | None = None,
    progress: Progress | None = None,
) -> tuple[list[EpisodeResult], Timing]:
    """One episode from every start, at most `environments` at a time; the results in the order of `starts`.

    `progress` counts steps, those saved by an early end included. Raises UsageError where the task has no simulator, the
    simulator does not offer what a policy needs, or the policy gives other than finite actions of its declared shape."""
    if not starts:
        raise UsageError("no start to roll out from", where=spec.name, remedy="name some seeds or episodes")
    results: list[EpisodeResult] = []
    timing = Timing()
    world: Environments | None = None
    try:
        for first in range(0, len(starts), environments):
            batch = starts[first : first + environments]
            if world is None or len(world) != len(batch):
                if world is not None:
                    world.close()
                world = Environments(spec, len(batch))
            run = _Batch(spec, policy, world, batch, timing, logs)
            told = None if progress is None else _counted(progress, first, len(batch), len(starts), max_steps)
            results += run.play(max_steps, told)
    finally:
        if world is not None:
            world.close()
    return results, timing


def _counted(progress: Progress, before: int, size: int, n_starts: int, max_steps: int) -> Callable[[int], None]:
    """From steps of this batch to steps of all."""
    return lambda step: progress(before * max_steps + step * size, n_starts * max_steps)


class _Batch:
    """One batch of starts, played to its end."""

    def __init__(
        self, spec: TaskSpec, policy: Policy, world: Environments, starts: Sequence[Start], timing: Timing,
        logs: LogPlan | None,
    ) -> None:  # fmt: skip
        self.policy, self.world, self.starts, self.timing = policy, world, starts, timing
        self.max_reward = np.full(len(starts), -np.inf)
        self.success = np.zeros(len(starts), np.bool_)
        self.done = np.zeros(len(starts), np.bool_)
        self.n_steps = np.zeros(len(starts), np.int64)
        self.logs = None if logs is None else _Logs(spec, world, starts, logs)

    def play(self, max_steps: int, progress: Callable[[int], None] | None) -> list[EpisodeResult]:
        with ExitStack() as files:
            began = perf_counter()
            observation = self.world.reset(self.starts)
            self.timing.environments += perf_counter() - began
            self.policy.reset([start.policy_seed for start in self.starts])
            if self.logs is not None:
                self.logs.open(files)
            step = 0
            while step < max_steps and not self.done.all():
                chunk = self._plan(observation)
                n_actions = min(len(chunk[0]), max_steps - step)
                for i, action in enumerate(chunk.swapaxes(0, 1)[:n_actions], start=1):
                    observation = self._step(action, looked_at=self.logs is not None or i == n_actions)
                    step += 1
                    if progress is not None:
                        progress(max_steps if self.done.all() else step)
                    if self.done.all():
                        break
            if self.logs is not None:
                self.logs.finish(self.results())
        return self.results()

    def results(self) -> list[EpisodeResult]:
        rows = zip(self.starts, self.max_reward, self.success, self.n_steps, strict=True)
        return [EpisodeResult(s.name, s.policy_seed, float(reward), bool(won), int(n)) for s, reward, won, n in rows]

    def _plan(self, observation: Observation) -> F32:
        began = perf_counter()
        chunk = self.policy.act(observation)
        self.timing.plan += perf_counter() - began
        self.timing.n_plans += 1
        self.timing.parts.update(self.policy.timings())
        expected = (*observation.hold_action.shape[:1], self.policy.n_action_steps, *observation.hold_action.shape[1:])
        if chunk.shape != expected or not np.isfinite(chunk).all():
            finite = "" if chunk.shape != expected else ", not finite"
            raise UsageError(
                "the policy gave no actions that can be taken",
                where=type(self.policy).__name__,
                found=f"{chunk.shape}{finite}, expected {expected} (environments, actions, action size)",
                remedy="train it on a dataset of this task, or look for NaN in its checkpoint",
            )
        return chunk

    def _step(self, action: F32, *, looked_at: bool) -> Observation:
        active = ~self.done
        if self.logs is not None:
            began = perf_counter()
            self.logs.tick(action, active)
            self.timing.logs += perf_counter() - began
        began = perf_counter()
        observation, outcome = self.world.step(action, draw=looked_at)
        self.timing.environments += perf_counter() - began
        self._take_note(outcome, active)
        return observation

    def _take_note(self, outcome: Outcome, active: np.typing.NDArray[np.bool_]) -> None:
        self.max_reward[active] = np.maximum(self.max_reward, outcome.reward)[active]
        self.success |= active & outcome.success
        self.n_steps += active
        self.timing.n_steps += int(active.sum())
        self.done |= outcome.done


class _Logs:
    """The logs of one batch, written tick by tick; they appear when the batch ends."""

    def __init__(self, spec: TaskSpec, world: Environments, starts: Sequence[Start], plan: LogPlan) -> None:
        self.spec, self.world, self.starts, self.plan = spec, world, starts, plan
        self.recorders: list[EpisodeRecorder] = []
        self.writers: list[TickWriter] = [tick_writer(spec, slot.env) for slot in world.slots]
        self.ticks = np.zeros(len(starts), np.int64)
        rate_hz = spec.rate_hz or float(world.slots[0].env.metadata.get("render_fps", 10))
        self.period_ns = round(1e9 / rate_hz)

    def open(self, files: ExitStack) -> None:
        for start in self.starts:
            tags = {
                "task": self.spec.name,
                **self.plan.tags,
                "start": start.name,
                "policy_seed": str(start.policy_seed),
            }
            if start.reset_seed is not None:
                tags["seed"] = str(start.reset_seed)  # as in a demonstration: what the environment is reset with
            metadata = {**tags, **dict([ROLLOUT_TAG])}
            recorder = EpisodeRecorder(self.plan.path(start), metadata=metadata, seed=start.policy_seed)
            self.recorders.append(files.enter_context(recorder))

    def tick(self, actions: F32, active: np.typing.NDArray[np.bool_]) -> None:
        """What each active environment shows now, and the action it is about to take."""
        for i in np.flatnonzero(active):
            self._write(int(i), actions[i])

    def finish(self, results: Sequence[EpisodeResult]) -> None:
        """The last tick of each, with the action that keeps still, and what came of it."""
        for i, (recorder, result) in enumerate(zip(self.recorders, results, strict=True)):
            self._write(i, np.asarray(self.world.slots[i].info["hold_action"], np.float32))
            recorder.metadata.update(
                success=str(result.success).lower(), max_reward=f"{result.max_reward:.6g}", n_steps=str(result.n_steps)
            )

    def _write(self, i: int, action: F32) -> None:
        slot, recorder = self.world.slots[i], self.recorders[i]
        stamp_ns = START_NS + int(self.ticks[i]) * self.period_ns
        self.writers[i](recorder, stamp_ns, slot.observation, slot.info, action)
        if self.ticks[i]:
            recorder.vector(REWARD_TOPIC, stamp_ns, [slot.reward])
        self.ticks[i] += 1
