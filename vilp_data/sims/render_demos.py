"""Demonstrations that hold simulator states and no pictures (robosuite's own, robomimic's raw ones), drawn into logs.

    t_k = t_0 + k / rate     the simulator is put into state k; cameras, joints, end effector and gripper are read, and action k is
                             written; all stamped t_k

The environment is built anew by the robosuite that is installed, with the recording's arguments of the world (arms, grippers, table,
bins, objects), and what stands still in it (tables, pegs, a door) is moved to where
the demonstration's own model has it. Where that robosuite knows no such environment, or its states have another length, the
demonstration is refused: a state put into another world would draw pictures of things that never happened.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from vilp_data import limits
from vilp_data.engine import map_unordered
from vilp_data.errors import LogError, UsageError, nearest
from vilp_data.recorder import NO_LATENCY, EpisodeRecorder
from vilp_data.sims.episode_log import START_NS
from vilp_data.sims.finished_log import finished_log
from vilp_data.sims.record import require_simulator
from vilp_data.sources import open_log
from vilp_data.sources.hdf5_log import Hdf5Log
from vilp_data.types import F64, U8

STATES, ACTIONS = "states", "actions"
CONTROL_RATE_HZ = 20.0  # robosuite's own, where a file does not state its rate
DRAWN_BY_CHANCE = {"Wipe": "its dirt lies elsewhere each time the environment is built, and no state says where"}
WORLD_FRAME = "world"
NOT_OF_THE_WORLD = re.compile(
    r"(has|render|renderer|camera|reward|use_(camera|object)|controller)_?\w*|control_freq|lite_physics|horizon|ignore_done|hard_reset|seed"
    r"|initialization_noise|placement_initializer|env_(name|version)|type"
)
"""Arguments of a recording that say how it was driven, looked at and begun, and nothing of what its states are states of."""


@dataclass(frozen=True)
class RenderOptions:
    """`cameras` by robosuite's names; images are height x width pixels; `rate_hz` stands in where a file states none."""

    cameras: tuple[str, ...] = ("agentview",)
    height: int = 96
    width: int = 96
    rate_hz: float = CONTROL_RATE_HZ


@dataclass(frozen=True)
class RenderedDemo:
    """A finished log: of `n_steps` ticks; `success` is what the environment says of the last state."""

    path: Path
    demonstration: str
    success: bool
    n_steps: int


@dataclass(frozen=True)
class _Job:
    source: Path
    demonstration: str
    sha256: str
    world_sha256: str
    path: Path
    options: RenderOptions


def render_demonstrations(
    sources: Sequence[Path], out: Path, options: RenderOptions, *, workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> list[RenderedDemo]:  # fmt: skip
    """Draw every demonstration of the HDF5 files into `out/<environment>-<demonstration>.mcap`.

    A finished log of the same states, world and options, drawn by the same versions, is kept. UsageError where a file holds no states,
    its environment or a camera is not known, the simulator is missing, or a file in `out` is of something else; LogError where a file
    is damaged."""
    jobs = [job for source in sources for job in _jobs(source, out, options)]
    if twice := [job for n, job in enumerate(jobs) if job.path in {other.path for other in jobs[:n]}]:
        raise UsageError(
            "two demonstrations would become one log",
            where=out,
            found=f"{twice[0].path.name}, of {twice[0].source} too",
            remedy="render one file at a time, each into a folder of its own",
        )
    done = {job.path: kept for job in jobs if (kept := _finished(job)) is not None}
    todo = [job for job in jobs if job.path not in done]
    if todo:
        require_simulator(cameras=True)
    if progress is not None:
        progress(len(done), len(jobs))
    with contextlib.closing(map_unordered(_render_one, todo, workers=min(workers, len(todo)))) as rendered:
        for job, demo in rendered:
            done[job.path] = demo
            if progress is not None:
                progress(len(done), len(jobs))
    return [done[job.path] for job in jobs]


def _jobs(source: Path, out: Path, options: RenderOptions) -> list[_Job]:
    with _open(source, options) as log:
        if STATES not in {topic.name for topic in log.topics()}:
            known = ", ".join(topic.name for topic in log.topics())
            remedy = "only files with simulator states can be drawn; one with images is a log already: ingest it"
            raise UsageError("no simulator states in this file", where=source, found=known, remedy=remedy)
        environment, arguments = _environment(log)
        return [
            _Job(source, episode.name, log.demonstration_sha256(episode.name),
                 _world_sha256(environment, arguments, log.model_text(episode.name)),
                 out / f"{limits.file_name(f'{environment}-{episode.name}')}.mcap", options)
            for episode in log.episodes()
        ]  # fmt: skip


def _open(source: Path, options: RenderOptions) -> Hdf5Log:
    log = open_log(source, array_rate_hz=options.rate_hz)
    if not isinstance(log, Hdf5Log):
        log.__exit__(None, None, None)
        remedy = "give an HDF5 file of robosuite or robomimic; other logs hold their pictures"
        raise UsageError("not a file of simulator states", where=source, found=log.format, remedy=remedy)
    return log


def _environment(log: Hdf5Log) -> tuple[str, dict[str, Any]]:
    """The name of the environment, and the arguments it was built with."""
    texts = log.metadata().get("data", {})
    for attribute in ("env_args", "env_info"):
        with contextlib.suppress(ValueError, RecursionError):
            table = json.loads(texts.get(attribute, ""))
            if isinstance(table, dict) and isinstance(table.get("env_name"), str):
                arguments = table.get("env_kwargs", table)
                return table["env_name"], arguments if isinstance(arguments, dict) else {}
    if "env" in texts:
        return texts["env"], {}
    found = f"attributes of data/: {', '.join(texts) or 'none'}"
    remedy = "the file must say which robosuite environment it is of, in env_args or env_info"
    raise UsageError("the environment is not named", where=log.path, found=found, remedy=remedy)


# --- one demonstration ----------------------------------------------------------------------------------------------------------


def _render_one(job: _Job) -> RenderedDemo:
    """Runs in a worker process: the simulator is imported here."""
    with _open(job.source, job.options) as log:
        name, arguments = _environment(log)
        (episode,) = (episode for episode in log.episodes() if episode.name == job.demonstration)
        have = {topic.name for topic in log.topics()}
        world = DemoWorld(
            name, arguments, log.model_text(job.demonstration), job.options, where=f"{job.source}, {episode.name}"
        )
        with contextlib.closing(world):
            topics = [STATES, *([ACTIONS] if ACTIONS in have else [])]
            with EpisodeRecorder(job.path, metadata=_tags(job, name)) as recorder:
                n_steps = 0
                for message in log.messages(topics, start_ns=episode.start_ns, end_ns=episode.end_ns):
                    stamp_ns = START_NS + message.log_time_ns - episode.start_ns
                    if message.topic == ACTIONS:
                        recorder.vector("/action", stamp_ns, message.body)
                        continue
                    world.show(message.body)
                    world.write_tick(recorder, stamp_ns, message.body)
                    n_steps += 1
                if not n_steps:
                    raise LogError(
                        "a demonstration without states", where=f"{job.source}, {episode.name}", remedy="leave it out"
                    )
                success = world.is_success()
                recorder.metadata.update(success=str(success).lower(), n_steps=str(n_steps))
    return RenderedDemo(job.path, job.demonstration, success, n_steps)


class DemoWorld:
    """A robosuite environment that is put into one stored state after another, and looked at; it never steps."""

    def __init__(
        self, name: str, arguments: dict[str, Any], model_text: str | None, options: RenderOptions, *, where: str
    ) -> None:
        self._where, self._options = where, options
        if name in DRAWN_BY_CHANCE:
            remedy = "leave this file out"
            raise UsageError(
                f"{name} cannot be drawn from its states", where=where, found=DRAWN_BY_CHANCE[name], remedy=remedy
            )
        self._env = _build(name, arguments, options, where)
        try:
            self._model, self._data = self._env.sim.model._model, self._env.sim.data._data
            self._check_cameras()
            _move_fixtures(self._model, model_text, where)
            context = self._env.sim._render_context_offscreen
            import mujoco

            context.vopt.sitegroup[:] = 0
            context.scn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0  # two to three times faster
        except BaseException:
            self._env.close()
            raise

    def show(self, state: F64) -> None:
        """Put the world into a stored state. LogError where it is one of another world."""
        expected = 1 + self._model.nq + self._model.nv
        if len(state) != expected:
            layout = f"time, {self._model.nq} positions, {self._model.nv} velocities"
            found = f"{len(state)} numbers; robosuite {version('robosuite')} has {layout}"
            raise LogError(
                "the states are not those of the environment that is installed",
                where=self._where,
                found=found,
                remedy="render it with the robosuite that recorded it, which the file names as repository_version",
            )
        if not np.isfinite(state).all():
            raise LogError("a state that is not finite", where=self._where, remedy="leave this demonstration out")
        self._env.sim.set_state_from_flattened(np.asarray(state, np.float64))
        self._env.sim.forward()

    def image(self, camera: str) -> U8:
        """uint8 [height,width,3] RGB, top row first."""
        upside_down = self._env.sim.render(camera_name=camera, height=self._options.height, width=self._options.width)
        return np.ascontiguousarray(upside_down[::-1], np.uint8)  # a copy: the renderer draws into its own buffer again

    def write_tick(self, log: EpisodeRecorder, stamp_ns: int, state: F64) -> None:
        """Cameras, the state, and of every arm its joints, end effector (in the world's frame) and gripper."""
        for camera in self._options.cameras:
            log.image(
                f"/camera/{camera}/image", stamp_ns, self.image(camera), frame_id=f"camera_{camera}", latency=NO_LATENCY
            )
        log.vector("/sim/state", stamp_ns, state)
        for robot in self._env.robots:
            for arm in robot.arms:
                self._write_arm(log, stamp_ns, robot, arm)

    def is_success(self) -> bool:
        return bool(self._env._check_success())

    def close(self) -> None:
        self._env.close()

    def _write_arm(self, log: EpisodeRecorder, stamp_ns: int, robot: Any, arm: str) -> None:
        prefix = f"/robot{robot.idn}" + ("" if len(robot.arms) == 1 else f"/{arm}")
        for topic, joints in (("joint_states", robot.robot_joints), ("gripper/state", robot.gripper_joints[arm])):
            names = [joint for joint in joints if joint]
            position = [self._env.sim.data.get_joint_qpos(joint) for joint in names]
            velocity = [self._env.sim.data.get_joint_qvel(joint) for joint in names]
            if names:
                log.joint_state(f"{prefix}/{topic}", stamp_ns, names, position, velocity, latency=NO_LATENCY)
        site = robot.eef_site_id[arm]
        rotation = self._data.site_xmat[site].reshape(9)
        log.pose(
            f"{prefix}/ee_pose", stamp_ns, self._data.site_xpos[site], _quaternion_xyzw(rotation), frame_id=WORLD_FRAME,
            latency=NO_LATENCY,
        )  # fmt: skip

    def _check_cameras(self) -> None:
        known = [self._model.camera(n).name for n in range(self._model.ncam)]
        for camera in self._options.cameras:
            if camera not in known:
                raise UsageError(f"no camera called {camera!r}", where=self._where, remedy=nearest(camera, known))


def _build(name: str, arguments: dict[str, Any], options: RenderOptions, where: str) -> Any:
    import robosuite

    known = set(robosuite.ALL_ENVIRONMENTS)
    if name not in known:
        found = f"{name!r}; robosuite {version('robosuite')} has {', '.join(sorted(known))}"
        remedy = "leave it out: versions before 1.0 named robots in their environments, and their meshes are no longer shipped"
        raise UsageError("the installed simulator knows no such environment", where=where, found=found, remedy=remedy)
    world = {key: value for key, value in arguments.items() if not NOT_OF_THE_WORLD.fullmatch(key)}
    robots = world.pop("robots", "Panda")
    try:
        env = robosuite.make(
            name, robots=robots, has_renderer=False, has_offscreen_renderer=True, use_camera_obs=False, ignore_done=True,
            hard_reset=False, camera_heights=options.height, camera_widths=options.width, **world,
        )  # fmt: skip
        env.reset()
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, AssertionError) as error:
        built_of = "".join(f", {key} {value!r}" for key, value in world.items())
        found = f"{name} with {robots}{built_of}: {str(error) or repr(error)}"
        remedy = "render it with the robosuite that recorded it"
        raise UsageError("the environment cannot be built", where=where, found=found, remedy=remedy) from error
    return env


def _move_fixtures(model: Any, model_text: str | None, where: str) -> None:
    """Put what stands in the world without a joint to where the demonstration's own model has it: no state holds its place."""
    import mujoco

    if model_text is None:
        return
    # Only what hangs from the world here too: an arm's first link once did, and hangs from the robot's base now.
    names = {model.body(number).name: number for number in range(1, model.nbody) if model.body_parentid[number] == 0}
    free = {
        model.jnt_bodyid[number] for number in range(model.njnt) if model.jnt_type[number] == mujoco.mjtJoint.mjJNT_FREE
    }
    for name, position, quaternion in _stored_fixtures(model_text, where):
        places = [names[alias] for alias in _aliases(name) if alias in names]
        if not places or places[0] in free:
            continue
        model.body_pos[places[0]] = position
        if quaternion is not None:
            model.body_quat[places[0]] = quaternion


def _stored_fixtures(model_text: str, where: str) -> list[tuple[str, F64, F64 | None]]:
    """Name, place [3] m and orientation [4] (w, x, y, z; None: not stated) of each body that hangs from the world."""
    try:
        world = ElementTree.fromstring(model_text).find("worldbody")
        bodies = [] if world is None else world.findall("body")
        return [
            (body.get("name", ""), _numbers(body.get("pos", "0 0 0"), 3),
             None if "quat" not in body.attrib else _numbers(body.attrib["quat"], 4))
            for body in bodies
        ]  # fmt: skip
    except (ElementTree.ParseError, ValueError) as error:
        remedy = "copy the demonstration again, its models/ folder too"
        raise LogError("the stored model cannot be read", where=where, found=str(error), remedy=remedy) from error


def _aliases(name: str) -> tuple[str, ...]:
    """What robosuite calls a body now: version 1.3 renamed objects' roots and robots' bases."""
    return name, f"{name}_main", name.replace("_link0", "_base")


def _numbers(text: str, count: int) -> F64:
    values = np.array(text.split(), np.float64)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{text!r} is not {count} numbers")
    return values


def _quaternion_xyzw(rotation: F64) -> F64:
    """A row-major rotation matrix [9] as a quaternion (x, y, z, w), w >= 0."""
    import mujoco

    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, rotation)
    wxyz *= -1.0 if wxyz[0] < 0 else 1.0
    return wxyz[[1, 2, 3, 0]]


# --- what a log says of itself ----------------------------------------------------------------------------------------------------


def _made_from(job: _Job) -> dict[str, str]:
    """Tags that tell whether the same pictures would be drawn again: states, world, options, and what draws them."""
    options = {"cameras": job.options.cameras, "size": [job.options.height, job.options.width]}
    return {
        "demonstration_sha256": job.sha256,
        "world_sha256": job.world_sha256,
        "options": json.dumps({**options, "rate_hz": job.options.rate_hz}),
        **{f"{name}_version": _version(name) for name in ("vilp", "robosuite", "mujoco")},
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _world_sha256(environment: str, arguments: dict[str, Any], model_text: str | None) -> str:
    """Of what the world is built from, beside the simulator."""
    return hashlib.sha256(json.dumps([environment, arguments, model_text], sort_keys=True).encode()).hexdigest()


def _tags(job: _Job, environment: str) -> dict[str, str]:
    return {
        "task": environment,
        "source_file": job.source.name,
        "demonstration": job.demonstration,
        **_made_from(job),
    }


def _finished(job: _Job) -> RenderedDemo | None:
    """The log that is there already; UsageError where it was drawn from something else, or is no log that can be read."""
    try:
        finished = finished_log(job.path, _made_from(job))
    except LogError as error:
        remedy = "move it away, or render into another folder: logs of this command appear whole or not at all"
        raise UsageError(
            "a damaged or foreign file is in the way", where=job.path, found=error.what, remedy=remedy
        ) from error
    if finished is None:
        return None
    tags = finished.tags
    return RenderedDemo(job.path, job.demonstration, tags.get("success") == "true", int(tags.get("n_steps", 0)))
