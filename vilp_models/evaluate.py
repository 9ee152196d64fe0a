"""Trained planners and low-level policies judged on the validation side of a dataset, and videos of what planners imagine.

Reports go into the run's folder evaluation/, and are made once for the same inputs; videos go to DATA/generated/<run>/.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data.dataset_split import side_episodes
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.pairs import PairDataset
from vilp_data.spec import TaskSpec
from vilp_models import planner_report, policy_report
from vilp_models.checkpoint import checkpoint_digest, run_for_view
from vilp_models.generate import Generated, imagine_clips, imagine_long, require_no_low_dim, write_generated
from vilp_models.imagined import Imagination
from vilp_models.planner_page import write_planner_report
from vilp_models.policy_page import write_policy_report
from vilp_models.report_files import read_fresh_report, shown
from vilp_models.runs import tags_name
from vilp_models.trained import TrainedPlanners, default_device, load_encoders, load_low_level, load_planners

FOLDER = "evaluation"

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Sampling:
    """How planners are asked: noise from `seed`; denoising steps and sampler of the planners' recipe unless told otherwise."""

    seed: int = 0
    denoising_steps: int | None = None
    sampler: str | None = None

    def of(self, trained: TrainedPlanners, device: str) -> Imagination:
        return Imagination(
            trained.planners, trained.contract.n_plan_frames, self.seed, self.denoising_steps, self.sampler, device
        )

    def inputs(self, trained: TrainedPlanners) -> dict[str, Any]:
        """What of the sampling decides a report's numbers, resolved."""
        recipe = trained.recipe
        return {
            "seed": self.seed,
            "denoising_steps": self.denoising_steps or recipe.denoising_steps,
            "sampler": self.sampler or recipe.sampler,
            "n_plan_frames": trained.contract.n_plan_frames,
            "frame_stride": trained.contract.frame_stride,
        }


def evaluate_planner(
    root: Path,
    spec: TaskSpec,
    run_dir: Path,
    vqgan: Path,
    *,
    n_starts: int,
    n_samples: int,
    sampling: Sampling,
    progress: Progress | None = None,
) -> tuple[dict[str, Any], Path]:
    """The report of the planners in `run_dir` as plain data, and its folder. Raises what `load_planners` and
    `planner_report` raise."""
    store, device = EpisodeStore(root), default_device()
    trained = load_planners(store, spec, run_dir, vqgan, device=device)
    inputs = {
        "format": planner_report.REPORT_FORMAT,
        "planners": dict(trained.digests),
        **_judged_on(store, vqgan),
        **sampling.inputs(trained),
        "starts": n_starts,
        "samples": n_samples,
    }
    folder = run_dir / FOLDER

    def make() -> None:
        report = planner_report.planner_report(
            store,
            sampling.of(trained, device),
            trained.encoders,
            side_episodes(store, "val"),
            trained.window,
            latent_std=trained.latent_std,
            n_starts=n_starts,
            n_samples=n_samples,
            progress=progress,
        )
        write_planner_report(report, folder, inputs)

    return _made_once(folder, inputs, make), folder


def evaluate_policy(
    root: Path,
    spec: TaskSpec,
    run_dir: Path,
    vqgan: Path,
    *,
    action_set: str | None = None,
    where: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> tuple[dict[str, Any], Path]:
    """The report of the low-level policy in `run_dir` as plain data, and its folder: on validation episodes, on those with the tags
    `where` alone if any are named. Raises what `load_encoders`, `load_low_level`
    and `PairDataset` raise."""
    store, device = EpisodeStore(root), default_device()
    encoders = load_encoders(store, spec, vqgan, device=device)
    trained = load_low_level(store, spec, run_dir, encoders, action_set=action_set, device=device)
    inputs = {
        "format": policy_report.REPORT_FORMAT,
        "policy": trained.digest,
        "holds": {part: action.holds for part, action in spec.action.items()},
        **_judged_on(store, vqgan),
        **({"where": dict(where)} if where else {}),
    }
    folder = run_dir / "-".join([FOLDER, *tags_name(where or {})])

    def make() -> None:
        pairs = PairDataset(
            root,
            split="val",
            frame_stride=trained.contract.frame_stride,
            latent_keys={view: encoder.key for view, encoder in encoders.items()},
            with_frames=trained.recipe.sees == "frames",
            where=where,
        )
        report = policy_report.policy_report(
            store,
            spec,
            trained.policy,
            pairs,
            trained.contract.normaliser["action"]["mean"],
            sees=trained.recipe.sees,
            decoders=encoders,
            device=device,
            progress=progress,
        )
        write_policy_report(report, folder, inputs)

    return _made_once(folder, inputs, make), folder


def _made_once(folder: Path, inputs: dict[str, Any], make: Callable[[], None]) -> dict[str, Any]:
    """The report in `folder`, made now unless it is there with these inputs."""
    table = read_fresh_report(folder, inputs)
    if table is None:
        make()
        table = read_fresh_report(folder, inputs)
        assert table is not None
    return table


def generate_videos(
    root: Path,
    spec: TaskSpec,
    run_dir: Path,
    vqgan: Path,
    out: Path,
    *,
    n_videos: int,
    long_frames: int | None,
    sampling: Sampling,
    progress: Progress | None = None,
) -> list[str]:
    """Clips from `n_videos` validation starts, or with `long_frames` as many long videos of that many frames, each from the
    beginning of a validation episode; a line for each about what was written.

    Raises what `load_planners` and `generate` raise."""
    store, device = EpisodeStore(root), default_device()
    trained = load_planners(store, spec, run_dir, vqgan, device=device)
    imagination, entries = sampling.of(trained, device), side_episodes(store, "val")
    if not entries:
        raise UsageError("no validation episode", where=root, remedy="draw a split with `vilp-data split`")
    if long_frames is None:
        videos = imagine_clips(store, imagination, trained.encoders, entries, trained.window, n_clips=n_videos)
        total = n_videos
    else:
        require_no_low_dim(imagination)
        chosen = [entries[i] for i in np.unique(np.linspace(0, len(entries) - 1, n_videos).round().astype(int))]
        total = len(chosen)
        videos = (
            imagine_long(store, imagination, trained.encoders, entry, trained.window, n_frames=long_frames)
            for entry in chosen
        )
    lines = []
    for done, video in enumerate(videos, start=1):
        name = f"{video.episode}-step{video.step}" + ("" if long_frames is None else f"-long{long_frames}")
        paths = write_generated(video, out, name)
        lines.append(_line(video, paths))
        if progress is not None:
            progress(done, total)
    return lines


def _line(video: Generated, paths: list[Path]) -> str:
    over = [f"{view} {shown(float(np.nanmean(psnr)), 1)} dB" for view, psnr in video.psnr.items()]
    names = ", ".join([paths[0].name, *(path.suffix for path in paths[1:])])
    return f"{names}: {video.n_frames - 1} frames, {'; '.join(over)} on average"


def _judged_on(store: EpisodeStore, vqgan: Path) -> dict[str, Any]:
    """What a report depends on beside the model: the validation episodes and the VQGANs."""
    entries = side_episodes(store, "val")
    views = sorted(store.spec().views)
    return {
        "episodes": {entry.id: entry.content_sha256 for entry in entries},
        "vqgan": {view: checkpoint_digest(run_for_view(vqgan, view)) for view in views},
    }
