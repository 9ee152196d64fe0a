"""Demonstrations of simulator states, drawn into logs: the pictures are those of the states, right side up, or there are none."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.real_data import real_data
from tests.synthetic import psnr, write_mcap
from vilp_data.decode import decode_image
from vilp_data.errors import LogError, UsageError
from vilp_data.recorder import EpisodeRecorder
from vilp_data.sims import render_demos
from vilp_data.sims.render_demos import DemoWorld, RenderOptions, render_demonstrations
from vilp_data.sources import open_log

DEMONSTRATIONS = "robosuite_demos/v1.0.1/robosuite/models/assets/demonstrations"


def write_states(path: Path, states: np.ndarray, actions: np.ndarray | None, **attributes: str) -> Path:
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_1")
        demo["states"] = states
        if actions is not None:
            demo["actions"] = actions
        file["data"].attrs.update(attributes)
    return path


def lift_info(**more: Any) -> str:
    return json.dumps({"env_name": "Lift", "robots": "Panda", **more})


# --- refused before anything is drawn ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [{"actions": np.zeros((4, 7))}])
def test_a_file_without_states_is_refused(tmp_path: Path, rows: dict[str, np.ndarray]) -> None:
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        file["data/demo_1/actions"] = rows["actions"]
    with pytest.raises(UsageError, match="no simulator states(.|\n)*found: actions"):
        render_demonstrations([tmp_path / "demo.hdf5"], tmp_path / "logs", RenderOptions())


def test_a_file_that_names_no_environment_is_refused(tmp_path: Path) -> None:
    path = write_states(tmp_path / "demo.hdf5", np.zeros((3, 32)), None, env_args="{not json")
    with pytest.raises(UsageError, match="environment is not named"):
        render_demonstrations([path], tmp_path / "logs", RenderOptions())


def test_a_log_of_another_format_is_refused(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "run.mcap")
    with pytest.raises(UsageError, match="not a file of simulator states(.|\n)*found: mcap"):
        render_demonstrations([log.path], tmp_path / "logs", RenderOptions())


def test_demonstrations_that_would_share_a_log_are_refused(tmp_path: Path) -> None:
    paths = [write_states(tmp_path / f"{n}.hdf5", np.full((3, 32), n), None, env_info=lift_info()) for n in range(2)]
    with pytest.raises(UsageError, match=r"Lift-demo_1\.mcap"):
        render_demonstrations(paths, tmp_path / "logs", RenderOptions())


def test_a_cut_off_file_is_refused(tmp_path: Path) -> None:
    path = write_states(tmp_path / "demo.hdf5", np.zeros((3, 32)), None, env_info=lift_info())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(LogError, match="cut off"):
        render_demonstrations([path], tmp_path / "logs", RenderOptions())


def test_a_model_outside_the_folder_is_not_read(tmp_path: Path) -> None:
    path = write_states(tmp_path / "demo.hdf5", np.zeros((3, 32)), None, env_info=lift_info())
    with h5py.File(path, "r+") as file:
        file["data/demo_1"].attrs["model_file"] = "../../secret.xml"
    with open_log(path) as log, pytest.raises(LogError, match="outside its own folder"):
        log.model_text("demo_1")  # type: ignore[attr-defined]


# --- what is there already --------------------------------------------------------------------------------------------------------


def lift_demo(path: Path, *, model: str = "<mujoco/>", **info: Any) -> Path:
    write_states(path, np.zeros((3, 32)), None, env_info=lift_info(**info))
    with h5py.File(path, "r+") as file:
        file["data/demo_1"].attrs["model_file"] = model
    return path


def drawn(path: Path, out: Path, **changed: str) -> Path:
    """A log as `render_demonstrations` leaves it, but for its pictures; `changed`: tags that another version wrote."""
    (job,) = render_demos._jobs(path, out, RenderOptions())
    tags = {**render_demos._tags(job, "Lift"), "success": "true", "n_steps": "3", **changed}
    with EpisodeRecorder(job.path, metadata=tags) as recorder:
        recorder.vector("/action", 1, [0.0])
    return job.path


def test_a_log_of_the_same_demonstration_is_kept(tmp_path: Path) -> None:
    path = lift_demo(tmp_path / "demo.hdf5")
    log = drawn(path, tmp_path / "logs")
    before = log.stat().st_mtime_ns
    (done,) = render_demonstrations([path], tmp_path / "logs", RenderOptions())
    assert (done.path, done.n_steps, done.success) == (log, 3, True)
    assert log.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"model": "<mujoco><worldbody/></mujoco>"}, "other world_sha256"),
        ({"robots": "Sawyer"}, "other world_sha256"),
        ({"mujoco_version": "3.2.0"}, "other mujoco_version: 3.2.0"),
        ({"robosuite_version": "1.4.0"}, "other robosuite_version: 1.4.0"),
    ],
)
def test_a_log_that_would_be_drawn_otherwise_now_is_refused(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    of_then = {name: text for name, text in change.items() if name.endswith("_version")}
    log = drawn(lift_demo(tmp_path / "demo.hdf5"), tmp_path / "logs", **of_then)
    path = lift_demo(tmp_path / "demo.hdf5", **{name: text for name, text in change.items() if name not in of_then})
    before = log.read_bytes()
    with pytest.raises(UsageError, match=says):
        render_demonstrations([path], tmp_path / "logs", RenderOptions())
    assert log.read_bytes() == before


@pytest.mark.parametrize("damage", ["cut off", "foreign"])
def test_a_damaged_or_foreign_file_is_not_overwritten(tmp_path: Path, damage: str) -> None:
    path = lift_demo(tmp_path / "demo.hdf5")
    log = drawn(path, tmp_path / "logs")
    log.write_bytes(log.read_bytes()[:-30] if damage == "cut off" else b"notes on lifting")
    before = log.read_bytes()
    with pytest.raises(UsageError, match="in the way"):
        render_demonstrations([path], tmp_path / "logs", RenderOptions())
    assert log.read_bytes() == before


# --- with the simulator -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lived(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, np.ndarray]:
    """A demonstration that was just recorded: its file, the states, and the pictures drawn meanwhile."""
    robosuite = pytest.importorskip("robosuite", reason="the simulators are not installed: make setup")
    from vilp_data.sims.record import require_simulator

    require_simulator(cameras=True)
    env = robosuite.make(
        "Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=True, use_camera_obs=False, control_freq=20
    )
    env.reset()
    env.sim._render_context_offscreen.vopt.sitegroup[:] = 0
    states, pictures = [], []
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 7))
    for action in actions:
        env.sim.forward()
        states.append(env.sim.get_state().flatten())
        pictures.append(env.sim.render(camera_name="agentview", height=64, width=80)[::-1].copy())
        env.step(action)
    env.close()
    path = tmp_path_factory.mktemp("lived") / "demo.hdf5"
    write_states(path, np.array(states), actions, env_info=lift_info(control_freq=20))
    return path, np.array(states), np.array(pictures)


@pytest.mark.sim
@pytest.mark.slow
def test_states_are_drawn_as_they_were_lived(lived: tuple[Path, np.ndarray, np.ndarray], tmp_path: Path) -> None:
    path, states, pictures = lived
    options = RenderOptions(height=64, width=80)
    (done,) = render_demonstrations([path], tmp_path, options)
    assert (done.path.name, done.n_steps, done.success) == ("Lift-demo_1.mcap", 6, False)
    with open_log(done.path) as log:
        drawn = [decode_image(message) for message in log.messages(["/camera/agentview/image"])]
        stored = [message.body.data for message in log.messages(["/sim/state"])]
        commanded = [message.log_time_ns for message in log.messages(["/action"])]
        assert log.metadata()["episode"]["task"] == "Lift"
    assert np.array_equal(stored, states)
    assert np.diff(commanded).tolist() == [50_000_000] * 5
    for row, one in enumerate(drawn):
        fits = [psnr(one, other) for other in pictures]
        assert np.argmax(fits) == row  # not the state before or after
        assert fits[row] > 33
        assert psnr(one[::-1], pictures[row]) < 20
    before = done.path.stat().st_mtime_ns
    render_demonstrations([path], tmp_path, options)
    assert done.path.stat().st_mtime_ns == before
    with pytest.raises(UsageError, match="made from something else"):
        render_demonstrations([path], tmp_path, RenderOptions(height=64, width=64))


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "says"),
    [("camera", "did you mean 'agentview'"), ("environment", "knows no such environment"), ("length", "31 numbers; robosuite")],
)  # fmt: skip
def test_what_cannot_be_drawn_leaves_no_log(
    lived: tuple[Path, np.ndarray, np.ndarray], tmp_path: Path, change: str, says: str
) -> None:
    states = lived[1][:, :31] if change == "length" else lived[1]
    info = lift_info() if change != "environment" else json.dumps({"env_name": "SawyerLift"})
    path = write_states(tmp_path / "demo.hdf5", states, None, env_info=info)
    options = RenderOptions(cameras=("agentveiw" if change == "camera" else "agentview",), height=32, width=32)
    with pytest.raises((UsageError, LogError), match=says):
        render_demonstrations([path], tmp_path / "logs", options)
    assert not list((tmp_path / "logs").glob("*"))


def built(**arguments: Any) -> DemoWorld:
    pytest.importorskip("robosuite", reason="the simulators are not installed: make setup")
    return DemoWorld("Lift", {"robots": "Panda", **arguments}, None, RenderOptions(height=32, width=32), where="demo")


@pytest.mark.sim
def test_a_world_has_the_grippers_and_the_table_of_its_recording() -> None:
    world = built(
        gripper_types="RethinkGripper", table_full_size=[0.4, 0.4, 0.05], control_freq=20, controller_configs={"type": "OSC_POSE"},
        reward_shaping=True, has_renderer=True, camera_names=["agentview"], env_version="1.4.1", type=1,
    )  # fmt: skip
    with contextlib.closing(world):
        assert type(world._env.robots[0].gripper["right"]).__name__ == "RethinkGripper"
        assert world._model.geom("table_collision").size.tolist() == [0.2, 0.2, 0.025]


@pytest.mark.sim
@pytest.mark.parametrize("arguments", [{"mount_types": "default"}, {"gripper_types": "Hook"}, {"table_full_size": [1]}])
def test_a_world_that_robosuite_cannot_build_is_refused_in_words(arguments: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=rf"cannot be built(.|\n)*{next(iter(arguments))}"):
        built(**arguments)


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("task", ["door", "lift"])
def test_real_demonstrations_end_in_success_with_the_hand_at_the_object(task: str, tmp_path: Path) -> None:
    """Only where the world stands as it stood then: the door was placed by chance, and no state holds its place."""
    pytest.importorskip("robosuite", reason="the simulators are not installed: make setup")
    source = real_data(f"{DEMONSTRATIONS}/{task}/panda/demo.hdf5")
    with open_log(source) as log:
        states = [message.body for message in log.messages(["states"])]
        text = log.model_text("demo_1")  # type: ignore[attr-defined]
    options = RenderOptions(height=32, width=32)
    world = DemoWorld({"door": "Door", "lift": "Lift"}[task], {"robots": "Panda"}, text, options, where=task)
    try:
        nearest_m = []
        for state in states[:: len(states) // 20]:
            world.show(state)
            model, data = world._model, world._data
            place = data.site("Door_handle").xpos if task == "door" else data.body("cube_main").xpos
            hand = data.site_xpos[world._env.robots[0].eef_site_id["right"]]
            nearest_m.append(float(np.linalg.norm(place - hand)))
        world.show(states[-1])
        assert world.is_success()
        assert min(nearest_m) < 0.07  # a hooked handle is grasped at its end
        assert not model.body("robot0_link0").pos.any()  # an arm stands on its own base
        if task == "door":
            assert model.body("Door_main").pos.tolist() == [-0.11807434694126376, -0.35614444625522773, 1.1]
    finally:
        world.close()
