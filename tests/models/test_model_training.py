"""Training of any module with a loss: order, averages, resuming, several processes, curves."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.models.conftest import card_frames, tiny_recipe
from tests.models.tiny_training import Plane, PointDataset, fit_to, in_two_processes, killed_at, plane_training
from vilp_data.errors import UsageError
from vilp_data.loader import batch_numbers
from vilp_models.checkpoint import Arrays, load_checkpoint, read_state
from vilp_models.curves import FOLDER, Curves, gif
from vilp_models.model_training import BatchesInOrder, ModelTraining, step_seed
from vilp_models.optimisation import DivergedError
from vilp_models.processes import Processes
from vilp_models.training_state import arrays_of
from vilp_models.vqgan_training import VqganTraining


def _bytes(saved: tuple[Arrays, Arrays]) -> dict[str, bytes]:
    return {f"{i}/{name}": array.tobytes() for i, part in enumerate(saved) for name, array in part.items()}


def _saved(run: Path) -> dict[str, bytes]:
    checkpoint = load_checkpoint(run)
    return _bytes((checkpoint.model, checkpoint.trainer))


def test_a_module_learns() -> None:
    training = plane_training(steps=300)
    losses = [training.step(index)["fit"].item() for index in range(300)]
    training.close()
    assert np.mean(losses[-10:]) < 0.1 * np.mean(losses[:10])


def test_step_i_sees_the_batch_of_seed_and_i_alone() -> None:
    dataset, processes = PointDataset(20), Processes(device="cpu")
    recipe = plane_training(seed=3).recipe
    batches = BatchesInOrder(dataset, recipe, processes)
    in_order = [batches.of_step(index).number.tolist() for index in range(6)]
    batches.close()
    expected = [batch_numbers(20, batch_size=8, seed=3, epoch=i // 2, step=i % 2).tolist() for i in range(6)]
    assert in_order == expected
    other = BatchesInOrder(dataset, recipe, processes)
    assert other.of_step(3).number.tolist() == expected[3]
    other.close()


@pytest.mark.parametrize("changes", [{}, {"ema_max": 0.0}, {"precision": "bf16"}])
def test_killing_and_resuming_gives_the_same_bits(tmp_path: Path, changes: dict[str, object]) -> None:
    fit_to(tmp_path / "whole", plane_training(**changes), 12)
    cut = tmp_path / "cut"
    trainee = plane_training(**changes)
    killed_at(5, trainee, lambda: fit_to(cut, trainee, 12, checkpoint_every_s=0.0))
    state = read_state(cut)
    assert state is not None
    assert state.step == 5
    fit_to(cut, plane_training(**changes), 12)
    assert _saved(cut) == _saved(tmp_path / "whole")


def test_killing_and_resuming_a_vqgan_gives_the_same_bits(tmp_path: Path) -> None:
    recipe = tiny_recipe(steps=12, codebook_start=3)
    fit_to(tmp_path / "whole", VqganTraining(recipe, card_frames()), 12)
    trainee, cut = VqganTraining(recipe, card_frames()), tmp_path / "cut"
    killed_at(5, trainee, lambda: fit_to(cut, trainee, 12, checkpoint_every_s=0.0))
    fit_to(cut, VqganTraining(recipe, card_frames()), 12)
    assert _saved(cut) == _saved(tmp_path / "whole")


@pytest.mark.slow
def test_killing_at_any_step_and_resuming_gives_the_same_bits(tmp_path: Path) -> None:
    fit_to(tmp_path / "whole", plane_training(), 12)
    for step in range(12):
        cut, trainee = tmp_path / str(step), plane_training()
        killed_at(step, trainee, lambda cut=cut, trainee=trainee: fit_to(cut, trainee, 12, checkpoint_every_s=0.0))
        fit_to(cut, plane_training(), 12)
        assert _saved(cut) == _saved(tmp_path / "whole")


def test_others_load_the_average_of_the_weights() -> None:
    training = plane_training(ema_max=0.5)
    expected = None
    for index in range(6):
        training.step(index)
        decay = min(0.5, 1 - (1 + index) ** -0.75)
        now = training.module.hidden.weight.detach().clone()
        expected = now if expected is None else decay * expected + (1 - decay) * now
    training.close()
    model, trainer = training.save()
    assert expected is not None
    np.testing.assert_allclose(model["hidden.weight"], expected.numpy(), rtol=1e-5)
    np.testing.assert_array_equal(trainer["weights/hidden.weight"], training.module.hidden.weight.detach().numpy())
    assert model["offset"] == 0.5


def test_clips_are_drawn_by_the_average_and_change_nothing() -> None:
    seen = []

    def draw(module: torch.nn.Module) -> dict[str, np.ndarray]:
        assert not module.training
        seen.append(module.hidden.weight.detach().clone().numpy())
        return {"clip": np.zeros((2, 4, 4, 3), np.uint8)}

    recipe = plane_training().recipe
    training = ModelTraining(recipe, Plane, PointDataset(), Processes(device="cpu"), clips=draw)
    training.step(0)
    training.step(1)
    before = _bytes(training.save())
    assert set(training.clips()) == {"clip"}
    training.close()
    np.testing.assert_array_equal(seen[0], training.save()[0]["hidden.weight"])
    assert _bytes(training.save()) == before
    assert training.module.training


def test_norms_and_biases_do_not_decay() -> None:
    training = plane_training(weight_decay=0.1)
    decays = {group["weight_decay"]: len(group["params"]) for group in training.optimizer.param_groups}
    assert decays == {0.1: 2, 0.0: 4}


def test_what_is_not_finite_is_never_saved(tmp_path: Path) -> None:
    trainee = plane_training()
    fit_to(tmp_path, trainee, 3)
    good = _saved(tmp_path)
    broken = plane_training()
    step = broken.step

    def overflow(index: int) -> dict[str, torch.Tensor]:
        losses = step(index)
        return {**losses, "gradient_norm": losses["gradient_norm"] * float("inf")} if index == 4 else losses

    broken.step = overflow  # type: ignore[method-assign]
    with pytest.raises(DivergedError, match="an earlier step"):
        fit_to(tmp_path, broken, 12, checkpoint_every_s=1e9)
    assert _saved(tmp_path) == good
    with pytest.raises(DivergedError):  # the same where a checkpoint is due right after that step
        fit_to(tmp_path, broken, 12, checkpoint_every_s=0.0)
    kept = load_checkpoint(tmp_path)
    assert kept.state.step == 4
    assert all(np.isfinite(array).all() for array in kept.model.values())


def test_a_batch_larger_than_the_dataset_is_refused() -> None:
    with pytest.raises(UsageError, match="not one whole batch"):
        plane_training(batch_size=64)


def test_seeds_of_steps_differ_in_the_bits_that_torch_takes() -> None:
    seeds = {step_seed(0, index, rank) & 0xFFFFFFFF for index in range(500) for rank in range(2)}
    assert len(seeds) == 1000


def test_two_processes_hold_the_same_weights_as_one(tmp_path: Path) -> None:
    def task(processes: Processes) -> dict[str, np.ndarray]:
        run, training = tmp_path / "run", plane_training(processes, noise=0.0)
        fit_to(run, training, 12, processes)
        return training.save()[0]

    first, second = in_two_processes(task, tmp_path)
    alone = plane_training(noise=0.0)
    for index in range(12):
        alone.step(index)
    alone.close()
    for name, array in alone.save()[0].items():
        np.testing.assert_array_equal(first[name], second[name])
        np.testing.assert_allclose(first[name], array, rtol=1e-4, atol=1e-6)
    assert load_checkpoint(tmp_path / "run").state.finished


def test_two_processes_train_the_same_vqgan(tmp_path: Path) -> None:
    recipe = tiny_recipe(codebook_start=1, discriminator_weight=0.8, discriminator_start=2, restart_every=3)

    def task(processes: Processes) -> dict[str, np.ndarray]:
        training = VqganTraining(recipe, card_frames(), processes)
        for index in range(4):
            training.step(index)
        return {**training.save()[0], "uses": training.uses.numpy()}

    first, second = in_two_processes(task, tmp_path)
    for name, array in first.items():
        np.testing.assert_array_equal(array, second[name])


def _steps(run: Path, tag: str) -> list[int]:
    events = EventAccumulator(str(run / FOLDER))
    events.Reload()
    return [event.step for event in events.Scalars(tag)]


def test_curves_of_a_resumed_run_have_every_step_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vilp_models.training_loop.READ_EVERY", 1)
    trainee = plane_training()
    killed_at(9, trainee, lambda: fit_to(tmp_path, trainee, 12, checkpoint_every_s=0.0))
    time.sleep(1.1)  # TensorBoard reads files in the order of the seconds in their names
    curves = Curves(tmp_path, first=9)  # went on, wrote two steps and a half, and was killed again
    curves.scalars(10, {"loss/fit": 7.0})
    curves.scalars(11, {"loss/fit": 7.0})
    curves.close()
    time.sleep(1.1)
    fit_to(tmp_path, plane_training(), 12)
    assert _steps(tmp_path, "loss/fit") == list(range(1, 13))


def test_clips_are_animated(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (5, 8, 12, 3), np.uint8)
    curves = Curves(tmp_path, first=0)
    curves.clips(3, {"clip": frames})
    curves.close()
    events = EventAccumulator(str(tmp_path / FOLDER), size_guidance={"images": 0})
    events.Reload()
    (event,) = events.Images("clip")
    assert (event.step, event.width, event.height) == (3, 12, 8)
    assert event.encoded_image_string == gif(frames)
    assert event.encoded_image_string.startswith(b"GIF89a")


def test_what_was_saved_stays_while_training_goes_on() -> None:
    tensors = {"weight": torch.zeros(3), "turned": torch.zeros(2, 3).t(), "step": torch.zeros(())}
    arrays = arrays_of(tensors)
    for tensor in tensors.values():
        tensor += 1
    assert all(not array.any() for array in arrays.values())


def test_the_device_that_is_named_is_the_one() -> None:
    assert Processes(device="cuda:1").device == torch.device("cuda:1")
    assert Processes(device="cpu").device == torch.device("cpu")
