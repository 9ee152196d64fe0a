"""One demonstration onto one clock: what real logs do wrong, and that none of it becomes a label."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests import synthetic
from tests.json_log import START_NS, S, Said, image, joints, number, transform, write_json_log
from tests.synthetic import SyntheticLog, task_spec, write_mcap, write_zarr, zarr_task_spec
from vilp_data.assemble import assemble_episode
from vilp_data.errors import AlignError, DecodeError
from vilp_data.held_messages import messages_before
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import Episode, LogEpisode


def assemble(log: SyntheticLog, spec: TaskSpec) -> Episode:
    with open_log(log.path) as reader:
        (demonstration,) = reader.episodes()
        return assemble_episode(reader, demonstration, spec, episode_id="x")


def restamped(monkeypatch: pytest.MonkeyPatch, topic: str, stamp: object) -> None:
    """Write header stamps of one topic through `stamp(ns)`; log times stay right."""
    write = synthetic._cdr
    monkeypatch.setattr(
        synthetic, "_cdr", lambda t, name, value, codec: write(stamp(t) if name == topic else t, name, value, codec)
    )  # type: ignore[operator]


@pytest.mark.parametrize("topic", [synthetic.ACTION_TOPIC, synthetic.JOINT_TOPIC, "/camera/front/image"])
def test_headers_that_were_never_stamped_are_refused_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topic: str
) -> None:
    restamped(monkeypatch, topic, lambda t: 0)
    log = write_mcap(tmp_path / "run.mcap")
    with pytest.raises(AlignError, match="tell no time") as refused:
        assemble(log, task_spec(log))
    assert topic in str(refused.value)
    assert 'clock = "log"' in str(refused.value)


@pytest.mark.parametrize("kind", ["absolute", "delta"])
def test_commands_stamped_by_another_clock_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    restamped(monkeypatch, synthetic.ACTION_TOPIC, lambda t: t - 3600 * 10**9)
    log = write_mcap(tmp_path / "run.mcap")
    action = {"target": {"topic": synthetic.ACTION_TOPIC, "kind": kind}}
    with pytest.raises(AlignError, match=r"none of the commands.*\n.*359[89]"):
        assemble(log, task_spec(log, action=action))


def test_a_command_given_once_before_the_first_image_is_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    restamped(
        monkeypatch, synthetic.ACTION_TOPIC, lambda t: synthetic.START_NS - 10**9 + (t - synthetic.START_NS) // 100
    )
    log = write_mcap(tmp_path / "run.mcap")
    episode = assemble(log, task_spec(log))
    assert episode.valid.all()
    assert episode.action is not None
    assert len(np.unique(episode.action, axis=0)) == 1
    assert "action target: the command in force is older than 1 s" in " ".join(episode.findings)


def test_a_clock_set_ahead_is_refused_before_memory_runs_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    restamped(monkeypatch, "/camera/front/image", lambda t: t + (4 * 10**17 if t > synthetic.START_NS + 10**9 else 0))
    log = write_mcap(tmp_path / "run.mcap")
    with pytest.raises(AlignError, match="jumps ahead"):
        assemble(log, task_spec(log))


def test_actions_taken_from_a_state_that_went_stale_are_masked(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", joint_hz=1.0)
    table = task_spec(log, action={"target": {"from": "joints", "shift": 1}}).model_dump(by_alias=True)
    table["low_dim"]["joints"]["stale_after_s"] = 0.55
    episode = assemble(log, TaskSpec.model_validate(table))
    fresh = episode.age_s[synthetic.JOINT_TOPIC] <= 0.55
    label_known = fresh[np.minimum(np.arange(20) + 1, 19)]
    np.testing.assert_array_equal(episode.valid, fresh & label_known)


def test_a_command_topic_that_was_announced_and_never_used_leaves_an_episode_to_watch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    with open_log(log.path) as reader:
        topics = [
            t if t.name != synthetic.ACTION_TOPIC else type(t)(t.name, t.schema, t.encoding, 0) for t in reader.topics()
        ]
        monkeypatch.setattr(reader, "topics", lambda: topics)
        episode = assemble_episode(reader, reader.episodes()[0], task_spec(log), episode_id="x")
    assert episode.action is None
    assert episode.valid.all()


def tear(monkeypatch: pytest.MonkeyPatch, torn: set[int]) -> None:
    encode, count = synthetic.encode_image, iter(range(1000))

    def encode_some(image: object, codec: object) -> bytes:
        data = encode(image, codec)  # type: ignore[arg-type]
        return data[: len(data) // 2] if next(count) in torn else data

    monkeypatch.setattr(synthetic, "encode_image", encode_some)


def test_a_torn_image_is_passed_over_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tear(monkeypatch, {7, 8})
    log = write_mcap(tmp_path / "run.mcap", image_codec="png")
    monkeypatch.undo()
    episode = assemble(log, task_spec(log))
    seen = episode.frames["front"][episode.source_index["front"]]
    expected = log.frames["front"].copy()
    expected[7:9] = expected[6]
    np.testing.assert_array_equal(seen, expected)
    assert episode.age_s["/camera/front/image"][8] == pytest.approx(0.2)
    assert "view front: 2 damaged images passed over" in episode.findings


def test_images_that_are_mostly_damaged_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tear(monkeypatch, set(range(3, 20)))
    log = write_mcap(tmp_path / "run.mcap", image_codec="png")
    with pytest.raises(DecodeError):
        assemble(log, task_spec(log))


def test_a_camera_that_beats_with_the_control_clock_is_named_with_the_remedy(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", n_frames=100, jitter_s=0.004, seed=3)
    episode = assemble(log, task_spec(log))
    assert any(
        "see the image of the step before; a camera at the control rate" in finding for finding in episode.findings
    )


def test_an_episode_without_one_usable_step_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    restamped(monkeypatch, synthetic.JOINT_TOPIC, lambda t: t - 3600 * 10**9)
    log = write_mcap(tmp_path / "run.mcap")
    with pytest.raises(AlignError, match="no step can be used"):
        assemble(log, task_spec(log))


def test_the_age_of_every_value_is_kept(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap", action_hz=2.0)
    ages = assemble(log, task_spec(log)).age_s
    assert set(ages) == {"/camera/front/image", synthetic.JOINT_TOPIC, synthetic.ACTION_TOPIC}
    np.testing.assert_allclose(ages[synthetic.ACTION_TOPIC][:6], [0, 0.1, 0.2, 0.3, 0.4, 0], atol=1e-6)


# --- numbers that are none ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [1e300, -3.5e38, float("inf"), float("nan")])
@pytest.mark.parametrize("part", ["low_dim", "absolute", "delta"])
def test_a_number_that_would_be_stored_as_infinity_masks_its_step(tmp_path: Path, number: float, part: str) -> None:
    said = [image(k / 10, index=k) for k in range(20)]
    said += [joints(k / 10, ["a"], [number if k == 5 else 1.0]) for k in range(20)]
    table = {"topic": "/joint_states"}
    kinds = {"low_dim": {"joints": table}} if part == "low_dim" else {"action": {"joints": table | {"kind": part}}}
    episode = assemble_json(write_json_log(tmp_path / "run.mcap", said), **kinds)
    assert np.flatnonzero(~episode.valid).tolist() == [5]
    stored = episode.low_dim if part == "low_dim" else episode.action
    assert stored is not None
    assert np.isfinite(stored).all()


def assemble_json(path: Path, *, start_s: float | None = None, stop_s: float | None = None, **table: object) -> Episode:
    """The log's one demonstration, or [start_s, stop_s) of it."""
    views = {"front": {"topic": "/camera/front/image", "height": 48, "width": 64}}
    spec = TaskSpec.model_validate({"name": "x", "rate_hz": 10.0, "views": views, **table})
    with open_log(path) as log:
        (whole,) = log.episodes()
        start_ns = whole.start_ns if start_s is None else START_NS + round(start_s * S)
        end_ns = whole.end_ns if stop_s is None else START_NS + round(stop_s * S)
        return assemble_episode(log, LogEpisode("cut", start_ns, end_ns), spec, episode_id="x")


# --- what holds from before a cut -----------------------------------------------------------------------------------------


def pictures(count: int = 40) -> list[Said]:
    return [image(k / 10, index=k) for k in range(count)]


COMMAND = {"action": {"target": {"topic": "/cmd", "clock": "log"}}}


@pytest.mark.parametrize(("given_s", "age_s"), [(1.9, 0.1), (0.3, 1.7), (-3000.0, 3002.0)])
def test_a_command_that_was_given_before_the_cut_is_in_force_in_it(
    tmp_path: Path, given_s: float, age_s: float
) -> None:
    said = [*pictures(), number(given_s - 5, 1.0, "/cmd"), number(given_s, 2.0, "/cmd"), number(2.8, 3.0, "/cmd")]
    episode = assemble_json(write_json_log(tmp_path / "run.mcap", said), start_s=2.0, stop_s=3.5, **COMMAND)
    assert episode.valid.all()
    assert episode.action is not None
    assert episode.action[:, 0].tolist() == [2.0] * 8 + [3.0] * 7
    assert episode.age_s["/cmd"][0] == pytest.approx(age_s, abs=1e-3)


def test_a_command_that_was_given_only_before_the_cut_is_held_all_through_it(tmp_path: Path) -> None:
    log = write_json_log(tmp_path / "run.mcap", [*pictures(), number(-500.0, 2.0, "/cmd")])
    episode = assemble_json(log, start_s=2.0, stop_s=3.5, **COMMAND)
    assert episode.valid.all()
    assert episode.action is not None
    assert set(episode.action[:, 0]) == {2.0}


def test_of_several_publishers_of_commands_the_last_of_each_is_held(tmp_path: Path) -> None:
    said = [
        *pictures(),
        joints(0.2, ["elbow"], [5.0], "/cmd"),
        *(joints(k / 10, ["hand"], [k], "/cmd") for k in range(40)),
    ]
    action = {name: {"topic": "/cmd", "names": [name]} for name in ("elbow", "hand")}
    episode = assemble_json(write_json_log(tmp_path / "run.mcap", said), start_s=2.0, stop_s=3.5, action=action)
    assert episode.valid.all()
    assert episode.action is not None
    assert episode.action[:, 0].tolist() == [5.0] * 15


@pytest.mark.parametrize("names", [[], ["a"]])
def test_a_slow_state_from_before_the_cut_is_seen_while_it_is_fresh(tmp_path: Path, names: list[str]) -> None:
    said = [*pictures(), joints(1.85, ["a"], [5.0]), joints(2.6, ["a"], [6.0])]
    said += [joints(1.95, ["finger"], [9.0])] if names else []
    low_dim = {"joints": {"topic": "/joint_states", "names": names}}
    episode = assemble_json(write_json_log(tmp_path / "run.mcap", said), start_s=2.0, stop_s=3.0, low_dim=low_dim)
    assert episode.valid.tolist() == [True] * 4 + [False] * 2 + [True] * 4
    assert episode.low_dim[episode.valid, 0].tolist() == [5.0] * 4 + [6.0] * 4


def test_transforms_from_before_the_cut_count_while_they_are_fresh(tmp_path: Path) -> None:
    said = [*pictures(), transform(1.85, "base", "tool", 5.0), transform(2.6, "base", "tool", 6.0)]
    low_dim = {"tool": {"topic": "/tf", "from_frame": "base", "to_frame": "tool"}}
    episode = assemble_json(write_json_log(tmp_path / "run.mcap", said), start_s=2.0, stop_s=3.0, low_dim=low_dim)
    assert episode.valid.tolist() == [True] * 4 + [False] * 2 + [True] * 4


def test_what_came_before_a_clock_was_reset_is_not_held(tmp_path: Path) -> None:
    """The cut begins where the robot's clock begins anew: the command before it is stamped an hour later than those in it."""
    said = pictures()
    for k in range(40):
        t = k / 10
        body = joints(t + (3600 if t < 2 else 0), ["a"], [t]).body
        said.append(Said(t, "/cmd", "sensor_msgs/msg/JointState", body))
    log = write_json_log(tmp_path / "run.mcap", said)
    episode = assemble_json(log, start_s=2.0, stop_s=3.5, action={"target": {"topic": "/cmd"}})
    assert episode.valid.all()
    assert episode.action is not None
    np.testing.assert_allclose(episode.action[:, 0], 2 + np.arange(15) / 10, atol=1e-6)


def test_transforms_from_before_a_clock_was_reset_do_not_count(tmp_path: Path) -> None:
    said = pictures()
    for k in range(40):
        t = k / 10
        said.append(transform(t + (3600 if t < 2 else 0), "base", "tool", t)._replace(t_s=t))
    low_dim = {"tool": {"topic": "/tf", "from_frame": "base", "to_frame": "tool"}}
    episode = assemble_json(write_json_log(tmp_path / "run.mcap", said), start_s=2.0, stop_s=3.5, low_dim=low_dim)
    assert episode.valid.all()
    np.testing.assert_allclose(episode.low_dim[:, 0], 2 + np.arange(15) / 10, atol=1e-6)


def test_steps_of_a_cut_without_cameras_begin_with_its_own_messages(tmp_path: Path) -> None:
    said = [joints(k / 50, ["a"], [k / 50]) for k in range(200)]
    low_dim = {"joints": {"topic": "/joint_states"}}
    log = write_json_log(tmp_path / "run.mcap", said)
    episode = assemble_json(log, start_s=2.0, stop_s=3.0, low_dim=low_dim, views={})
    assert (episode.log_time_ns[0] - START_NS, episode.n_steps) == (2 * S, 10)


def test_the_demonstrations_of_a_store_hold_nothing_of_each_other(tmp_path: Path) -> None:
    store = write_zarr(tmp_path / "replay.zarr", episode_lengths=(12, 9))
    spec = zarr_task_spec()
    with open_log(store.path) as log:
        for demonstration in log.episodes():
            before = messages_before(log, demonstration, spec, spec.topics())
            assert list(before) == []
            cut = LogEpisode("cut", demonstration.start_ns + 3 * 10**8, demonstration.end_ns)
            held = list(messages_before(log, cut, spec, spec.topics()))
            assert held
            assert all(demonstration.start_ns <= message.log_time_ns < cut.start_ns for message in held)
