"""Small datasets of logs that name their numbers: LeRobot tables, joints in JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.json_log import Said, image, joints, write_json_log
from tests.lerobot_folders import CAMERA, write_v21
from vilp_data.episodes import EpisodeStore
from vilp_data.ingest import IngestReport, ingest_logs
from vilp_data.spec import TaskSpec

LEG = {"leg": {"topic": "/joint_states"}}


def whole(**overrides: Any) -> TaskSpec:
    """A task that takes whole features, and so knows nothing of their numbers."""
    table: dict[str, Any] = {
        "name": "two_joints", "rate_hz": 30.0,
        "views": {"top": {"topic": CAMERA, "clock": "log", "height": 32, "width": 160}},
        "low_dim": {"joints": {"topic": "observation.state", "clock": "log"}},
        "action": {"joints": {"topic": "action", "clock": "log"}},
    }  # fmt: skip
    return TaskSpec.model_validate(table | overrides)


def ingested(tmp_path: Path, spec: TaskSpec | None = None) -> EpisodeStore:
    log = write_v21(tmp_path / "log", lengths=(12, 9), images="image").path
    report = ingest_logs([log], tmp_path / "data", spec or whole(), workers=1)
    assert (len(report.written), report.failed) == (2, [])
    return EpisodeStore(tmp_path / "data")


def ingested_json(tmp_path: Path, *logs: list[Said], low_dim: dict[str, Any]) -> tuple[EpisodeStore, IngestReport]:
    tmp_path.mkdir(exist_ok=True)
    paths = [write_json_log(tmp_path / f"{number}.mcap", said) for number, said in enumerate(logs)]
    views = {"front": {"topic": "/camera/front/image", "height": 48, "width": 64}}
    spec = TaskSpec.model_validate({"name": "x", "rate_hz": 10.0, "views": views, "low_dim": low_dim})
    report = ingest_logs(paths, tmp_path / "data", spec, workers=1)
    assert report.failed == []
    return EpisodeStore(tmp_path / "data"), report


def leg(names: list[str], *, first: int = 0, n_steps: int = 12) -> list[Said]:
    """A log of joints called `names`, whose images begin with the one of that number."""
    frames = [image(k / 10, index=k + first) for k in range(n_steps)]
    return [*frames, *(joints(k / 10, names, [k + first, -k, 0.5]) for k in range(n_steps))]
