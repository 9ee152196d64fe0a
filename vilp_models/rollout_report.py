"""What a rollout shows: mean of max reward and success rate, each with its interval, against another rollout pair by pair.

A rollout's folder: report.json, report.md, logs/<start>.mcap, and videos/best, median and worst .mp4, drawn from the logs. It
appears when all of it is there.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vilp_data.decode import decode_image
from vilp_data.errors import UsageError
from vilp_data.mp4 import write_mp4
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import U8
from vilp_models.intervals import Estimate, mean_estimate, paired_difference, rate_estimate
from vilp_models.policies.base import Policy
from vilp_models.report_files import counted, estimate_table, estimate_words, markdown_table, page, write_report_files
from vilp_models.rollout import EpisodeResult, LogPlan, Progress, Timing, roll_out
from vilp_models.rollout_folder import VIDEOS, find_rollout, new_rollout
from vilp_models.simulator import require_simulator
from vilp_models.starts import Start, starts_digest

VIDEO_SIDE = 384
"""Pixels that the shorter side of a video has at least."""


@dataclass(frozen=True)
class Against:
    """Ours minus another policy's, of the same starts: max reward, and success as 0 or 1."""

    policy: str
    folder: str
    max_reward: Estimate
    success: Estimate


@dataclass(frozen=True)
class RolloutReport:
    """A finished rollout. `tags` are the policy's own; `starts` says which, in a word ("100000:100050", "val"), `starts_sha256` exactly
    (`starts_digest`)."""

    policy: str
    task: str
    starts: str
    max_steps: int
    n_action_steps: int
    environments: int
    tags: Mapping[str, str]
    episodes: Sequence[EpisodeResult]
    timing: Timing
    starts_sha256: str
    against: tuple[Against, ...] = ()

    @property
    def max_reward(self) -> Estimate:
        """Mean over starts of the highest reward of any step."""
        return mean_estimate([episode.max_reward for episode in self.episodes])

    @property
    def success(self) -> Estimate:
        """Share of starts that succeeded at any step."""
        return rate_estimate(sum(episode.success for episode in self.episodes), len(self.episodes))

    def chosen(self) -> dict[str, EpisodeResult]:
        """The best, median and worst episode by max reward; of equal ones the first. No episode twice."""
        order = sorted(self.episodes, key=lambda episode: -episode.max_reward)
        if len(order) < len(VIDEOS):
            return dict(zip(("best", "worst"), order, strict=False))
        return dict(zip(VIDEOS, (order[0], order[len(order) // 2], order[-1]), strict=True))

    def to_json(self) -> dict[str, Any]:
        timing = self.timing
        return {
            "policy": self.policy,
            "task": self.task,
            "tags": dict(self.tags),
            "starts": self.starts,
            "starts_sha256": self.starts_sha256,
            "max_steps": self.max_steps,
            "n_action_steps": self.n_action_steps,
            "environments": self.environments,
            "max_reward": estimate_table(self.max_reward),
            "success": estimate_table(self.success),
            "against": [
                {
                    "policy": other.policy,
                    "folder": other.folder,
                    "max_reward": estimate_table(other.max_reward),
                    "success": estimate_table(other.success),
                }
                for other in self.against
            ],
            "time": {
                "plans": timing.n_plans,
                "plan_s": round(timing.plan / max(timing.n_plans, 1), 5),
                "parts_s": {name: round(s / max(timing.n_plans, 1), 5) for name, s in sorted(timing.parts.items())},
                "policy_s": round(timing.plan, 3),
                "environments_s": round(timing.environments, 3),
                "logs_s": round(timing.logs, 3),
                "steps_per_s": round(timing.steps_per_s, 1),
            },
            "hardware": hardware(),
            "episodes": [asdict(episode) for episode in self.episodes],
        }


def roll_out_into(
    folder: Path,
    spec: TaskSpec,
    policy: Policy,
    starts: Sequence[Start],
    *,
    name: str,
    what: str,
    max_steps: int,
    environments: int,
    against: Sequence[Path] = (),
    with_logs: bool = True,
    progress: Progress | None = None,
) -> RolloutReport:
    """Roll the policy called `name` out from `starts` (`what` they are, in a word), and leave the rollout in `folder`, in place of
    the one that was there; `against` are finished ones of the same starts.

    One that is stopped leaves nothing, and what was there as it was. Raises as `rollout.roll_out` and `new_rollout` do, and
    UsageError where a rollout of `against` cannot be compared: before anything is rolled out."""
    begun = starts_digest(require_simulator(spec), starts)
    for other in against:
        require_comparable(other, task=spec.name, max_steps=max_steps, starts_sha256=begun)
    with new_rollout(folder) as making:
        tags = {"policy": name, **policy.tags}
        logs = LogPlan(making / "logs", tags) if with_logs else None
        episodes, timing = roll_out(
            spec, policy, starts, max_steps=max_steps, environments=environments, logs=logs, progress=progress
        )
        report = RolloutReport(
            name, spec.name, what, max_steps, policy.n_action_steps, environments, policy.tags, episodes, timing, begun
        )
        report = replace(report, against=tuple(compared(report, other) for other in against))
        write_rollout(report, making, spec, with_videos=with_logs)
    return report


def compared(report: RolloutReport, folder: Path) -> Against:
    """Our rollout against the finished one in `folder`. Raises as `require_comparable` does."""
    names = [episode.name for episode in report.episodes]
    table = require_comparable(folder, task=report.task, max_steps=report.max_steps, starts_sha256=report.starts_sha256)
    theirs = {episode["name"]: episode for episode in table["episodes"]}
    reward = paired_difference([e.max_reward for e in report.episodes], [theirs[name]["max_reward"] for name in names])
    success = paired_difference(
        [float(e.success) for e in report.episodes], [float(theirs[name]["success"]) for name in names]
    )
    return Against(str(table["policy"]), folder.name, reward, success)


def require_comparable(folder: Path, *, task: str, max_steps: int, starts_sha256: str) -> dict[str, Any]:
    """The report of the finished rollout in `folder`, of just these starts (`starts_digest`).

    Raises UsageError where it is not finished, or was made from other starts or for another number of steps."""
    table = read_rollout(folder)
    for name, ours in (("task", task), ("max_steps", max_steps)):
        if table[name] != ours:
            raise UsageError(
                f"rollouts of another {name} cannot be compared", where=folder, found=f"{table[name]}, here {ours}",
                remedy="roll both out alike",
            )  # fmt: skip
    if table.get("starts_sha256") != starts_sha256:
        raise UsageError(
            "rollouts of other starts cannot be compared pair by pair",
            where=folder,
            found=f"{table['starts']} there, of another simulator's options or of recordings as they were then, if not of other starts",
            remedy="roll both out from the same --seeds or --from-episodes",
        )
    return table


def finished_rollout(folder: Path, *, task: str, max_steps: int, starts_sha256: str) -> bool:
    """Whether `folder` holds a finished rollout that `require_comparable` would take."""
    try:
        require_comparable(folder, task=task, max_steps=max_steps, starts_sha256=starts_sha256)
    except UsageError:
        return False
    return True


def read_rollout(folder: Path) -> dict[str, Any]:
    """The report.json of a finished rollout. Raises UsageError where there is none."""
    table = find_rollout(folder)
    if table is None:
        remedy = "make one with `vilp-models rollout --policy NAME`"
        raise UsageError("no finished rollout here", where=folder, remedy=remedy)
    return table


def write_rollout(report: RolloutReport, folder: Path, spec: TaskSpec, *, with_videos: bool) -> None:
    """Videos from the logs in `folder`, report.md, and report.json last."""
    if with_videos:
        for name, episode in report.chosen().items():
            frames, fps = log_film(folder / "logs" / f"{episode.name}.mcap", spec)
            write_mp4(
                folder / "videos" / f"{name}.mp4", frames, fps=fps, scale=-(-VIDEO_SIDE // min(frames.shape[1:3]))
            )
    write_report_files(folder, report.to_json(), to_markdown(report, with_videos=with_videos), {})


def log_film(path: Path, spec: TaskSpec) -> tuple[U8, float]:
    """What the views of a rollout's log show, side by side, uint8 [n,H,W,3]; and at how many frames a second."""
    topics = [spec.views[view].topic for view in sorted(spec.views)]
    film: dict[str, list[U8]] = {topic: [] for topic in topics}
    stamps = []
    with open_log(path) as log:
        for message in log.messages(topics):
            film[message.topic].append(decode_image(message))
            stamps.append(message.log_time_ns)
    height = max(frames[0].shape[0] for frames in film.values())
    below = [[(0, height - frames[0].shape[0]), (0, 0), (0, 0)] for frames in film.values()]
    padded = [[np.pad(f, pad) for f in frames] for frames, pad in zip(film.values(), below, strict=True)]
    n_frames = min(map(len, padded))
    fps = (n_frames - 1) * 1e9 / max(max(stamps) - min(stamps), 1)
    return np.stack([np.concatenate(images, axis=1) for images in zip(*padded, strict=True)]), max(fps, 1.0)


def format_rollout(table: Mapping[str, Any], folder: Path) -> list[str]:
    """Lines for a terminal, from a report.json."""
    reward, success = _estimate(table["max_reward"]), _estimate(table["success"])
    won = sum(episode["success"] for episode in table["episodes"])
    lines = [
        f"{table['policy']} on {counted(len(table['episodes']), 'start')} ({table['starts']}), {table['max_steps']} steps each:",
        f"  mean of max reward {estimate_words(reward, 3)}",
        f"  success            {estimate_words(success, 3)}, {counted(won, 'episode')}",
    ]
    for other in table["against"]:
        difference = _estimate(other["max_reward"])
        lines.append(f"  against {other['policy']:<11}{estimate_words(difference, 3, sign=True)}{_verdict(difference)}")
    return [*lines, f"  {_time_words(table['time'])}", f"{folder}/report.md shows it in full"]


def _verdict(difference: Estimate) -> str:
    """Where the interval of a difference lies; nothing where it spans zero, or there is none."""
    if difference.is_above_zero:
        return ": above"
    return ": below" if difference.is_below_zero else ""


def to_markdown(report: RolloutReport, *, with_videos: bool = True) -> str:
    """The page for people; it names the episodes that there are videos of."""
    table = report.to_json()
    tags = [f"- {name}: `{value}`" for name, value in sorted(report.tags.items())]
    summary = [
        f"| mean of max reward | {estimate_words(report.max_reward, 3)} |",
        f"| success rate | {estimate_words(report.success, 3)} |",
    ]
    for other in report.against:
        summary += [
            f"| max reward, minus `{other.policy}` | {estimate_words(other.max_reward, 3, sign=True)} |",
            f"| success, minus `{other.policy}` | {estimate_words(other.success, 3, sign=True)} |",
        ]
    chosen = {episode.name: word for word, episode in report.chosen().items()} if with_videos else {}
    rows = [
        (e.name, f"{e.max_reward:.3f}", "yes" if e.success else "no", str(e.n_steps), chosen.get(e.name, ""))
        for e in report.episodes
    ]
    what = (
        f"{counted(len(report.episodes), 'start')} ({report.starts}), at most {report.max_steps} steps each, {report.n_action_steps} "
        f"actions a plan, {report.environments} environments together."
    )
    return page(
        [],
        [
            [f"# Rollout of `{report.policy}` on {report.task}"],
            [what],
            tags,
            ["| | value (95 % interval) |", "| --- | --- |", *summary],
            [
                "Intervals: bootstrap over starts for means and differences (these paired by start), Wilson's for the rate."
            ],
            [f"{_time_words(table['time'])} {table['hardware']}."],
            ["## Episodes"],
            markdown_table("start | max reward | success | steps | video", rows),
        ],
    )


def hardware() -> str:
    """What the times were taken on: processor, cores, torch, and the accelerator if there is one."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        processor = platform.processor() or platform.machine()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    accelerator = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{processor}, {cores} cores{accelerator}, torch {torch.__version__}"


def _time_words(time: Mapping[str, Any]) -> str:
    parts = ", ".join(f"{name} {seconds:.3f}" for name, seconds in time["parts_s"].items())
    shared = (
        f"policy {time['policy_s']:.1f} s, environments {time['environments_s']:.1f} s, logs {time['logs_s']:.1f} s"
    )
    return (
        f"{time['steps_per_s']:.0f} steps/s; {time['plan_s']:.3f} s a plan{f' ({parts})' if parts else ''}; {shared}."
    )


def _estimate(table: Mapping[str, float | None]) -> Estimate:
    return Estimate(
        *(float("nan") if table[name] is None else float(table[name] or 0) for name in ("value", "low", "high"))
    )
