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
from vilp_data.recorder import EpisodeRecorder
from vilp_data.sims import record
from vilp_data.sims.record import RecordedEpisode, record_task
from vilp_data.sources import open_log
from vilp_data.spec import SimSpec, TaskSpec
from vilp_data.task_toml import load_task
from vilp_data.twins import twin_hash
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


def test_variants_of_one_seed_are_twins_though_no_picture_is_the_same(recorded):
    """Why `record` keeps their seeds apart, and a split their episodes on one side."""
    gray, purple = (
        assembled(recorded["arrange_blocks", variant].path, load_task("arrange_blocks"))
        for variant in (None, "off_target")
    )
    assert not np.array_equal(gray.frames["top"], purple.frames["top"])
    one, other = (twin_hash({"action": e.action, "low_dim": e.low_dim}) for e in (gray, purple))
    assert one == other != twin_hash({"action": gray.action + 1, "low_dim": gray.low_dim})


def test_seeds_of_another_part_of_the_task_are_not_recorded(tmp_path):
    spec = load_task("arrange_blocks")
    for first_seed, variant in ((1679, "off_target"), (5067, None), (4999, None)):
        with pytest.raises(
            SpecError, match=rf"recorded from the same seeds(.|\n)*{first_seed} to {first_seed + 1} and"
        ):
            record_task(spec, tmp_path, episodes=2, first_seed=first_seed, variant=variant)
    assert list(tmp_path.iterdir()) == []


def test_an_expert_may_take_as_long_as_a_policy_and_no_longer(tmp_path):
    spec = load_task("arrange_blocks")
    short = spec.model_copy(update={"sim": spec.sim.model_copy(update={"max_steps": 5})})
    [failure] = record_task(short, tmp_path, episodes=1, first_seed=3, workers=1)
    assert (failure.n_steps, failure.success) == (5, False)
    assert assembled(failure.path, spec).tags["success"] == "false"


def damaged_in_its_middle(data: bytes) -> bytes:
    third = len(data) // 3
    return data[:third] + bytes(byte ^ 0xFF for byte in data[third : third + 50]) + data[third + 50 :]


def test_a_log_that_is_damaged_in_its_middle_is_made_again(recorded, tmp_path):
    whole = recorded["arrange_blocks", None].path.read_bytes()
    path = tmp_path / recorded["arrange_blocks", None].path.name
    path.write_bytes(damaged_in_its_middle(whole))
    recorded_one("arrange_blocks", None, tmp_path)
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    ("changed", "found"),
    [
        ({"seed": 4}, "other seed: 3, now 4"),
        ({"max_steps": 301}, "other max_steps: 300, now 301"),
        ({"version": "9.9"}, r"other pymunk_version: .*, now 9.9"),
        ({"code": "other"}, "other source_sha256: .*, now other"),
        ({"task": "rows"}, "other task: arrange_blocks, now rows"),
    ],
)
def test_a_finished_log_of_something_else_is_neither_kept_nor_overwritten(
    recorded, tmp_path, monkeypatch, changed, found
):
    spec, seed = load_task("arrange_blocks"), changed.get("seed", 3)
    name = changed.get("task", spec.name)
    path = tmp_path / f"{name}-seed{seed:07d}.mcap"
    path.write_bytes(recorded["arrange_blocks", None].path.read_bytes())
    spec = spec.model_copy(
        update={"name": name, "sim": spec.sim.model_copy(update={"max_steps": changed.get("max_steps", 300)})}
    )
    real = record.version
    if "version" in changed:
        monkeypatch.setattr(record, "version", lambda name: "9.9" if name == "pymunk" else real(name))
    if "code" in changed:
        monkeypatch.setattr(record, "source_digest", lambda modules: "other")
    before = path.read_bytes()
    with pytest.raises(UsageError, match=rf"made from something else(.|\n)*{found}"):
        record_task(spec, tmp_path, episodes=1, first_seed=seed, workers=1)
    assert path.read_bytes() == before


def test_a_log_from_before_logs_told_their_code_is_kept_and_one_line_says_so(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(EpisodeRecorder, "__init__", without_made_from(EpisodeRecorder.__init__))
    first = recorded_one("arrange_blocks", None, tmp_path)
    monkeypatch.undo()
    before = first.path.read_bytes()
    assert before != recorded["arrange_blocks", None].path.read_bytes()
    assert not recorded_one("arrange_blocks", None, tmp_path).says_what_made_it
    asked = ["record", "--task", "arrange_blocks", "--episodes", "1", "--first-seed", "3", "--out", str(tmp_path)]
    assert "1 kept, made before logs told" in CliRunner().invoke(app, asked).stdout
    assert first.path.read_bytes() == before


def without_made_from(init):
    return lambda self, path, *, made_from=None, **rest: init(self, path, **rest)


def test_what_a_log_was_made_from_is_no_tag(recorded):
    tags = assembled(recorded["pusht", None].path, load_task("pusht")).tags
    assert not {"source_sha256", "max_steps", "expert"} & tags.keys()


def test_a_mistake_in_an_installed_package_is_placed_too():
    try:
        exec(compile("1 / 0", "/x/site-packages/vilp_data/sims/can.py", "exec"), {})
    except ZeroDivisionError as error:
        error.__traceback__ = error.__traceback__.tb_next  # as where all of VILP is installed
        assert record._place(error) == "/x/site-packages/vilp_data/sims/can.py:1"


def test_no_episodes_and_seeds_below_zero_are_refused(tmp_path):
    for words in (("--episodes", "0"), ("--episodes", "-1"), ("--first-seed", "-3")):
        asked = ["record", "--task", "arrange_blocks", "--out", str(tmp_path / "logs"), *words]
        ended = CliRunner().invoke(app, asked)
        assert (ended.exit_code, (tmp_path / "logs").exists()) == (2, False), ended.output


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
