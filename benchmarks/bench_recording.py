"""Recording a robosuite task: this recorder against rendering at every control step with robosuite's default settings, in one run.

    python benchmarks/bench_recording.py [TASK ...] [--steps 10] [--rounds 3]

Both play the expert's first actions from the same start, at the same image size; a step is two control steps (20 Hz). Seconds of a core for
one step, drawn in software (what a GPU draws would not be counted):

    recorder         what `vilp-data record` does: the task's views once a step, without reflections, and all of the log written
    logged cameras   the task's views at every control step, as robosuite draws by default: with reflections, in a buffer of 640x480
    every camera     the same of all cameras that the model has, robosuite's own and the wrist's among them

In the last two nothing is written and nothing observed but images, and things that the task does not use are left out of their world too:
robosuite's own loop does more. They take turns; every time, and every ratio of two times of one round, is the median over the rounds.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import mujoco

import pipelines
from vilp_data.recorder import EpisodeRecorder
from vilp_data.sims import ENVIRONMENTS, load_entry_point
from vilp_data.sims.episode_log import START_NS, tick_writer
from vilp_data.sims.record import RECORDABLE
from vilp_data.spec import TaskSpec
from vilp_data.task_toml import load_task
from vilp_data.types import F32, F64

DEFAULT_BUFFER = (640, 480)  # width, height


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help="all that robosuite simulates, without any")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    print(f"seconds of a core for a step of 0.1 s, medians of {arguments.rounds} rounds of {arguments.steps} steps")
    print(f"{'task':16}{'recorder':>10}{'logged cameras':>24}{'every camera':>30}")
    for task in arguments.tasks or robosuite_tasks():
        compare(load_task(task), arguments.steps, arguments.rounds)


def robosuite_tasks() -> list[str]:
    found = []
    for path in sorted(Path(next(iter(pipelines.__path__))).glob("*.toml")):
        spec = load_task(path.stem)
        if spec.sim is not None and "robosuite" in RECORDABLE[spec.sim.env].packages:
            found.append(spec.name)
    return found


def compare(spec: TaskSpec, n_steps: int, n_rounds: int) -> None:
    assert spec.sim is not None
    env = load_entry_point(ENVIRONMENTS[spec.sim.env])(**spec.sim.options)
    state, actions = demonstration(spec, env, n_steps)
    every = [env.scene.sim.model.camera_id2name(camera) for camera in range(env.scene.sim.model.ncam)]
    logged = [camera if isinstance(camera, str) else view for view, camera in env.scene.cameras.items()]
    rounds = []
    for _ in range(n_rounds):
        ours = recorded(spec, env, state, actions)
        rounds.append((ours, drawn(env, state, actions, logged), drawn(env, state, actions, every)))
    env.close()
    ours, by_view, by_camera = (statistics.median(column) / len(actions) for column in zip(*rounds, strict=True))
    gains = [statistics.median(one[way] / one[0] for one in rounds) for way in (1, 2)]
    print(
        f"{spec.name:16}{ours:10.3f}{by_view:10.3f}, {gains[0]:4.1f} x ({len(logged)})"
        f"{by_camera:16.3f}, {gains[1]:4.1f} x ({len(every)})",
        flush=True,
    )


def demonstration(spec: TaskSpec, env: Any, n_steps: int) -> tuple[F64, list[F32]]:
    """A start, and the expert's first actions from it."""
    assert spec.sim is not None
    _, info = env.reset(seed=0)
    state, actions = info["state"], []
    for action in islice(load_entry_point(RECORDABLE[spec.sim.env].expert)(env, seed=0).actions(), n_steps):
        env.step(action)
        actions.append(action)
    return state, actions


def recorded(spec: TaskSpec, env: Any, state: F64, actions: Sequence[F32]) -> float:
    """Seconds that the recorder's own loop takes, from the first step on."""
    env.scene.sim._render_context_offscreen.update_offscreen_size(env.width, env.height)
    observation, info = env.reset(options={"state": state})
    write = tick_writer(spec, env)
    tick_ns = round(1e9 / env.metadata["render_fps"])
    with tempfile.TemporaryDirectory(prefix="vilp-bench-") as folder:
        started = time.process_time()
        with EpisodeRecorder(Path(folder) / "log.mcap", metadata={}, seed=0) as log:
            for tick, action in enumerate(actions):
                write(log, START_NS + tick * tick_ns, observation, info, action)
                observation, *_, info = env.step(action)
        return time.process_time() - started


def drawn(env: Any, state: F64, actions: Sequence[F32], cameras: Sequence[str]) -> float:
    """Seconds that the same actions take when these cameras are drawn at every control step, as robosuite does."""
    env.reset(options={"state": state})
    scene, context = env.scene, env.scene.sim._render_context_offscreen
    context.update_offscreen_size(*DEFAULT_BUFFER)
    context.scn.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 1  # until the next reset
    started = time.process_time()
    for action in actions:
        for _ in range(2):
            scene.step(action / env.action_space.high)
            for camera in cameras:
                scene.sim.render(width=env.width, height=env.height, camera_name=camera)
    return time.process_time() - started


if __name__ == "__main__":
    main()
