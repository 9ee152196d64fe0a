"""`record_task` on the tasks that need pymunk alone: whole logs, variants beside the task itself, and episodes that play back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from vilp_data.assemble import assemble_episode
from vilp_data.cli import app
from vilp_data.errors import SpecError, UsageError
from vilp_data.sims import record
from vilp_data.sims.record import RecordedEpisode, record_task
from vilp_data.sources import open_log
from vilp_data.spec import SimSpec, TaskSpec
from vilp_data.task_toml import load_task
from vilp_data.types import Episode
from vilp_models.metrics import psnr
from vilp_models.replay import render_match, replay
from vilp_models.simulator import Worlds, make_env

pytestmark = pytest.mark.sim
pytest.importorskip("gym_pusht", reason="the simulators are not installed (make setup)")

TASKS = ("arrange_blocks", "pusht")
CASES = [(task, variant) for task in TASKS for variant in (None, "off_target")]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str | None], RecordedEpisode]:
    folder = tmp_path_factory.mktemp("logs")
    return {case: recorded_one(*case, folder) for case in CASES}


def recorded_one(task: str, variant: str | None, folder: Path) -> RecordedEpisode:
    [one] = record_task(load_task(task), folder, episodes=1, first_seed=3, variant=variant, workers=1)
    return one


def assembled(path: Path, spec: TaskSpec) -> Episode:
    with open_log(path) as log:
        return assemble_episode(log, log.episodes()[0], spec, episode_id="e")


@pytest.mark.parametrize(("task", "variant"), CASES)
def test_a_log_has_every_tick_whole_and_says_what_it_shows(recorded, task, variant):
    one = recorded[task, variant]
    episode = assembled(one.path, load_task(task))
    assert one.success
    assert one.path.name == f"{task}-{'off_target-' if variant else ''}seed0000003.mcap"
    assert episode.n_steps == one.n_steps + 1
    assert episode.valid.all()
    assert episode.findings == ()
    assert episode.action is not None
    np.testing.assert_allclose(episode.action[-1], episode.low_dim[-1])  # the command to stand still
    tags = episode.tags
    assert (tags["task"], tags["seed"], tags["success"], tags.get("variant")) == (task, "3", "true", variant)
    told = {
        ("arrange_blocks", None): ("row", "gray_blocks"), ("arrange_blocks", "off_target"): ("row", "purple_blocks"),
        ("pusht", None): ("256,256,45", "T"), ("pusht", "off_target"): ("356,356,45", "T"),
    }  # fmt: skip
    assert (tags["goal"], tags["object"]) == told[task, variant]
    assert "pymunk_version" in tags


@pytest.mark.parametrize(("task", "variant"), CASES)
def test_what_was_recorded_plays_back_and_succeeds_in_the_world_that_its_tags_name(recorded, task, variant):
    spec = load_task(task)
    episode = assembled(recorded[task, variant].path, spec)
    worlds = Worlds(spec, cameras=True)
    env = worlds.of(episode.tags)
    assert replay(episode, env).proves(env.metadata["replay_tolerance"])
    assert render_match(episode, env, every=7).proves()

    env.reset(options={"state": episode.state[0]})
    for action in episode.action[:-1]:
        *_, info = env.step(action)
    assert info["is_success"]
    worlds.close()


@pytest.mark.parametrize("task", TASKS)
def test_the_tasks_own_world_does_not_look_like_its_variants(recorded, task):
    episode = assembled(recorded[task, "off_target"].path, load_task(task))
    drawn = make_env(load_task(task)).reset(options={"state": episode.state[0]})[0]["top"]
    assert psnr(drawn, episode.frames["top"][0]) < 35


@pytest.mark.parametrize("task", TASKS)
def test_the_same_seed_gives_the_same_bytes(recorded, tmp_path, task):
    again = recorded_one(task, None, tmp_path)
    assert again.path.read_bytes() == recorded[task, None].path.read_bytes()


def test_a_variant_that_the_task_does_not_have_is_named(tmp_path):
    with pytest.raises(SpecError, match=r"off_targt(.|\n)*did you mean 'off_target'"):
        record_task(load_task("pusht"), tmp_path, episodes=1, first_seed=0, variant="off_targt")
    with pytest.raises(SpecError, match="it has none"):
        record_task(load_task("hanoi"), tmp_path, episodes=1, first_seed=0, variant="off_target")


def test_an_expert_may_take_as_long_as_a_policy_and_no_longer(tmp_path):
    spec = load_task("arrange_blocks")
    short = spec.model_copy(update={"sim": spec.sim.model_copy(update={"max_steps": 5})})
    [failure] = record_task(short, tmp_path, episodes=1, first_seed=3, workers=1)
    assert (failure.n_steps, failure.success) == (5, False)
    assert assembled(failure.path, spec).tags["success"] == "false"


def test_options_that_the_simulator_does_not_take_are_an_error_and_no_traceback(tmp_path):
    spec = load_task("arrange_blocks").model_copy(
        update={"sim": SimSpec(env="vilp/ArrangeBlocks-v0", options={"color": "gray"})}
    )
    with pytest.raises(UsageError, match=r"does not take these options(.|\n)*color"):
        record_task(spec, tmp_path, episodes=1, first_seed=0, workers=1)
    assert list(tmp_path.iterdir()) == []


def test_recording_needs_no_robosuite(tmp_path, monkeypatch):
    real = record.importlib.util.find_spec
    monkeypatch.setattr(
        record.importlib.util, "find_spec", lambda name, *rest: None if name == "robosuite" else real(name, *rest)
    )
    assert record_task(load_task("arrange_blocks"), tmp_path, episodes=1, first_seed=3, workers=1)[0].success


def test_the_verb_records_the_task_and_its_variants_or_what_is_asked_for(tmp_path):
    def run(*words: str) -> list[str]:
        asked = ["record", "--task", "arrange_blocks", "--preset", "tiny", "--out", str(tmp_path), "--json", *words]
        ended = CliRunner().invoke(app, asked)
        assert ended.exit_code == 0, ended.output
        return [Path(one["path"]).name for one in json.loads(ended.stdout)]

    def names(variant: str, *seeds: int) -> list[str]:
        return [f"arrange_blocks-{variant}seed{seed:07d}.mcap" for seed in seeds]

    assert run() == [*names("", 1000, 1001, 1002, 1003), *names("off_target-", 5000, 5001)]
    assert run("--episodes", "1") == names("", 1000)
    assert run("--variant", "off_target", "--first-seed", "5001", "--episodes", "1") == names("off_target-", 5001)
