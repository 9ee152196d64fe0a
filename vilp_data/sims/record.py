"""Record demonstrations: the scripted expert of a task drives its environment, and each episode becomes one log.

    t_k = t_0 + k / rate     cameras and joints measure, the simulator's state is taken, then action k is issued; all stamped t_k

An arm's joints, end effector and gripper measure again at t_k + 50 ms. The last tick holds the final observation and the command to
stand still, so every tick has both.
"""

from __future__ import annotations

import contextlib
import ctypes.util
import importlib.util
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

from vilp_data.engine import cpu_count, map_unordered
from vilp_data.errors import LogError, UsageError, VilpDataError, nearest
from vilp_data.recorder import EpisodeRecorder
from vilp_data.sims import ENVIRONMENTS, load_entry_point, make_simulator
from vilp_data.sims.episode_log import START_NS, tick_writer
from vilp_data.sims.finished_log import finished_log
from vilp_data.sims.source_digest import source_digest
from vilp_data.spec import SimSpec, TaskSpec
from vilp_data.types import F32


class Expert(Protocol):
    """Made as `Kind(env, seed=seed)` from an environment that was just reset; `seed` is for what it does now this way, now that.

    goes_on_after_success  whether it may end its last move when the environment has called the episode a success
    """

    goes_on_after_success: bool

    def actions(self) -> Iterator[F32]:
        """Float32 [A] each; the environment is stepped with one before the next is asked for."""
        ...

    def tags(self) -> Mapping[str, str]:
        """How it does this episode."""
        ...


@dataclass(frozen=True)
class _Recordable:
    """The expert of an environment ("module:Class"), the packages that both need, and those whose version a log states."""

    expert: str
    packages: tuple[str, ...]
    stated: tuple[str, ...]


RECORDABLE = {
    "vilp/ArrangeBlocks-v0": _Recordable(
        "vilp_data.sims.arrange_blocks_expert:ArrangeBlocksExpert", ("gymnasium", "pymunk"), ("pymunk",)
    ),
    "vilp/Can-v0": _Recordable(
        "vilp_data.sims.can_expert:CanExpert", ("gymnasium", "mujoco", "robosuite"), ("robosuite", "mujoco")
    ),
    "vilp/Hanoi-v0": _Recordable(
        "vilp_data.sims.hanoi_expert:HanoiExpert", ("gymnasium", "mujoco", "robosuite"), ("robosuite", "mujoco")
    ),
    "vilp/MoveTheStack-v0": _Recordable(
        "vilp_data.sims.move_the_stack_expert:MoveTheStackExpert",
        ("gymnasium", "mujoco", "robosuite"),
        ("robosuite", "mujoco"),
    ),
    "vilp/NutAssembly-v0": _Recordable(
        "vilp_data.sims.nut_assembly_expert:NutAssemblyExpert",
        ("gymnasium", "mujoco", "robosuite"),
        ("robosuite", "mujoco"),
    ),
    "vilp/PushT-v0": _Recordable(
        "vilp_data.sims.pusht_expert:PushTExpert", ("gymnasium", "gym_pusht", "pymunk"), ("gym-pusht", "pymunk")
    ),
}


@dataclass(frozen=True)
class RecordedEpisode:
    """A finished log. `n_steps` counts the actions that were executed. `says_what_made_it`: not so an earlier one that was kept, of which
    nobody knows whether the same code would record it again."""

    path: Path
    seed: int
    success: bool
    n_steps: int
    says_what_made_it: bool = True


@dataclass(frozen=True)
class _Job:
    spec: TaskSpec
    sim: SimSpec  # with the variant's options
    variant: str | None
    path: Path
    seed: int
    made_from: Mapping[str, str]


def record_task(
    spec: TaskSpec,
    out_dir: Path,
    *,
    episodes: int,
    first_seed: int,
    variant: str | None = None,
    workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[RecordedEpisode]:
    """Record one episode for each of `episodes` seeds from `first_seed` on, into `out_dir/<task>-seed0000007.mcap`.

    A finished log that the same task, seed, options, limit of steps, code and versions made is kept; anything unfinished or damaged is
    made again. Failures of the expert are written too,
    with success "false" in their metadata: it may take as many steps as a policy (`spec.sim.max_steps`). `spec.sim.options` go to the
    environment, those of `variant` (one of `spec.record.variants`) on top; its logs are `<task>-<variant>-seed…` and say so. `workers` 0
    means one process for each core. `progress` hears (done, total) after each; the list returned is in order of seed.

    Raises UsageError where the task has no scripted expert, the simulator is not installed, it or the expert fails (with the seed and
    the place), or a log in `out_dir` was made from something else; SpecError for a variant that it does not have, and for seeds that run
    into those of another part of `spec.record`.
    """
    if spec.sim is None or (spec.sim.expert is None and spec.sim.env not in RECORDABLE):
        env = "no [sim] table" if spec.sim is None else spec.sim.env
        remedy = f"{nearest(env, RECORDABLE)}, or name one of yours as `expert` of [sim] (docs/add_a_task.md)"
        raise UsageError("there is no scripted expert for this task", where=spec.name, found=env, remedy=remedy)
    seeds = range(first_seed, first_seed + episodes)
    name = spec.name if variant is None else f"{spec.name}-{variant}"
    sim = spec.sim if variant is None else spec.simulated_as(variant)
    spec.record.require_apart(variant, seeds, where=spec.name)
    code = _made_from(sim)
    jobs = [_Job(spec, sim, variant, out_dir / f"{name}-seed{seed:07d}.mcap", seed, code) for seed in seeds]
    done = {job.seed: kept for job in jobs if (kept := _finished(job)) is not None}
    todo = [job for job in jobs if job.seed not in done]
    if progress is not None:
        progress(len(done), len(jobs))
    if todo:
        _require_for(sim)
    with contextlib.closing(map_unordered(_record_one, todo, workers=workers or cpu_count())) as recorded:
        for job, episode in recorded:
            done[job.seed] = episode
            if progress is not None:
                progress(len(done), len(jobs))
    return [done[job.seed] for job in jobs]


def _recordable(sim: SimSpec) -> _Recordable:
    """Of a simulator of someone else's nothing is known but that it needs gymnasium."""
    return RECORDABLE[sim.env] if sim.expert is None else _Recordable(sim.expert, ("gymnasium",), ())


def _require_for(sim: SimSpec) -> None:
    packages = _recordable(sim).packages
    if "robosuite" in packages:
        require_simulator(cameras=bool(sim.options.get("cameras", True)))
    else:
        _require_packages(packages)


def require_simulator(*, cameras: bool) -> None:
    """UsageError with the one command that helps, where robosuite or the software renderer is missing."""
    _require_packages(RECORDABLE["vilp/Hanoi-v0"].packages)
    draws_in_software = sys.platform.startswith("linux") and os.environ.get("MUJOCO_GL", "osmesa") == "osmesa"
    if cameras and draws_in_software and ctypes.util.find_library("OSMesa") is None:
        raise UsageError(
            "the cameras cannot be drawn",
            found="no libOSMesa (MUJOCO_GL=osmesa)",
            remedy="sudo apt-get install -y libosmesa6",
        )


def _require_packages(names: Sequence[str]) -> None:
    missing = [name for name in names if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(
            "the simulator is not installed", found=f"no package called {', '.join(missing)}", remedy="make setup"
        )


def _finished(job: _Job) -> RecordedEpisode | None:
    """The episode in a log that is already there; UsageError where it was made from something else. One that is damaged is made again:
    its seed gives the same."""
    try:
        finished = finished_log(job.path, _stated(job), job.made_from)
    except LogError:
        return None
    if finished is None:
        return None
    tags = finished.tags
    return RecordedEpisode(
        job.path, job.seed, tags["success"] == "true", int(tags["n_steps"]), finished.says_what_made_it
    )


def _stated(job: _Job) -> dict[str, str]:
    """Tags that say what a log is made from."""
    return {
        "task": job.spec.name,
        "seed": str(job.seed),
        "options": _options_text(job.sim),
        **{f"{name}_version": version(name) for name in ("vilp", *_recordable(job.sim).stated) if _is_installed(name)},
    }


def _is_installed(package: str) -> bool:
    with contextlib.suppress(PackageNotFoundError):
        return bool(version(package))
    return False


def _made_from(sim: SimSpec) -> dict[str, str]:
    """What else makes a log what it is: who drives what, for how long, and the code of both."""
    expert = _recordable(sim).expert
    modules = [name.partition(":")[0] for name in (ENVIRONMENTS.get(sim.env, sim.env), expert) if ":" in name]
    return {"env": sim.env, "expert": expert, "max_steps": str(sim.max_steps), "source_sha256": source_digest(modules)}


def _options_text(sim: SimSpec) -> str:
    return json.dumps(dict(sim.options), sort_keys=True)


def _make_expert(sim: SimSpec, env: Any, seed: int) -> Expert:
    entry_point = _recordable(sim).expert
    try:
        kind = load_entry_point(entry_point)
    except (ImportError, AttributeError) as error:
        remedy = "`expert` of [sim] is MODULE:CLASS, whose module must be on PYTHONPATH"
        raise UsageError("the expert cannot be loaded", where=entry_point, found=error, remedy=remedy) from error
    expert: Expert = kind(env, seed=seed)
    return expert


def _record_one(job: _Job) -> RecordedEpisode:
    """Runs in a worker process: the simulator is imported here. What goes wrong in someone's own is an error of theirs, with its place."""
    try:
        return _played(job)
    except VilpDataError:
        raise
    except Exception as error:
        found = f"{type(error).__name__}: {error} ({_place(error)})"
        remedy = "correct it there, and record again: finished logs are kept"
        raise UsageError("not recorded", where=_where(job), found=found, remedy=remedy) from error


def _played(job: _Job) -> RecordedEpisode:
    env = make_simulator(job.sim.env, job.sim.options)
    try:
        observation, info = env.reset(seed=job.seed)
        _refuse_incomplete(job, observation, info)
        expert = _make_expert(job.sim, env, job.seed)
        write = tick_writer(job.spec, env)
        with EpisodeRecorder(job.path, metadata=_tags(job, env, expert), made_from=job.made_from, seed=job.seed) as log:
            tick, tick_ns = 0, round(1e9 / (job.spec.rate_hz or env.metadata["render_fps"]))
            for action in islice(expert.actions(), job.sim.max_steps):
                write(log, START_NS + tick * tick_ns, observation, info, action)
                observation, _, terminated, truncated, info = env.step(action)
                tick += 1
                if truncated or (terminated and not expert.goes_on_after_success):
                    break
            write(log, START_NS + tick * tick_ns, observation, info, info["hold_action"])
            log.metadata.update(success=str(info["is_success"]).lower(), n_steps=str(tick))
    finally:
        env.close()
    return RecordedEpisode(job.path, job.seed, bool(info["is_success"]), tick)


def _where(job: _Job) -> str:
    return f"{job.sim.env}, seed {job.seed}"


def _place(error: Exception) -> str:
    """File and line of the innermost frame that is not an installed package's, if there is one (VILP may itself be installed)."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "site-packages" not in Path(frame.filename).parts]
    innermost = (own or frames)[-1]
    return f"{innermost.filename}:{innermost.lineno}"


def _refuse_incomplete(job: _Job, observation: Mapping[str, Any], info: Mapping[str, Any]) -> None:
    for what, given, needed in (
        ("observation", observation, ("low_dim", *job.spec.views)),
        ("info", info, ("state", "is_success", "hold_action")),
    ):
        for name in needed:
            if name not in given:
                raise UsageError(
                    f"the simulator's {what} lacks {name!r}",
                    where=_where(job),
                    found=", ".join(given),
                    remedy="docs/add_a_task.md says what an environment keeps to",
                )


def _tags(job: _Job, env: Any, expert: Expert) -> dict[str, str]:
    return {
        **(env.tags() if hasattr(env, "tags") else {}),
        **expert.tags(),
        **({} if job.variant is None else {"variant": job.variant}),
        "policy": "scripted_expert",
        **_stated(job),
    }
