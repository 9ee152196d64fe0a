"""Record demonstrations: the scripted expert of a task drives its environment, and each episode becomes one log.

    t_k = t_0 + k / 10 Hz     cameras and joints measure, the simulator's state is taken, then action k is issued; all stamped t_k
    t_k + 50 ms               joints, end effector and gripper measure again

The last tick holds the final observation and the command to stand still, so every tick has both.
"""

from __future__ import annotations

import contextlib
import ctypes.util
import importlib.util
import json
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vilp_data.engine import cpu_count, map_unordered
from vilp_data.errors import LogError, UsageError, nearest
from vilp_data.recorder import EpisodeRecorder
from vilp_data.sims.episode_log import START_NS
from vilp_data.sims.finished_log import finished_tags
from vilp_data.spec import TaskSpec

if TYPE_CHECKING:
    from vilp_data.sims.hanoi import HanoiEnv

TICK_NS = 100_000_000
RECORDABLE = ("vilp/Hanoi-v0",)


@dataclass(frozen=True)
class RecordedEpisode:
    """A finished log. `n_steps` counts the actions that were executed."""

    path: Path
    seed: int
    success: bool
    n_steps: int


@dataclass(frozen=True)
class _Job:
    task: str
    options: Mapping[str, Any]
    path: Path
    seed: int


def record_task(
    spec: TaskSpec,
    out_dir: Path,
    *,
    episodes: int,
    first_seed: int,
    workers: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[RecordedEpisode]:
    """Record one episode for each of `episodes` seeds from `first_seed` on, into `out_dir/<task>-seed0000007.mcap`.

    A finished log of the same seed and options is kept; anything unfinished is made again. Failures of the expert are written too,
    with success "false" in their metadata. `spec.sim.options` go to the environment. `workers` 0 means one process
    for each core. `progress` hears (done, total) after each; the list returned is in order of seed.

    Raises UsageError where the task has no scripted expert, the simulator is not installed, or a log in `out_dir` was made with
    other options.
    """
    if spec.sim is None or spec.sim.env not in RECORDABLE:
        env = "no [sim] table" if spec.sim is None else spec.sim.env
        raise UsageError(
            "there is no scripted expert for this task", where=spec.name, found=env, remedy=nearest(env, RECORDABLE)
        )
    options = spec.sim.options
    jobs = [
        _Job(spec.name, options, _log_path(out_dir, spec.name, seed), seed)
        for seed in range(first_seed, first_seed + episodes)
    ]
    done = {job.seed: kept for job in jobs if (kept := _finished(job)) is not None}
    todo = [job for job in jobs if job.seed not in done]
    if progress is not None:
        progress(len(done), len(jobs))
    if todo:
        require_simulator(cameras=bool(options.get("cameras", True)))
    with contextlib.closing(map_unordered(_record_one, todo, workers=workers or cpu_count())) as recorded:
        for job, episode in recorded:
            done[job.seed] = episode
            if progress is not None:
                progress(len(done), len(jobs))
    return [done[job.seed] for job in jobs]


def require_simulator(*, cameras: bool) -> None:
    """UsageError with the one command that helps, where robosuite or the software renderer is missing."""
    missing = [name for name in ("gymnasium", "mujoco", "robosuite") if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(
            "the simulator is not installed", found=f"no package called {', '.join(missing)}", remedy="make setup"
        )
    draws_in_software = sys.platform.startswith("linux") and os.environ.get("MUJOCO_GL", "osmesa") == "osmesa"
    if cameras and draws_in_software and ctypes.util.find_library("OSMesa") is None:
        raise UsageError(
            "the cameras cannot be drawn",
            found="no libOSMesa (MUJOCO_GL=osmesa)",
            remedy="sudo apt-get install -y libosmesa6",
        )


def _log_path(folder: Path, task: str, seed: int) -> Path:
    return folder / f"{task}-seed{seed:07d}.mcap"


def _finished(job: _Job) -> RecordedEpisode | None:
    """The episode in a log that is already there; UsageError where it was made with other options. One that is damaged is made again:
    its seed gives the same."""
    try:
        tags = finished_tags(job.path, {"options": _options_text(job)})
    except LogError:
        return None
    return (
        None if tags is None else RecordedEpisode(job.path, job.seed, tags["success"] == "true", int(tags["n_steps"]))
    )


def _options_text(job: _Job) -> str:
    return json.dumps(dict(job.options), sort_keys=True)


def _record_one(job: _Job) -> RecordedEpisode:
    """Runs in a worker process: the simulator is imported here."""
    from vilp_data.sims.hanoi import HanoiEnv
    from vilp_data.sims.hanoi_expert import HanoiExpert

    env = HanoiEnv(**job.options)
    try:
        observation, info = env.reset(seed=job.seed)
        expert = HanoiExpert(env)
        with EpisodeRecorder(job.path, metadata=_tags(job, env), seed=job.seed) as log:
            tick = 0
            for action in expert.actions():
                env.write_tick(log, START_NS + tick * TICK_NS, observation, info, action)
                observation, _, terminated, truncated, info = env.step(action)
                tick += 1
                if terminated or truncated:
                    break
            env.write_tick(log, START_NS + tick * TICK_NS, observation, info, expert.hold())
            log.metadata.update(success=str(info["is_success"]).lower(), n_steps=str(tick))
    finally:
        env.close()
    return RecordedEpisode(job.path, job.seed, bool(info["is_success"]), tick)


def _tags(job: _Job, env: HanoiEnv) -> dict[str, str]:
    return {
        "task": job.task,
        "seed": str(job.seed),
        "goal": f"peg{env.goal_peg}",
        "object": "discs",
        "n_discs": str(env.n_discs),
        "base_angle": f"{env.base_angle:.6f}",
        "policy": "scripted_expert",
        "options": _options_text(job),
        **{f"{name}_version": version(name) for name in ("vilp", "robosuite", "mujoco")},
    }
