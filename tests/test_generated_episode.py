"""The file of a generated episode: what comes back, and when it is refused."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.generated_episodes import CHECKPOINT, N_STEPS, PLAN, STEP, generated_dataset, train
from tests.stored_episodes import VIEWS, add_episodes, episode
from vilp_data import generated_episode, shards
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import StoreError, UsageError
from vilp_data.generated_episode import (
    GeneratedEpisode,
    find_generated,
    generated_name,
    generated_path,
    open_generated_episode,
    shown_frames,
    stale_generated,
    write_generated_episode,
)


def opened(store: EpisodeStore, episode_id: str) -> GeneratedEpisode:
    return open_generated_episode(store, store.root / "generated" / "planner-x", episode_id)


def test_what_was_written_comes_back(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path)
    assert stale_generated(tmp_path) == {}
    back = opened(store, made.episode)
    for name in ("step", "plan", "plan_step", "action"):
        np.testing.assert_array_equal(getattr(back, name), getattr(made, name))
    for view in VIEWS:
        np.testing.assert_array_equal(back.imagined[view], made.imagined[view])
        np.testing.assert_array_equal(back.reconstructed[view], made.reconstructed[view])
        np.testing.assert_array_equal(back.psnr_db["imagined"][view], made.psnr_db["imagined"][view])
        np.testing.assert_array_equal(back.lpips["reconstructed"][view], made.lpips["reconstructed"][view])
    assert (back.maker, back.frame_stride, back.views) == (made.maker, made.frame_stride, VIEWS)


def test_without_lpips_there_is_none(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path)
    write_generated_episode(store.root / "generated" / "planner-x", replace(made, lpips={}), store.entry(made.episode))
    assert opened(store, made.episode).lpips == {}


def test_each_frame_knows_how_far_ahead_it_was_imagined_and_each_step_its_plan(tmp_path: Path) -> None:
    _, made = generated_dataset(tmp_path)
    assert made.ahead.tolist() == [2, 4, 2, 4, 2]
    assert made.shown_first == 3  # of plans that end in rows 1, 3 and 4
    action = made.action.copy()
    action[[5, 10]] = np.nan
    assert replace(made, action=action).plan_of_step.tolist() == [0, 0, 0, 0, 1, -1, 1, 1, 2, 2, -1]


@pytest.mark.parametrize("at_a_time", [2, 64])
def test_recorded_frames_of_any_camera_rate_stand_beside_the_imagined_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_a_time: int
) -> None:
    monkeypatch.setattr(generated_episode, "SHOWN_AT_A_TIME", at_a_time)
    store, made = generated_dataset(tmp_path)
    stored = store.read(made.episode)
    for view in VIEWS:
        parts = list(shown_frames(store, opened(store, made.episode), view))
        assert [part.first for part in parts] == list(range(0, len(STEP), at_a_time))
        real = np.concatenate([part.real for part in parts])
        np.testing.assert_array_equal(real, stored.frames[view][stored.source_index[view][list(STEP)]])
        assert (np.concatenate([part.error for part in parts]) == 64).all()  # sixteen levels, four times as bright


# --- refused -----------------------------------------------------------------------------------------------------------


def ingested_anew(store: EpisodeStore, name: str) -> None:
    other = episode("other", N_STEPS)
    add_episodes(store.root, replace(other, id=name))


def trained_again(store: EpisodeStore, name: str) -> None:
    train(store.root, seed=1)


def removed(store: EpisodeStore, name: str) -> None:
    store.steps_path(name).unlink()
    store.remove_index()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (ingested_anew, r"ingested or trimmed since \(content_sha256, frames_sha256\)"),
        (trained_again, f"{CHECKPOINT} was trained again since"),
        (removed, "not in the dataset any more"),
    ],
)
def test_what_is_stale_is_refused_with_the_command_that_makes_it_again(
    tmp_path: Path, change: Callable[[EpisodeStore, str], None], why: str
) -> None:
    store, made = generated_dataset(tmp_path)
    change(store, made.episode)
    with pytest.raises(StoreError, match=why) as refused:
        opened(store, made.episode)
    command = f"vilp-models generate --data {tmp_path} --whole --preset x --episode {made.episode}"
    assert str(refused.value).endswith(f"-> make it again: {command}")
    (reason,) = stale_generated(tmp_path).values()
    assert reason.endswith(command)


def test_the_command_that_makes_it_again_can_be_pasted(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path / "my data")
    words = ("--whole", "--vqgan", str(tmp_path / "it's a run"), "--episode", made.episode)
    made = replace(made, maker=replace(made.maker, command=words))
    write_generated_episode(store.root / "generated" / "planner-x", made, store.entry(made.episode))
    trained_again(store, made.episode)
    with pytest.raises(StoreError) as refused:
        opened(store, made.episode)
    command = str(refused.value).partition("make it again: ")[2]
    assert shlex.split(command) == ["vilp-models", "generate", "--data", str(store.root), *words]


def test_a_folder_is_found_by_what_it_is_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, _ = generated_dataset(tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    own, elsewhere = store.root / "generated" / "planner-x", tmp_path / "planner-x"
    shutil.copytree(own, elsewhere)
    assert generated_name(store.root, own) == "planner-x"
    for folder in (own, elsewhere, Path("planner-x")):
        assert find_generated(store.root, generated_name(store.root, folder)).samefile(folder)


def test_an_episode_that_is_trained_on_since_is_refused(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path)
    lock = tmp_path / "split.lock.json"
    swapped = lock.read_text().replace('"val"', '"v"').replace('"train"', '"val"').replace('"v"', '"train"')
    lock.write_text(swapped)
    with pytest.raises(StoreError, match="none to validate on any more"):
        opened(store, made.episode)


def test_runs_that_were_left_behind_refuse_nothing(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path)
    shutil.rmtree(tmp_path / "runs")
    np.testing.assert_array_equal(opened(store, made.episode).plan, PLAN)


def test_another_format_is_refused(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path)
    path = generated_path(tmp_path / "generated" / "planner-x", made.episode)
    shard = shards.read_shard(path)
    shards.write_shard(path, shard.arrays, {**shard.metadata, "generated_format": "0"})
    with pytest.raises(StoreError, match="format 0, this is 1"):
        opened(store, made.episode)


def test_a_misspelt_run_or_episode_is_answered_with_the_nearest(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path)
    (tmp_path / "generated" / "clips-alone").mkdir()
    with pytest.raises(UsageError, match=r"did you mean 'planner-x'\? known: planner-x;"):
        find_generated(tmp_path, "planer-x")
    with pytest.raises(UsageError, match=f"did you mean '{made.episode}'"):
        opened(store, made.episode + "x")
    assert find_generated(tmp_path, str(tmp_path / "generated" / "planner-x")).name == "planner-x"
