"""`record_task`: one whole log a seed, kept when it is there, and one that plays back."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from vilp_data.assemble import assemble_episode
from vilp_data.errors import UsageError
from vilp_data.sims import record
from vilp_data.sims.record import RecordedEpisode, record_task
from vilp_data.sources import open_log
from vilp_data.spec import SimSpec, TaskSpec
from vilp_data.task_toml import load_task
from vilp_data.types import Episode

pytestmark = pytest.mark.sim
pytest.importorskip("robosuite", reason="the simulators are not installed (make setup)")


def one_disc(**options: object) -> TaskSpec:
    return load_task("hanoi").model_copy(
        update={"sim": SimSpec(env="vilp/Hanoi-v0", options={"n_discs": 1, **options})}
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedEpisode:
    return record_task(one_disc(), tmp_path_factory.mktemp("logs"), episodes=1, first_seed=7, workers=1)[0]


@pytest.fixture(scope="module")
def episode(recorded: RecordedEpisode) -> Episode:
    with open_log(recorded.path) as log:
        return assemble_episode(log, log.episodes()[0], one_disc(), episode_id="seven")


def test_a_log_is_named_and_tagged_by_its_seed(recorded: RecordedEpisode) -> None:
    assert recorded.path.name == "hanoi-seed0000007.mcap"
    with open_log(recorded.path) as log:
        tags = log.metadata()["episode"]
    assert recorded.success
    assert (tags["task"], tags["seed"], tags["success"], tags["goal"]) == ("hanoi", "7", "true", "peg2")
    assert tags["n_steps"] == str(recorded.n_steps)
    assert np.pi / 4 < float(tags["base_angle"]) < 3 * np.pi / 4
    assert {"robosuite_version", "mujoco_version", "vilp_version"} <= tags.keys()


def test_every_tick_has_both_views_proprioception_action_and_state(recorded: RecordedEpisode, episode: Episode) -> None:
    assert (
        episode.n_steps == recorded.n_steps + 1
    )  # the last holds the final observation and the command to stand still
    assert episode.valid.all()
    assert episode.findings == ()
    assert set(episode.frames) == {"front", "side"}
    assert all(frames.shape == (episode.n_steps, 96, 160, 3) for frames in episode.frames.values())
    assert all((age == 0).all() for age in episode.age_s.values())
    assert episode.action is not None
    assert episode.action[-1].tolist() == [0, 0, 0, 0, 0, 0, -1]


def test_sensors_run_at_twenty_hertz_cameras_and_actions_at_ten(recorded: RecordedEpisode) -> None:
    with open_log(recorded.path) as log:
        counts = {topic.name: topic.message_count for topic in log.topics()}
    n_ticks = recorded.n_steps + 1
    assert counts == {
        **dict.fromkeys(("/joint_states", "/ee_pose", "/gripper/state"), 2 * n_ticks - 1),
        **dict.fromkeys(("/camera/front/image", "/camera/side/image"), n_ticks),
        **dict.fromkeys(("/action/ee_delta", "/action/gripper", "/sim/state"), n_ticks),
    }


def test_ingested_actions_give_the_recorded_states_and_observations_back(episode: Episode) -> None:
    from vilp_data.sims.hanoi import HanoiEnv

    assert episode.action is not None
    assert episode.state is not None
    env = HanoiEnv(1, cameras=False)
    observation, info = env.reset(options={"state": episode.state[0]})
    for step in range(episode.n_steps - 1):
        assert np.array_equal(info["state"], episode.state[step])
        assert np.array_equal(observation["low_dim"], episode.low_dim[step])
        observation, _, _, _, info = env.step(episode.action[step])
    assert info["is_success"]
    env.close()


def test_a_finished_log_is_kept_and_a_broken_one_made_again_the_same(recorded: RecordedEpisode) -> None:
    folder, data = recorded.path.parent, recorded.path.read_bytes()
    modified = recorded.path.stat().st_mtime_ns
    assert record_task(one_disc(), folder, episodes=1, first_seed=7, workers=1) == [recorded]
    assert recorded.path.stat().st_mtime_ns == modified
    recorded.path.write_bytes(data[: len(data) // 2])
    seen: list[tuple[int, int]] = []
    again = record_task(
        one_disc(), folder, episodes=1, first_seed=7, workers=1, progress=lambda done, of: seen.append((done, of))
    )
    assert again == [recorded]
    assert seen == [(0, 1), (1, 1)]
    assert hashlib.sha256(recorded.path.read_bytes()).digest() == hashlib.sha256(data).digest()
    assert list(folder.iterdir()) == [recorded.path]


def test_a_log_made_with_other_options_is_not_overwritten(recorded: RecordedEpisode) -> None:
    with pytest.raises(UsageError, match="other options"):
        record_task(one_disc(goal_peg=1), recorded.path.parent, episodes=1, first_seed=7)


def test_a_failure_is_written_and_tagged(tmp_path: Path) -> None:
    spec = one_disc()
    short = spec.model_copy(update={"sim": spec.sim.model_copy(update={"max_steps": 4})})
    [failure] = record_task(short, tmp_path, episodes=1, first_seed=0, workers=1)
    assert (failure.success, failure.n_steps) == (False, 4)
    with open_log(failure.path) as log:
        assert log.metadata()["episode"]["success"] == "false"


def test_a_task_without_an_expert_says_which_have_one(tmp_path: Path) -> None:
    other = load_task("pusht").model_copy(update={"sim": SimSpec(env="vilp/Hanoy-v0")})
    with pytest.raises(UsageError, match="did you mean 'vilp/Hanoi-v0'"):
        record_task(other, tmp_path, episodes=1, first_seed=0)


def test_a_missing_renderer_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record.ctypes.util, "find_library", lambda name: None)
    monkeypatch.setattr(record.sys, "platform", "linux")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(UsageError, match="apt-get install -y libosmesa6"):
        record_task(one_disc(), tmp_path, episodes=1, first_seed=0)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_simulator_says_make_setup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match="make setup"):
        record_task(one_disc(), tmp_path, episodes=1, first_seed=0)


@pytest.mark.slow
def test_two_workers_write_the_same_logs_as_one(tmp_path: Path) -> None:
    for workers in (1, 2):
        record_task(one_disc(), tmp_path / str(workers), episodes=2, first_seed=0, workers=workers)
    for path in (tmp_path / "1").iterdir():
        assert (tmp_path / "2" / path.name).read_bytes() == path.read_bytes()
