"""Rollouts: what a start comes to, whoever runs beside it; what is reported, and left behind."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the simulators are not installed: make setup")

from tests.models.toy_simulator import GOAL, Dot, dot_task
from tests.stored_episodes import add_episodes
from tests.stored_episodes import episode as random_episode
from vilp_data.assemble import assemble_episode
from vilp_data.dataset_split import find_split, side_episodes, update_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.ingest import ingest_logs
from vilp_data.sources import open_log
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task
from vilp_data.types import F32, is_rollout
from vilp_models.environments import Environments
from vilp_models.policies.base import Observation
from vilp_models.policies.recorded import RecordedPolicy
from vilp_models.policies.stay import StayPolicy
from vilp_models.rollout import LogPlan, roll_out
from vilp_models.rollout_report import format_rollout, log_film, read_rollout, roll_out_into
from vilp_models.starts import Recording, Start, episode_starts, parse_seeds, seed_starts


class RandomPolicy:
    """Random actions, of each environment's own generator."""

    def __init__(self, scale: float = 1.0, n_action_steps: int = 3, size: int = 1, offset: float = 0.0) -> None:
        self.n_action_steps, self.scale, self.size, self.offset = n_action_steps, scale, size, offset
        self.tags: Mapping[str, str] = {"random_checkpoint": "abc"}
        self.seen: list[Observation] = []

    def reset(self, seed: int | Sequence[int]) -> None:
        seeds = [seed] if isinstance(seed, int) else seed
        self.generators = [np.random.default_rng(one) for one in seeds]
        self.seen = []

    def act(self, observation: Observation) -> F32:
        self.seen.append(observation)
        shape = (self.n_action_steps, self.size)
        drawn = [self.offset + generator.uniform(0, self.scale, shape) for generator in self.generators]
        return np.stack(drawn).astype(np.float32)

    def timings(self) -> Mapping[str, float]:
        return {"draw": 0.5}


@pytest.fixture
def spec() -> TaskSpec:
    return dot_task()


def test_what_a_start_comes_to_does_not_depend_on_who_runs_beside_it(spec: TaskSpec) -> None:
    together, _ = roll_out(spec, RandomPolicy(), seed_starts(range(7)), max_steps=20, environments=7)
    some, _ = roll_out(spec, RandomPolicy(), seed_starts(range(7)), max_steps=20, environments=3)
    alone, _ = roll_out(spec, RandomPolicy(), seed_starts([5]), max_steps=20, environments=50)
    assert together == some
    assert together[5] == alone[0]
    assert len({result.n_steps for result in together}) > 1  # some were done before others


def test_an_episode_ends_at_success_and_counts_the_steps_it_took(spec: TaskSpec) -> None:
    push = RandomPolicy(scale=1e-9, offset=1.0)
    (result,), timing = roll_out(spec, push, [Start("s", 0, None, np.array([4.5, 0.0]))], max_steps=20, environments=1)
    assert (result.success, result.n_steps) == (True, 4)
    assert result.max_reward == pytest.approx(8.5 / GOAL)
    assert (timing.n_plans, timing.n_steps) == (2, 4)
    assert timing.parts["draw"] == 1.0


def test_an_episode_that_is_done_stays_as_it_is_while_others_go_on(spec: TaskSpec) -> None:
    starts = [Start("near", 0, None, np.array([7.5, 0.0])), Start("far", 1, None, np.array([0.0, 0.0]))]
    near, far = roll_out(spec, RandomPolicy(1e-9, offset=0.5), starts, max_steps=10, environments=2)[0]
    assert (near.n_steps, far.n_steps) == (1, 10)
    assert near.max_reward == pytest.approx(1.0)
    assert not far.success


def test_max_steps_cuts_a_chunk_short(spec: TaskSpec) -> None:
    (result,), timing = roll_out(spec, RandomPolicy(0.0), seed_starts([0]), max_steps=7, environments=1)
    assert (result.n_steps, timing.n_plans) == (7, 3)


def test_the_policy_sees_the_present_and_is_asked_once_a_chunk(spec: TaskSpec) -> None:
    policy = RandomPolicy(1e-9, offset=0.5)
    start = Start("s", 0, None, np.array([1.0, 0.0]))
    roll_out(spec, policy, [start], max_steps=6, environments=1)
    assert [float(seen.low_dim[0, 0]) for seen in policy.seen] == [1.0, 2.5]
    assert [int(seen.frames["top"][0, 0, 0, 0]) for seen in policy.seen] == [20, 50]
    assert policy.seen[0].hold_action.shape == (1, 1)


def test_without_logs_a_simulator_draws_only_what_the_policy_looks_at(
    spec: TaskSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """3 actions a plan of 8 steps: drawn at the start, and after steps 3, 6 and 8. What the policy sees is the same."""
    monkeypatch.setattr(Dot, "set_drawing", lambda self, on: vars(self).update(drawing=on), raising=False)
    observe, drawn = Dot._observe, []

    def observe_or_not(self: Dot) -> dict[str, Any]:
        whole = observe(self)
        if not getattr(self, "drawing", True):
            del whole["top"]
        drawn.append("top" in whole)
        return whole

    monkeypatch.setattr(Dot, "_observe", observe_or_not)
    starts = [Start("s", 0, None, np.array([1.0, 0.0]))]
    seen = []
    for logs in (None, LogPlan(tmp_path, {})):
        drawn.clear()
        policy = RandomPolicy(1e-9, offset=0.5)
        results, _ = roll_out(spec, policy, starts, max_steps=8, environments=1, logs=logs)
        seen.append((results, [int(look.frames["top"][0, 0, 0, 0]) for look in policy.seen], drawn.count(True)))
    (without, looks, few), (with_logs, same_looks, many) = seen
    assert without == with_logs
    assert looks == same_looks == [20, 50, 80]
    assert (few, many) == (4, 9)


def test_frames_come_at_the_size_the_dataset_stores() -> None:
    world = Environments(dot_task("options = { height = 16, width = 24 }"), 2)
    assert world.reset(seed_starts([0, 1])).frames["top"].shape == (2, 8, 12, 3)
    world.close()


def test_depth_is_not_resized_as_if_it_were_brightness() -> None:
    table = dot_task("options = { height = 16, width = 24 }").model_dump(by_alias=True)
    table["views"]["top"]["depth"] = {"unit": "m", "near_m": 0.1, "far_m": 1.0}
    world = Environments(TaskSpec.model_validate(table), 1)
    with pytest.raises(UsageError, match="not the depth that the task stores"):
        world.reset(seed_starts([0]))
    world.close()


@pytest.mark.parametrize("broken", [np.zeros((1, 2, 1), np.float32), np.full((1, 3, 1), np.nan, np.float32)])
def test_actions_of_another_shape_or_not_finite_are_refused(spec: TaskSpec, broken: F32) -> None:
    policy = RandomPolicy()
    policy.act = lambda observation: broken  # type: ignore[method-assign]
    with pytest.raises(UsageError, match="no actions that can be taken"):
        roll_out(spec, policy, seed_starts([0]), max_steps=6, environments=1)


def test_progress_ends_at_its_total(spec: TaskSpec) -> None:
    told: list[tuple[int, int]] = []
    push = RandomPolicy(1e-9, offset=1.0)
    roll_out(spec, push, seed_starts(range(3)), max_steps=20, environments=2, progress=lambda *at: told.append(at))
    assert told[-1] == (60, 60)
    assert told == sorted(told)


# --- logs ---


def test_a_log_reads_back_as_what_was_seen_and_done(spec: TaskSpec, tmp_path: Path) -> None:
    plan = LogPlan(tmp_path, {"policy": "random"})
    results, _ = roll_out(spec, RandomPolicy(), seed_starts([3, 4]), max_steps=20, environments=2, logs=plan)
    actions = np.random.default_rng(3).uniform(0, 1, (60, 1)).astype(np.float32)
    with open_log(tmp_path / "seed0000003.mcap") as log:
        episode = assemble_episode(log, log.episodes()[0], spec, episode_id="three")
    n_steps = results[0].n_steps
    assert episode.n_steps == n_steps + 1  # the last tick holds the final observation
    assert episode.valid.all()
    assert episode.findings == ()
    np.testing.assert_array_equal(episode.action[:n_steps], actions[:n_steps])
    assert float(episode.action[-1, 0]) == 0.0
    np.testing.assert_allclose(np.diff(episode.state[:, 0]), actions[:n_steps, 0])
    np.testing.assert_array_equal(episode.low_dim[:, 0], episode.state[:, 0].astype(np.float32))
    drawn = episode.frames["top"][episode.source_index["top"]][:, 0, 0, 0].astype(int)
    assert np.abs(drawn - np.floor(episode.state[:, 0] * 20)).max() <= 2  # JPEG
    tags = episode.tags
    assert (tags["policy"], tags["source"], tags["success"]) == ("random", "rollout", str(results[0].success).lower())
    assert float(tags["max_reward"]) == pytest.approx(results[0].max_reward, rel=1e-5)
    assert (tags["seed"], tags["policy_seed"]) == ("3", "3")


@pytest.mark.parametrize("reset_seed", [7, None])
def test_a_log_tells_the_seed_of_the_environment_from_that_of_the_policy(
    spec: TaskSpec, tmp_path: Path, reset_seed: int | None
) -> None:
    start = Start("a", 1234, reset_seed, np.array([0.5, 0.0]))
    roll_out(spec, RandomPolicy(), [start], max_steps=3, environments=1, logs=LogPlan(tmp_path, {}))
    with open_log(tmp_path / "a.mcap") as log:
        tags = log.episodes()[0].tags
    assert tags["policy_seed"] == "1234"
    assert tags.get("seed") == (None if reset_seed is None else "7")


def test_ingest_leaves_a_policys_episodes_out_and_no_side_ever_has_them(spec: TaskSpec, tmp_path: Path) -> None:
    demonstrations, own = tmp_path / "demonstrations", tmp_path / "own"
    for folder, seeds in ((demonstrations, range(3)), (own, range(5, 7))):
        roll_out(
            spec,
            RandomPolicy(),
            seed_starts(seeds),
            max_steps=20,
            environments=3,
            logs=LogPlan(folder, {"policy": "p"}),
        )
    root = tmp_path / "data"
    report = ingest_logs([own], root, spec, workers=1)
    assert (report.written, report.rollouts) == ([], ["seed0000005", "seed0000006"])

    report = ingest_logs([demonstrations, own], root, spec, workers=1, include_failures=True, with_rollouts=True)
    assert len(report.written) == 5
    store = EpisodeStore(root)
    assert all(is_rollout(entry.tags) for entry in store.index())
    for path in store.root.glob("episodes/steps/seed000000[012].safetensors"):
        retag(store, path.name.removesuffix(".safetensors"))
    update_split(root, ratio=0.6, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    lock = find_split(root)
    assert lock is not None
    assert set(lock.assignment) == {"seed0000000", "seed0000001", "seed0000002"}
    sides = [entry.id for side in ("train", "val") for entry in side_episodes(store, side)]  # type: ignore[arg-type]
    assert sorted(sides) == sorted(lock.assignment)


def retag(store: EpisodeStore, episode_id: str) -> None:
    """Make a stored episode a demonstration."""
    from vilp_data.episodes import Origin

    entry, episode = store.entry(episode_id), store.read(episode_id)
    origin = Origin(entry.source, entry.source_sha256, entry.source_episode, entry.key, entry.ingest)
    store.remove_index()
    store.write(replace(episode, tags={**episode.tags, "source": "person"}), origin)
    store.write_index()


# --- reports ---


def stayed(folder: Path, spec: TaskSpec, seeds: range, *, max_steps: int = 20) -> None:
    roll_out_into(
        folder, spec, StayPolicy(n_action_steps=4), seed_starts(seeds), name="stay", what="x", max_steps=max_steps,
        environments=4,
    )  # fmt: skip


def test_a_report_gives_means_intervals_and_the_paired_difference(spec: TaskSpec, tmp_path: Path) -> None:
    stayed(tmp_path / "stay", spec, range(6))
    roll_out_into(
        tmp_path / "random", spec, RandomPolicy(0.5), seed_starts(range(6)), name="random", what="x", max_steps=10,
        environments=4,
    )  # fmt: skip
    with pytest.raises(UsageError, match="another max_steps"):
        against(tmp_path, spec, range(6), max_steps=10)
    with pytest.raises(UsageError, match="other starts"):
        against(tmp_path, spec, range(5), max_steps=20)
    against(tmp_path, spec, range(6), max_steps=20)
    table, stay = read_rollout(tmp_path / "random"), read_rollout(tmp_path / "stay")
    rewards = [episode["max_reward"] for episode in table["episodes"]]
    difference = np.array(rewards) - [episode["max_reward"] for episode in stay["episodes"]]
    assert table["max_reward"]["value"] == pytest.approx(np.mean(rewards), abs=1e-4)
    assert table["max_reward"]["low"] < table["max_reward"]["value"] < table["max_reward"]["high"]
    (other,) = table["against"]
    assert other["policy"] == "stay"
    assert other["max_reward"]["value"] == pytest.approx(difference.mean(), abs=1e-4)
    assert other["max_reward"]["low"] > 0
    assert table["tags"] == {"random_checkpoint": "abc"}
    assert table["time"]["parts_s"] == {"draw": 0.5}
    page = (tmp_path / "random" / "report.md").read_text()
    assert "minus `stay`" in page


def against(folder: Path, spec: TaskSpec, seeds: range, *, max_steps: int) -> None:
    roll_out_into(
        folder / "random", spec, RandomPolicy(0.5), seed_starts(seeds), name="random", what="x", max_steps=max_steps,
        environments=4, against=[folder / "stay"],
    )  # fmt: skip


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_rollout_leaves_logs_and_three_videos_and_replaces_what_was_there(spec: TaskSpec, tmp_path: Path) -> None:
    folder = tmp_path / "stay"
    stayed(folder, spec, range(5))
    assert len(list(folder.glob("logs/*.mcap"))) == 5
    stayed(folder, spec, range(3))
    assert sorted(path.stem for path in folder.glob("logs/*.mcap")) == ["seed0000000", "seed0000001", "seed0000002"]
    assert sorted(path.name for path in folder.glob("videos/*")) == ["best.mp4", "median.mp4", "worst.mp4"]
    assert list(tmp_path.iterdir()) == [folder]
    frames, fps = log_film(folder / "logs" / "seed0000000.mcap", spec)
    assert frames.shape == (21, 8, 12, 3)
    assert fps == pytest.approx(10)


@pytest.mark.parametrize("error", [KeyboardInterrupt, UsageError("broken")])
def test_a_rollout_that_is_stopped_leaves_nothing_and_the_earlier_one_as_it_was(
    spec: TaskSpec, tmp_path: Path, error: BaseException
) -> None:
    class Stopped(RandomPolicy):
        def act(self, observation: Observation) -> F32:
            if self.seen:
                raise error
            return super().act(observation)

    def stopped(folder: Path) -> None:
        starts = seed_starts(range(3))
        with pytest.raises((KeyboardInterrupt, UsageError)):
            roll_out_into(folder, spec, Stopped(), starts, name="p", what="x", max_steps=20, environments=3)

    stayed(tmp_path / "earlier", spec, range(3))
    before = files(tmp_path)
    stopped(tmp_path / "earlier")
    stopped(tmp_path / "new")
    assert files(tmp_path) == before
    assert [path.name for path in tmp_path.iterdir()] == ["earlier"]
    with pytest.raises(UsageError, match="no finished rollout"):
        read_rollout(tmp_path / "new")


def demonstrations(folder: Path, spec: TaskSpec) -> None:
    (folder / "logs").mkdir(parents=True)
    (folder / "logs" / "demo.mcap").write_bytes(b"what a person did")


def a_dataset(folder: Path, spec: TaskSpec) -> None:
    EpisodeStore(folder).write_spec(spec)


def another_report(folder: Path, spec: TaskSpec) -> None:
    folder.mkdir(parents=True)
    (folder / "report.json").write_text('{"inputs": {}, "episodes": []}')


def a_rollout_with_demonstrations(folder: Path, spec: TaskSpec) -> None:
    stayed(folder, spec, range(1))
    (folder / "logs" / "demo.mcap").write_bytes(b"what a person did")


def a_file(folder: Path, spec: TaskSpec) -> None:
    folder.write_text("notes")


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (demonstrations, r"this is something else(.|\n)*logs/demo.mcap"),
        (a_dataset, "cannot take the place of a dataset"),
        (another_report, r"this is something else(.|\n)*report.json"),
        (a_rollout_with_demonstrations, r"not its own lie beside it(.|\n)*logs/demo.mcap"),
        (a_file, "this is something else"),
    ],
)
def test_nothing_but_a_rollout_is_replaced(
    spec: TaskSpec, tmp_path: Path, made: Callable[[Path, TaskSpec], None], words: str
) -> None:
    made(tmp_path / "there", spec)
    before = files(tmp_path)
    with pytest.raises(UsageError, match=words):
        stayed(tmp_path / "there", spec, range(1))
    assert files(tmp_path) == before


def test_a_rollout_may_fill_an_empty_folder(spec: TaskSpec, tmp_path: Path) -> None:
    stayed(tmp_path, spec, range(1))
    assert read_rollout(tmp_path)["policy"] == "stay"


@pytest.mark.parametrize(("n_starts", "videos"), [(1, {"best"}), (2, {"best", "worst"})])
def test_no_episode_is_filmed_twice(spec: TaskSpec, tmp_path: Path, n_starts: int, videos: set[str]) -> None:
    stayed(tmp_path, spec, range(n_starts))
    assert {path.stem for path in tmp_path.glob("videos/*")} == videos


def test_without_logs_there_are_no_videos_and_the_page_names_none(spec: TaskSpec, tmp_path: Path) -> None:
    for with_logs in (True, False):
        folder = tmp_path / str(with_logs)
        roll_out_into(
            folder, spec, StayPolicy(n_action_steps=3), seed_starts(range(3)), name="stay", what="x", max_steps=20, environments=4,
            with_logs=with_logs,
        )  # fmt: skip
        assert (folder / "videos").exists() == with_logs
        assert ("| best |" in (folder / "report.md").read_text()) == with_logs


def test_a_single_start_has_no_interval_and_is_still_valid_json(spec: TaskSpec, tmp_path: Path) -> None:
    stayed(tmp_path, spec, range(1))
    table = json.loads((tmp_path / "report.json").read_text())
    assert table["max_reward"]["low"] is None
    assert "stay on 1 start (x)" in format_rollout(table, tmp_path)[0]


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        ((0.3, 0.1, 0.5), "+0.300 (+0.100 to +0.500): above"),
        ((-0.3, -0.5, -0.1), "-0.300 (-0.500 to -0.100): below"),
        ((0.3, -0.1, 0.5), "+0.300 (-0.100 to +0.500)"),
        ((0.3, None, None), "+0.300"),
    ],
)
def test_a_difference_is_called_above_or_below_only_where_its_interval_is(
    spec: TaskSpec, tmp_path: Path, interval: tuple[float | None, ...], words: str
) -> None:
    stayed(tmp_path, spec, range(1))
    estimate = dict(zip(("value", "low", "high"), interval, strict=True))
    table = read_rollout(tmp_path) | {"against": [{"policy": "other", "max_reward": estimate, "success": estimate}]}
    [line] = [line for line in format_rollout(table, tmp_path) if "against" in line]
    assert line.endswith(words)


# --- starts ---


def test_seeds_are_a_half_open_range_or_one() -> None:
    assert parse_seeds("100000:100050") == range(100000, 100050)
    assert parse_seeds("7") == range(7, 8)
    for wrong in ("", "5:5", "9:3", "a:b", "1:2:3", "-1:4"):
        with pytest.raises(UsageError, match="no seeds"):
            parse_seeds(wrong)


def test_recorded_actions_lead_from_the_recorded_start_to_the_recorded_end(spec: TaskSpec, tmp_path: Path) -> None:
    logs = LogPlan(tmp_path / "logs", {})
    results, _ = roll_out(spec, RandomPolicy(), seed_starts(range(3)), max_steps=20, environments=3, logs=logs)
    root = tmp_path / "data"
    ingest_logs([tmp_path / "logs"], root, spec, workers=1, include_failures=True, with_rollouts=True)
    store = EpisodeStore(root)
    with pytest.raises(UsageError, match="no episode of 'all'"):
        episode_starts(store, "all")  # a policy's own are no demonstrations
    for result in results:
        retag(store, result.name)
    starts, recordings = episode_starts(store, "all", limit=2)
    assert [start.name for start in starts] == ["seed0000000", "seed0000001"]
    assert [start.reset_seed for start in starts] == [0, 1]
    policy = RecordedPolicy(recordings, n_action_steps=4)
    replayed, _ = roll_out(spec, policy, starts, max_steps=20, environments=2)
    assert [r.max_reward for r in replayed] == pytest.approx([r.max_reward for r in results[:2]])
    with pytest.raises(UsageError, match="did you mean 'val'"):
        episode_starts(store, "vall")


def test_the_seed_of_a_recorded_start_stays_when_episodes_are_added(tmp_path: Path) -> None:
    def seeds() -> dict[str, int]:
        starts, recordings = episode_starts(EpisodeStore(tmp_path), "all")
        for start in starts:
            assert start.state is not None
            np.testing.assert_array_equal(recordings[start.policy_seed].state[0], start.state)
        return {start.name: start.policy_seed for start in starts}

    EpisodeStore(tmp_path).write_spec(dot_task())
    state = np.arange(20.0).reshape(10, 2)
    add_episodes(tmp_path, *(replace(random_episode(name, 10), state=state + ord(name)) for name in "bd"))
    before = seeds()
    add_episodes(tmp_path, *(replace(random_episode(name, 10), state=state + ord(name)) for name in "ac"))
    after = seeds()
    assert {name: after[name] for name in "bd"} == before
    assert len(set(after.values())) == 4


def recording(n_steps: int) -> Recording:
    frames = np.arange(n_steps, dtype=np.uint8)[:, None, None, None] * np.ones((1, 8, 12, 3), np.uint8)
    steps = np.arange(n_steps, dtype=np.float32)[:, None]
    return Recording({"top": frames}, {"top": np.arange(n_steps)}, steps, 10 * steps, steps.astype(np.float64))


def test_a_recording_holds_its_last_step() -> None:
    short = recording(3)
    assert short.frame("top", 1)[0, 0, 0] == 1
    assert short.frame("top", 9)[0, 0, 0] == 2
    policy = RecordedPolicy({4: short}, n_action_steps=2)
    policy.reset([4])
    seen = Observation({}, np.zeros((1, 1), np.float32), np.zeros((1, 1), np.float32))
    assert [policy.act(seen)[0, :, 0].tolist() for _ in range(2)] == [[0, 10], [20, 20]]


# --- Push-T ---


@pytest.mark.sim
def test_pusht_stays_where_it_is_and_its_log_is_a_demonstration_of_that(tmp_path: Path) -> None:
    pytest.importorskip("gym_pusht", reason="the simulators are not installed: make setup")
    spec = load_task("pusht")
    plan = LogPlan(tmp_path, {})
    policy = StayPolicy(n_action_steps=4)
    starts = seed_starts([10, 0])
    together, _ = roll_out(spec, policy, starts, max_steps=6, environments=2, logs=plan)
    alone, _ = roll_out(spec, policy, starts, max_steps=6, environments=1)
    assert together == alone
    assert together[0].max_reward > 0.05  # this start covers a part of the goal
    with open_log(tmp_path / "seed0000010.mcap") as log:
        episode = assemble_episode(log, log.episodes()[0], spec, episode_id="ten")
    assert episode.valid.all()
    np.testing.assert_allclose(episode.action, episode.low_dim, atol=1e-3)
    np.testing.assert_array_equal(episode.low_dim, episode.state[:, :2].astype(np.float32))
