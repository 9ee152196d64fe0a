from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.models.conftest import HEIGHT, WIDTH, tiny_recipe
from tests.models.tiny_training import in_two_processes
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import BusyError, StoreError, UsageError
from vilp_data.shards import open_shard, read_shard, write_shard
from vilp_data.spec import TaskSpec
from vilp_data.writer_lock import writer_lock
from vilp_models.checkpoint import FILE, load_checkpoint, model_tensors, read_state, run_folder
from vilp_models.optimisation import DivergedError
from vilp_models.processes import Processes
from vilp_models.recipe import VqganRecipe
from vilp_models.train import train_vqgan
from vilp_models.vqgan import load_frame_encoder
from vilp_models.vqgan_training import VqganTraining


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    return tmp_path / "vqgan"


def _train(
    store: EpisodeStore, spec: TaskSpec, recipe: VqganRecipe, run_dir: Path, episodes: str = "abc", **options: Any
) -> None:
    train_vqgan(store.root, spec, recipe, run_dir, train_episodes=list(episodes), split_hash="s", show=False, **options)


def _interrupt_at(monkeypatch: pytest.MonkeyPatch, index: int, error: type[Exception] | None = None) -> None:
    """Send Ctrl-C, or raise, in the middle of step `index`."""
    step = VqganTraining.step

    def interrupted(self: VqganTraining, at: int) -> dict[str, torch.Tensor]:
        if at == index and error is not None:
            raise error("stopped")
        if at == index:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, at)

    monkeypatch.setattr(VqganTraining, "step", interrupted)


def test_one_network_a_view_or_one_for_all(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    _train(store, spec, tiny_recipe(), run_dir / "own")
    assert sorted(p.name for p in (run_dir / "own").iterdir()) == ["front", "side"]
    assert load_frame_encoder(run_dir / "own", "front").key != load_frame_encoder(run_dir / "own", "side").key
    _train(store, spec, tiny_recipe(share_views=True), run_dir / "shared")
    assert load_frame_encoder(run_dir / "shared", "front").key == load_frame_encoder(run_dir / "shared", "side").key


def test_a_trained_encoder_encodes_and_knows_its_episodes(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    _train(store, spec, tiny_recipe(), run_dir)
    encoder = load_frame_encoder(run_dir, "front")
    frames = open_shard(store.frames_path("front", "d")).arrays["frames"]
    assert encoder.encode(frames).shape == (len(frames), 3, HEIGHT // 4, WIDTH // 4)
    assert encoder.trained_on == {"key-a", "key-b", "key-c"}
    with pytest.raises(UsageError, match="front"):
        load_frame_encoder(run_dir, "frnt")


def test_ctrl_c_saves_and_resuming_gives_the_same_bytes(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tiny_recipe(share_views=True)
    _train(store, spec, recipe, run_dir / "whole")
    with monkeypatch.context() as patch:
        _interrupt_at(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            _train(store, spec, recipe, run_dir / "cut")
    run = run_folder(run_dir / "cut", ("front", "side"))
    state = read_state(run)
    assert state is not None
    assert (state.step, state.finished) == (3, False)
    _train(store, spec, recipe, run_dir / "cut")
    assert (run / FILE).read_bytes() == (run_folder(run_dir / "whole", ("front", "side")) / FILE).read_bytes()


def test_a_diverging_run_keeps_its_last_checkpoint(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tiny_recipe(share_views=True)
    with monkeypatch.context() as patch:
        _interrupt_at(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            _train(store, spec, recipe, run_dir)
    run = run_folder(run_dir, ("front", "side"))
    good = (run / FILE).read_bytes()
    step = VqganTraining.step

    def broken(self: VqganTraining, at: int) -> dict[str, torch.Tensor]:
        if at == 4:
            with torch.no_grad():
                self.model.decoder.conv_out.bias[0] = float("nan")
        return step(self, at)

    monkeypatch.setattr(VqganTraining, "step", broken)
    with pytest.raises(DivergedError, match=r"front\+side(.|\n)*l1 nan(.|\n)*models.vqgan.learning_rate"):
        _train(store, spec, recipe, run_dir)
    assert (run / FILE).read_bytes() == good


def test_a_finished_run_is_not_done_again(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _train(store, spec, tiny_recipe(), run_dir)
    checkpoints = sorted(run_dir.rglob(FILE))
    before = [path.read_bytes() for path in checkpoints]
    _interrupt_at(monkeypatch, 0, AssertionError)
    _train(store, spec, tiny_recipe(), run_dir)
    assert before
    assert [path.read_bytes() for path in checkpoints] == before


def test_episodes_added_later_leave_a_finished_run_as_it_is(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    _train(store, spec, tiny_recipe(), run_dir, "abc")
    before = load_frame_encoder(run_dir, "front").key
    _train(store, spec, tiny_recipe(), run_dir, "abcd")
    assert load_frame_encoder(run_dir, "front").key == before


def test_another_recipe_or_lost_episodes_are_refused_unless_restarted(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path
) -> None:
    _train(store, spec, tiny_recipe(), run_dir)
    with pytest.raises(UsageError, match=r"learning_rate = 0\.002 there, 0\.01 now"):
        _train(store, spec, tiny_recipe(learning_rate=1e-2), run_dir)
    with pytest.raises(UsageError, match="found: c"):
        _train(store, spec, tiny_recipe(), run_dir, "ab")
    _train(store, spec, tiny_recipe(), run_dir, "ab", restart=True)
    assert load_frame_encoder(run_dir, "front").trained_on == {"key-a", "key-b"}


def test_a_restart_that_fails_leaves_the_trained_network(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _train(store, spec, tiny_recipe(share_views=True), run_dir)
    path = run_folder(run_dir, ("front", "side")) / FILE
    good = path.read_bytes()
    with pytest.raises(UsageError):  # crops larger than the frames
        _train(store, spec, tiny_recipe(share_views=True, crop=64), run_dir, restart=True)
    assert path.read_bytes() == good
    with monkeypatch.context() as patch:
        _interrupt_at(patch, 0, DivergedError)
        with pytest.raises(DivergedError):
            _train(store, spec, tiny_recipe(share_views=True), run_dir, restart=True)
    assert path.read_bytes() == good
    _train(store, spec, tiny_recipe(share_views=True, seed=1), run_dir, restart=True)
    assert path.read_bytes() != good
    restarted = path.read_bytes()
    _train(store, spec, tiny_recipe(share_views=True, seed=1), run_dir / "fresh")
    assert (run_folder(run_dir / "fresh", ("front", "side")) / FILE).read_bytes() == restarted


def test_a_recipe_key_that_came_later_is_no_other_recipe(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    recipe = tiny_recipe(share_views=True)
    _train(store, spec, recipe, run_dir)
    path = run_folder(run_dir, ("front", "side")) / FILE
    shard = read_shard(path)
    stored = json.loads(shard.metadata["recipe"])
    del stored["restart_every"], stored["crop"]  # crop's default is this recipe's, restart_every's is not
    header = {"format": shard.metadata["format"], "state": shard.metadata["state"], "recipe": json.dumps(stored)}
    write_shard(path, dict(shard.arrays), header)
    with pytest.raises(UsageError, match=r"found: restart_every = 200 there, 2 now\n"):
        _train(store, spec, recipe, run_dir)
    stored["restart_every"] = recipe.restart_every
    write_shard(path, dict(shard.arrays), {**header, "recipe": json.dumps(stored)})
    trained = path.read_bytes()
    _train(store, spec, recipe, run_dir)
    assert path.read_bytes() == trained


def test_every_process_hears_that_a_run_is_busy(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    def task(_: Processes) -> dict[str, np.ndarray]:
        signal.alarm(60)  # one that waits for ever fails
        try:
            _train(store, spec, tiny_recipe(), run_dir, device="cpu")
        except BusyError:
            return {"busy": np.ones(1)}
        return {"busy": np.zeros(1)}

    with writer_lock(run_folder(run_dir, ("front",))):
        answers = in_two_processes(task, run_dir / "answers")
    assert [answer["busy"].item() for answer in answers] == [1, 1]


def test_a_run_that_another_process_trains_is_busy(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    with writer_lock(run_folder(run_dir, ("front",))), pytest.raises(BusyError, match="training this run"):
        _train(store, spec, tiny_recipe(), run_dir)
    assert read_state(run_folder(run_dir, ("front",))) is None
    _train(store, spec, tiny_recipe(), run_dir)
    assert (read_state(run_folder(run_dir, ("front",))) or pytest.fail("not trained")).finished


def test_a_foreign_frames_file_is_not_trained_on(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    store.frames_path("front", "a").write_bytes(store.frames_path("front", "b").read_bytes())
    with pytest.raises(StoreError, match=r"not the frames(.|\n)*vilp-data ingest"):
        _train(store, spec, tiny_recipe(), run_dir)


def test_the_networks_tensors_are_read_without_what_resuming_needs(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path
) -> None:
    _train(store, spec, tiny_recipe(), run_dir)
    run = run_folder(run_dir, ("front",))
    model, whole = model_tensors(run), load_checkpoint(run)
    assert whole.trainer
    assert model.keys() == whole.model.keys()
    for name, array in model.items():
        np.testing.assert_array_equal(array, whole.model[name])
        assert array.flags.owndata
        assert array.flags.writeable


def test_an_unknown_episode_is_named(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    with pytest.raises(UsageError, match="'x'"):
        _train(store, spec, tiny_recipe(), run_dir, "ax")


def test_the_checkpoint_says_what_it_was_trained_on(store: EpisodeStore, spec: TaskSpec, run_dir: Path) -> None:
    _train(store, spec, tiny_recipe(), run_dir)
    checkpoint = load_checkpoint(run_folder(run_dir, ("front",)))
    assert checkpoint.state.split_hash == "s"
    assert checkpoint.state.train_episodes == {e: f"key-{e}" for e in "abc"}
    assert VqganRecipe.model_validate(checkpoint.recipe) == tiny_recipe()
    assert VqganRecipe.model_validate(json.loads((run_dir / "front" / "recipe.json").read_text())) == tiny_recipe()


def test_a_checkpoint_of_another_format_or_a_damaged_one_is_refused(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path
) -> None:
    _train(store, spec, tiny_recipe(), run_dir)
    path = run_dir / "front" / FILE
    good = path.read_bytes()
    path.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    with pytest.raises(StoreError, match="checksum"):
        load_frame_encoder(run_dir, "front")
    write_shard(path, {"x": np.zeros(1, np.float32)}, {"format": "vilp-checkpoint-0"})
    with pytest.raises(StoreError, match="vilp-checkpoint-0"):
        load_frame_encoder(run_dir, "front")


def test_a_checkpoint_of_before_there_were_other_models_still_loads(
    store: EpisodeStore, spec: TaskSpec, run_dir: Path
) -> None:
    _train(store, spec, tiny_recipe(), run_dir)
    path = run_dir / "front" / FILE
    shard = read_shard(path)
    state = json.loads(shard.metadata["state"])
    for name in ("model", "contract", "built_by"):
        del state[name]
    header = {name: shard.metadata[name] for name in ("format", "recipe")} | {"state": json.dumps(state)}
    key = load_frame_encoder(run_dir, "front").key
    write_shard(path, dict(shard.arrays), header)
    assert load_frame_encoder(run_dir, "front").key == key
    assert (read_state(run_dir / "front") or pytest.fail("no state")).model == "vqgan"
    _train(store, spec, tiny_recipe(), run_dir)  # and is trained already
