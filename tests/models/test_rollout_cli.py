"""`vilp-models rollout`: where a rollout goes, how its policy is asked for, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("gymnasium", reason="the simulators are not installed: make setup")

from tests.models.toy_simulator import dot_task
from tests.stored_episodes import episode, write_dataset
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_models.cli import app
from vilp_models.policies.load import PolicyRequest
from vilp_models.policies.stay import StayPolicy


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset without episodes, in whose task there is a simulator."""
    monkeypatch.chdir(tmp_path)
    EpisodeStore(tmp_path / "dots").write_spec(dot_task())
    return tmp_path / "dots"


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> list[PolicyRequest]:
    """Every policy stays; how each was asked for."""
    asked: list[PolicyRequest] = []

    def load(name: str, request: PolicyRequest) -> StayPolicy:
        asked.append(request)
        return StayPolicy(n_action_steps=request.n_action_steps)

    monkeypatch.setattr("vilp_models.policies.load.load_policy", load)
    return asked


def rolled_out(root: Path, *words: str) -> str:
    words = ("rollout", "--data", str(root), "--max-steps", "3", "--no-logs", *words)
    ended = CliRunner().invoke(app, words, catch_exceptions=False)
    assert ended.exit_code == 0, ended.output
    return ended.output


def test_starts_are_called_as_they_were_typed(root: Path) -> None:
    assert "stay on 2 starts (4:6), 3 steps each" in rolled_out(root, "--policy", "stay", "--seeds", "4:6")
    assert "stay on 1 start (4), 3 steps each" in rolled_out(root, "--policy", "stay", "--seeds", "4")
    assert {path.name for path in (root / "rollouts").iterdir()} == {"stay-4-6", "stay-4"}


def test_starts_that_were_trained_on_are_refused(root: Path) -> None:
    write_dataset(root, *(replace(episode(name, 6), tags={"seed": str(n)}) for n, name in enumerate("abcdef")))
    EpisodeStore(root).write_spec(dot_task())
    with pytest.raises(UsageError, match=r"training episodes were recorded from these starts(.|\n)*seed \d \([a-f]\)"):
        rolled_out(root, "--policy", "stay")
    assert "stay on 2 starts (6:8)" in rolled_out(root, "--policy", "stay", "--seeds", "6:8")


@pytest.mark.parametrize(
    ("words", "folder"),
    [
        ((), "vilp-cpu-0-2"),
        (("--denoising-steps", "8"), "vilp-cpu-8steps-0-2"),
        (("--denoising-steps", "1", "--sampler", "ddim"), "vilp-cpu-1step-ddim-0-2"),
        (("--precision", "bf16"), "vilp-cpu-bf16-0-2"),
        (("--vqgan", "runs/vqgan-other"), "vilp-cpu-vqgan-other-0-2"),
        (("--set", "small", "--denoising-steps", "8"), "vilp-cpu-small-8steps-0-2"),
    ],
)
def test_each_setting_has_a_folder_of_its_own(
    root: Path, requests: list[PolicyRequest], words: tuple[str, ...], folder: str
) -> None:
    rolled_out(root, "--policy", "vilp", "--preset", "cpu", "--seeds", "0:2", *words)
    assert [path.name for path in (root / "rollouts").iterdir()] == [folder]


def test_a_policy_that_learns_from_nothing_has_no_action_set(root: Path) -> None:
    words = ("rollout", "--data", str(root), "--policy", "stay", "--set", "small", "--seeds", "0:2")
    refused = CliRunner().invoke(app, words).exception
    assert isinstance(refused, UsageError)
    assert "'stay' learns from nothing\n   found: --set small" in str(refused)


def test_settings_reach_the_policy(root: Path, requests: list[PolicyRequest]) -> None:
    words = [
        "--denoising-steps",
        "8",
        "--sampler",
        "dpm++",
        "--precision",
        "bf16",
        "--vqgan",
        "other",
        "--device",
        "cpu",
    ]
    rolled_out(root, "--policy", "vilp", "--seeds", "0:1", *words)
    [asked] = requests
    settings = (asked.denoising_steps, asked.sampler, asked.precision, asked.vqgan, asked.device)
    assert settings == (8, "dpm++", "bf16", Path("other"), "cpu")


def test_settings_of_imagining_are_refused_for_a_policy_that_does_not(root: Path) -> None:
    with pytest.raises(UsageError, match=r"'stay' imagines nothing(.|\n)*8steps(.|\n)*roll out vilp"):
        rolled_out(root, "--policy", "stay", "--denoising-steps", "8")


def test_a_dataset_is_not_rolled_over(root: Path) -> None:
    with pytest.raises(UsageError, match="cannot take the place of a dataset"):
        rolled_out(root, "--policy", "stay", "--seeds", "0:1", "--out", str(root))
    assert (root / "dataset.json").is_file()
