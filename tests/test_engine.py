"""Work over processes: every item once, no worker without its parent, and words where a worker is killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from vilp_data.engine import map_unordered
from vilp_data.errors import VilpDataError

ROOT = Path(__file__).resolve().parent.parent


def square(number: int) -> int:
    return number * number


def say_pid_and_wait(folder: str) -> None:
    """Leave a file named after this process, then wait; an interrupt is told by a second file."""
    said = Path(folder) / str(os.getpid())
    said.touch()
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        said.with_suffix(".interrupted").touch()
        raise


def die(signal_number: int) -> None:
    os.kill(os.getpid(), signal_number)


def wait_for_parent(folder: str) -> None:
    """A worker on a system without prctl: only the watching thread ends it."""
    from vilp_data import engine

    engine.sys = type("other", (), {"platform": "darwin"})  # type: ignore[assignment]
    engine._die_with_parent(os.getppid())
    say_pid_and_wait(folder)


def wait_for_parent_without_prctl(folder: str) -> None:
    process = multiprocessing.get_context("spawn").Process(target=wait_for_parent, args=(folder,))
    process.start()
    process.join()


def alive(pid: int) -> bool:
    """Whether a process runs. A zombie, which nobody has waited for yet, does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def start(code: str, folder: Path, workers: int) -> tuple[subprocess.Popen[str], list[int]]:
    """Run Python code in a process group of its own until `workers` processes have said their ids in `folder`."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 60
    while len(list(folder.iterdir())) < workers and time.monotonic() < deadline:
        time.sleep(0.01)
    pids = [int(path.name) for path in folder.iterdir()]
    assert len(pids) == workers
    return process, pids


def assert_all_end(pids: list[int], within_s: float = 3.0) -> None:
    deadline = time.monotonic() + within_s
    while any(map(alive, pids)) and time.monotonic() < deadline:
        time.sleep(0.02)
    left = [pid for pid in pids if alive(pid)]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left


@pytest.mark.parametrize("workers", [1, 2])
def test_every_item_comes_back_once_with_its_result(workers: int) -> None:
    results = list(map_unordered(square, range(7), workers=workers))
    assert sorted(results) == [(n, n * n) for n in range(7)]


TWO_WORKERS = """
import sys
from tests.test_engine import say_pid_and_wait
from vilp_data.engine import map_unordered
list(map_unordered(say_pid_and_wait, [sys.argv[1]] * 4, workers=2))
"""

WATCHING_THREAD = """
import sys
from tests.test_engine import wait_for_parent_without_prctl
wait_for_parent_without_prctl(sys.argv[1])
"""


@pytest.mark.parametrize(("code", "workers"), [(TWO_WORKERS, 2), (WATCHING_THREAD, 1)], ids=["prctl", "thread"])
def test_workers_end_when_their_parent_is_killed(tmp_path: Path, code: str, workers: int) -> None:
    parent, pids = start(code, tmp_path, workers)
    parent.kill()
    parent.wait()  # and not for its pipes, which an orphan would hold open
    assert_all_end(pids)
    parent.communicate()


def test_ctrl_c_ends_parent_and_workers_at_once_and_only_the_parent_speaks(tmp_path: Path) -> None:
    parent, pids = start(TWO_WORKERS, tmp_path, 2)
    for pid in pids:
        os.kill(pid, signal.SIGINT)
    time.sleep(0.3)
    assert len(list(tmp_path.iterdir())) == 2
    assert all(map(alive, pids))
    os.killpg(parent.pid, signal.SIGINT)
    _, error = parent.communicate(timeout=20)
    assert_all_end(pids)
    assert error.count("KeyboardInterrupt") == 1, error
    assert "Process Spawn" not in error


def test_a_killed_worker_is_said_in_words() -> None:
    with pytest.raises(VilpDataError, match="fewer --workers"):
        list(map_unordered(die, [signal.SIGKILL] * 2, workers=2))


def test_a_caller_that_stops_listening_leaves_no_worker(tmp_path: Path) -> None:
    before = set(multiprocessing.active_children())
    with closing(map_unordered(time.sleep, [0.0, 60.0, 60.0], workers=2)) as results:
        next(results)
    assert not set(multiprocessing.active_children()) - before


def wait_with_a_semaphore(folder: str) -> None:
    """What a library that locks across processes leaves in a worker: numcodecs, when a zarr store is read."""
    lock = multiprocessing.get_context("spawn").Lock()
    say_pid_and_wait(folder)
    del lock


def wait_unasked(folder: str) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # as in a long call into a library
    say_pid_and_wait(folder)


@pytest.mark.parametrize("function", [wait_with_a_semaphore, wait_unasked])
def test_ctrl_c_leaves_no_semaphore_and_no_worker(tmp_path: Path, function: Callable[[str], None]) -> None:
    code = TWO_WORKERS.replace("say_pid_and_wait", function.__name__)
    parent, pids = start(code, tmp_path, 2)
    os.killpg(parent.pid, signal.SIGINT)
    _, error = parent.communicate(timeout=20)
    assert_all_end(pids)
    assert "leaked" not in error
    assert error.count("KeyboardInterrupt") == 1, error
