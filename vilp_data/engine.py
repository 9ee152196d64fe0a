"""Map independent work over the processes of one machine."""

from __future__ import annotations

import ctypes
import multiprocessing
import multiprocessing.util
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from vilp_data.errors import VilpDataError

Item = TypeVar("Item")
Result = TypeVar("Result")

PATIENCE_S = 2.0
"""How long a worker that is told to end may take: a call into a library is not broken off."""

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def cpu_count() -> int:
    """Cores this process may run on (containers and taskset included)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_unordered(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int,
    initializer: Callable[..., None] | None = None,
    initargs: tuple[Any, ...] = (),
) -> Generator[tuple[Item, Result], None, None]:
    """Yield (item, function(item)) as each finishes; the first exception is raised here and cancels what has not begun.

    `function` and `items` must be picklable by reference (module-level functions, plain data): workers are spawned, never
    forked, since forked copies of threads that hold locks hang. With `workers` <= 1 all runs in this process.

    Workers never outlive this process, however it ends, and leave Ctrl-C to it: a caller that holds a lock for them closes the
    generator (`contextlib.closing`) before it lets go of the lock. Raises VilpDataError where a worker is killed from outside.
    """
    if not items:
        return
    if workers <= 1:
        if initializer is not None:
            initializer(*initargs)
        for item in items:
            yield item, function(item)
        return
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        min(workers, len(items)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(os.getpid(), initializer, initargs),
    )
    try:
        pending = _submit(pool, function, items)
        while pending:
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield pending.pop(future), future.result()
    except BrokenProcessPool as error:
        raise VilpDataError(
            "a worker process was killed, probably because memory ran out",
            remedy="run it again with fewer --workers: what was finished is kept",
        ) from error
    except (KeyboardInterrupt, GeneratorExit):  # nobody waits for the rest, and every write is whole or not there
        _end(set(multiprocessing.active_children()) - others)
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _submit(
    pool: ProcessPoolExecutor, function: Callable[[Item], Result], items: Sequence[Item]
) -> dict[Future[Result], Item]:
    """Submit everything. The workers that this starts inherit a blocked SIGINT: Ctrl-C reaches every process of the terminal,
    and only the parent should answer it, even while a worker is still importing."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return {pool.submit(function, item): item for item in items}
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end(workers: set[BaseProcess]) -> None:
    """End worker processes: asked to, so that they give back the named semaphores of the libraries they use; after PATIENCE_S by force."""
    for worker in workers:
        worker.terminate()
    deadline = time.monotonic() + PATIENCE_S
    for worker in workers:
        worker.join(max(deadline - time.monotonic(), 0.0))
        if worker.is_alive():
            worker.kill()


def _start_worker(parent: int, initializer: Callable[..., None] | None, initargs: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGTERM, _leave)
    _die_with_parent(parent)
    if initializer is not None:
        initializer(*initargs)


def _leave(signal_number: int, frame: object) -> None:
    """End this worker where it stands, past the pool, which would take an exception for the outcome of its item and begin the next."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    multiprocessing.util._exit_function()  # type: ignore[attr-defined]  # what the end of a process runs: gives the semaphores back
    os._exit(128 + signal_number)


def _die_with_parent(parent: int) -> None:
    """End this process when its parent ends, `kill -9` included: the parent's lock ends with it, and nobody may write without."""
    if sys.platform != "linux" or ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL) != 0:
        threading.Thread(target=_kill_after_parent, name="watch-parent", daemon=True).start()
    elif os.getppid() != parent:  # it ended before the kernel was told
        os.kill(os.getpid(), signal.SIGKILL)


def _kill_after_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os.kill(os.getpid(), signal.SIGKILL)
