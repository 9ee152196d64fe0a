"""Simulated episodes as logs: on every task's own topics, and refused where arrays cannot say it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vilp_data.assemble import assemble_episode
from vilp_data.decode import decode_vector
from vilp_data.errors import DecodeError, UsageError
from vilp_data.recorder import EpisodeRecorder
from vilp_data.sims.episode_log import START_NS, array_writer, tick_writer
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task, parse_task
from vilp_data.types import Message

PICTURE = np.full((8, 8, 3), 128, np.uint8)


def task(vectors: str) -> TaskSpec:
    return parse_task(
        f'name = "t"\nrate_hz = 10.0\n[views.top]\ntopic = "/top"\nheight = 8\nwidth = 8\n{vectors}', where="test"
    )


def written(spec: TaskSpec, path: Path, *, low_dim: Any, action: Any, state: Any) -> Any:
    """The episode of three equal ticks."""
    write = array_writer(spec)
    with EpisodeRecorder(path, metadata={}) as log:
        for tick in range(3):
            observation = {"top": PICTURE, "low_dim": np.array(low_dim, np.float32)}
            info = {"state": np.array(state, np.float64)}
            write(log, START_NS + tick * 100_000_000, observation, info, np.array(action, np.float32))
    with open_log(path) as log:
        return assemble_episode(log, log.episodes()[0], spec, episode_id="e")


def test_parts_on_several_topics_and_in_any_places_read_back(tmp_path: Path) -> None:
    spec = task(
        '[low_dim.a]\ntopic = "/s"\nclock = "log"\nfields = ["[3:5]", "[0]"]\n'
        '[low_dim.b]\ntopic = "/other"\nclock = "log"\nfields = ["data[1:2]"]\n'
        '[low_dim.c]\ntopic = "/s"\nclock = "log"\nfields = ["[1]"]\n'
        '[action.push]\ntopic = "/a"\nclock = "log"\n'
    )
    episode = written(spec, tmp_path / "e.mcap", low_dim=[1, 2, 3, 4, 5], action=[7, 8], state=[0])
    assert episode.valid.all()
    np.testing.assert_array_equal(episode.low_dim, [[1, 2, 3, 4, 5]] * 3)
    np.testing.assert_array_equal(episode.action, [[7, 8]] * 3)


def test_the_state_is_written_whole_where_low_dim_reads_a_part_of_it(tmp_path: Path) -> None:
    episode = written(load_pusht_small(), tmp_path / "e.mcap", low_dim=[1, 2], action=[3, 4], state=[1, 2, 5, 6, 7])
    np.testing.assert_array_equal(episode.state, [[1, 2, 5, 6, 7]] * 3)
    np.testing.assert_array_equal(episode.low_dim, [[1, 2]] * 3)
    np.testing.assert_array_equal(episode.action, [[3, 4]] * 3)


def load_pusht_small() -> TaskSpec:
    table = load_task("pusht").model_dump(mode="json", by_alias=True)
    table["views"]["top"] |= {"height": 8, "width": 8}
    return TaskSpec.model_validate(table)


@pytest.mark.parametrize(
    ("vectors", "says"),
    [
        ('[low_dim.a]\ntopic = "/s"\nfields = ["[0]"]\n', "header"),
        ('[low_dim.a]\ntopic = "/s"\nclock = "log"\nfields = ["pose.x"]\n', "pose.x"),
        ('[low_dim.a]\ntopic = "/s"\nclock = "log"\n[low_dim.b]\ntopic = "/r"\nclock = "log"\n', "no fields"),
        ('[low_dim.a]\ntopic = "/s"\nclock = "log"\n[action.b]\ntopic = "/s"\nclock = "log"\n', "several"),
    ],
)
def test_what_arrays_cannot_say_is_refused_with_the_way_out(vectors: str, says: str) -> None:
    with pytest.raises(UsageError, match=rf"{says}(.|\n)*write_tick"):
        array_writer(task(vectors))


def test_an_index_reaches_into_the_only_array_of_a_message_and_no_further() -> None:
    def message(schema: str, **fields: Any) -> Message:
        return Message("/t", schema, 0, 0, fields)

    array = message("std_msgs/msg/Float64MultiArray", layout=None, data=[1.0, 2.0, 3.0])
    np.testing.assert_array_equal(decode_vector(array, ["[0:2]"]), [1, 2])
    with pytest.raises(DecodeError, match="reaches outside"):
        decode_vector(array, ["[2:4]"])
    with pytest.raises(DecodeError, match="only lists and arrays"):
        decode_vector(message("own/msg/Thing", data=[1.0]), ["[0]"])


@pytest.mark.sim
def test_hanoi_writes_its_own_messages_and_they_read_back_as_observed(tmp_path: Path) -> None:
    pytest.importorskip("robosuite", reason="the simulators are not installed (make setup)")
    from vilp_data.sims.hanoi import HanoiEnv

    spec, env = load_task("hanoi"), HanoiEnv(1)
    write = tick_writer(spec, env)
    action = np.array([0.01, 0, -0.02, 0, 0, 0.1, 1], np.float32)
    observation, info = env.reset(seed=1)
    assert info["hold_action"].tolist() == [0, 0, 0, 0, 0, 0, -1]
    seen = []
    with EpisodeRecorder(tmp_path / "e.mcap", metadata={}) as log:
        for tick in range(3):
            write(log, START_NS + tick * 100_000_000, observation, info, action)
            seen.append(observation["low_dim"])
            observation, *_, info = env.step(action)
    assert info["hold_action"].tolist() == [0, 0, 0, 0, 0, 0, 1]
    _, restored = env.reset(seed=1, options={"state": info["state"]})
    assert restored["hold_action"].tolist() == [0, 0, 0, 0, 0, 0, 1]
    env.close()
    with open_log(tmp_path / "e.mcap") as log:
        episode = assemble_episode(log, log.episodes()[0], spec, episode_id="e")
    assert episode.valid.all()
    np.testing.assert_allclose(episode.low_dim, np.stack(seen), atol=1e-6)
    np.testing.assert_allclose(episode.action, [action] * 3, atol=1e-6)
