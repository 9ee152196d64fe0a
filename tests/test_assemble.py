"""One demonstration onto one clock: what real logs do wrong, and that none of it becomes a label."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests import synthetic
from tests.synthetic import SyntheticLog, task_spec, write_mcap
from vilp_data.assemble import assemble_episode
from vilp_data.errors import AlignError, DecodeError
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.types import Episode


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
