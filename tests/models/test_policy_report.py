"""Policies that know the action, or guess: what the report must say of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.fake_encoder import BlockMeans
from tests.models.conftest import HEIGHT, STEPS, WIDTH
from tests.stored_episodes import add_episodes, write_split
from tests.stored_episodes import episode as random_episode
from vilp_data.episodes import EpisodeStore
from vilp_data.latents import latents_path
from vilp_data.pairs import PairDataset
from vilp_data.shards import write_shard
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import parse_task
from vilp_models.policy_page import write_policy_report
from vilp_models.policy_report import PolicyReport, hold_actions, policy_report

ENCODER = BlockMeans()
SPEC = f"""
name = "test"
[views.front]
topic = "/front"
height = {HEIGHT}
width = {WIDTH}
[low_dim.agent]
topic = "/state"
fields = ["[0:2]"]
[action.target]
topic = "/action"
fields = ["[0:2]"]
unit = "px"
holds = "agent"
"""
STRIDE = 2
MEAN = (0.5, -0.5)


class Known:
    """Gives the actions it was told for each second frame, plus `error`."""

    def __init__(self, answers: Mapping[bytes, Tensor], *, error: float = 0.0, view: str = "front") -> None:
        self.answers, self.error, self.view = answers, error, view

    def act(self, first: Mapping[str, Tensor], second: Mapping[str, Tensor], low_dim: Tensor | None = None) -> Tensor:
        assert low_dim is not None
        found = [
            self.answers.get(frame.numpy().tobytes(), torch.full((STRIDE, 2), 100.0)) for frame in second[self.view]
        ]
        return torch.stack(found) + self.error


@pytest.fixture
def dataset(tmp_path: Path) -> EpisodeStore:
    """Two validation episodes among four, of frames and actions that are all different; episode "a" has an invalid step 4."""
    store = EpisodeStore(tmp_path / "dataset")
    store.write_spec(parse_task(SPEC, where="test"))
    for number, name in enumerate("abcd"):
        one = random_episode(name, STEPS, invalid=(4,) if name == "a" else ())
        frames = np.random.default_rng(number).integers(0, 256, (STEPS, HEIGHT, WIDTH, 3), dtype=np.uint8)
        index = {"front": np.arange(STEPS, dtype=np.int32)}
        add_episodes(store.root, replace(one, frames={"front": frames}, source_index=index, low_dim=one.low_dim[:, :2]))
        entry = store.entry(name)
        header = {"format": "1", "key": ENCODER.key, "source_frames_sha256": entry.frames_sha256["front"]}
        write_shard(latents_path(store.root, "front", ENCODER.key, name), {"latents": ENCODER.encode(frames)}, header)
    write_split(store.root)
    return store


def answers(store: EpisodeStore, *, reconstructed: bool = False) -> dict[bytes, Tensor]:
    known = {}
    for entry in store.index():
        one = store.read(entry.id)
        seen = one.frames["front"]
        if reconstructed:
            seen = ENCODER.decode(ENCODER.encode(seen))
        assert one.action is not None
        for k in range(STEPS - STRIDE):
            known[seen[k + STRIDE].tobytes()] = torch.from_numpy(one.action[k : k + STRIDE].copy())
    return known


def report_of(store: EpisodeStore, policy: Known, *, decoded: bool = True) -> PolicyReport:
    keys = {"front": ENCODER.key}
    pairs = PairDataset(store.root, split="all", frame_stride=STRIDE, latent_keys=keys)
    return policy_report(store, store.spec(), policy, pairs, MEAN, decoders={"front": ENCODER} if decoded else None)


def test_a_policy_that_knows_the_action_makes_no_error_and_beats_every_guess(dataset: EpisodeStore) -> None:
    report = report_of(dataset, Known(answers(dataset)), decoded=False)
    [part] = report.parts
    assert (part.part, part.unit) == ("target", "px")
    assert part.mae("true").value == part.rmse("true").value == 0
    assert all(part.gain("true", guess).value < 0 for guess in ("mean", "last", "hold"))
    assert report.warnings == []


def test_true_and_reconstructed_second_frames_are_told_apart(dataset: EpisodeStore) -> None:
    [part] = report_of(dataset, Known(answers(dataset, reconstructed=True), error=0.25)).parts
    assert part.mae("reconstructed").value == pytest.approx(0.25)
    assert part.rmse("reconstructed").value == pytest.approx(0.25)
    assert part.mae("true").value > 90


def test_guesses_are_the_mean_the_action_before_and_the_present_position(dataset: EpisodeStore) -> None:
    report = report_of(dataset, Known({}), decoded=False)
    [part] = report.parts
    errors: dict[str, list[float]] = {"mean": [], "last": [], "hold": []}
    for entry in dataset.index():
        one = dataset.read(entry.id)
        assert one.action is not None
        for k in range(1, STEPS - STRIDE):
            if not one.valid[k - 1 : k + STRIDE + 1].all():
                continue
            for name, guess in (("mean", np.array(MEAN)), ("last", one.action[k - 1]), ("hold", one.low_dim[k])):
                errors[name].append(float(np.abs(one.action[k : k + STRIDE] - guess).mean()))
    assert report.n_pairs == len(errors["mean"])
    for name, values in errors.items():
        assert part.mae(name).value == pytest.approx(np.mean(values), rel=1e-5)


def test_a_policy_no_better_than_a_guess_is_said_so(dataset: EpisodeStore, tmp_path: Path) -> None:
    report = report_of(dataset, Known({}))
    [warning] = report.warnings
    assert warning.startswith(
        "do not act with this policy: target is told no better from true frames than the mean training action (+"
    )
    assert "reconstructed frames than staying" in warning
    write_policy_report(report, tmp_path / "evaluation", {"seed": 0})
    table = json.loads((tmp_path / "evaluation" / "report.json").read_text())
    assert table["warnings"] == report.warnings
    true, mean = (table["parts"]["target"]["candidates"][name]["mae"]["value"] for name in ("true", "mean"))
    gain = table["parts"]["target"]["mae_less_that_of"]["true"]["mean"]
    assert gain["value"] == pytest.approx(true - mean, abs=1e-3)
    assert "**Warning:** do not act" in (tmp_path / "evaluation" / "report.md").read_text()


@pytest.mark.parametrize(
    ("error", "row"), [(0.00123, "| policy, true frames | 0.00123 |"), (1.5, "| policy, true frames | 1.500 |")]
)
def test_small_errors_are_shown_with_their_digits(
    dataset: EpisodeStore, tmp_path: Path, error: float, row: str
) -> None:
    report = report_of(dataset, Known(answers(dataset), error=error), decoded=False)
    write_policy_report(report, tmp_path, {})
    assert row in (tmp_path / "report.md").read_text()


def test_staying_is_no_motion_for_deltas_the_low_dim_that_the_task_tells_or_the_last_command() -> None:
    spec = TaskSpec.model_validate(
        {
            "name": "arm",
            "views": {"top": {"topic": "/top", "height": 8, "width": 8}},
            "low_dim": {
                "pose": {"topic": "/pose", "fields": ["x", "y"]},
                "gripper": {"topic": "/gripper", "fields": ["width"]},
            },
            "action": {
                "move": {"topic": "/move", "fields": ["dx", "dy"], "kind": "delta"},
                "grip": {"topic": "/grip", "fields": ["close"]},
                "reach": {"from": "pose", "fields": ["x", "y"]},
                "finger": {"topic": "/gripper", "fields": ["width"]},
                "aim": {"topic": "/aim", "fields": ["x", "y"]},  # the fields of pose, but nobody says its place
                "target": {"topic": "/target", "fields": ["a", "b"], "holds": "pose"},
                "wider": {"topic": "/wider", "fields": ["a", "b", "c"], "holds": "pose"},
            },
        }
    )
    low_dim = np.array([[1, 2, 9]], np.float32)
    last = np.arange(10, 23, dtype=np.float32)[None]
    parts = np.split(hold_actions(spec, low_dim, last)[0], [2, 3, 5, 6, 8, 10])
    assert [part.tolist() for part in parts] == [[0, 0], [12], [1, 2], [9], [16, 17], [1, 2], [20, 21, 22]]
