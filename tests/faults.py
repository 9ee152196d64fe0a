"""kill -9 at a chosen moment of a writer's work, and what a folder then holds."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent

# Before a process's n-th call of one of these it kills itself: the moments at which what is on disk changes.
WRITES = ("fsync", "rename", "replace")
ALL_CHANGES = (*WRITES, "unlink", "link", "rmdir")
KILLER = """
import os, signal
_calls = 0
def _dying(function):
    def wrapped(*args, **kwargs):
        global _calls
        _calls += 1
        if _calls == {nth}:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)
    return wrapped
for _name in {names}:
    setattr(os, _name, _dying(getattr(os, _name)))
"""


def kill_moments(*, few: int, many: int) -> list[Any]:
    """Which fsync or rename to die before: `few` spread over the first `many` by default, all of them when slow."""
    chosen = {1 + i * many // few for i in range(few)}
    return [pytest.param(n, marks=() if n in chosen else pytest.mark.slow, id=f"kill-{n}") for n in range(1, many + 1)]


def run_until_killed(code: str, arguments: list[str], *, nth: int, names: Sequence[str] = WRITES) -> bool:
    """Run Python code in a process that is killed at its n-th call of a function of `os` of these names; False where it ended before
    that."""
    program = textwrap.dedent(KILLER.format(nth=nth, names=tuple(names))) + code
    ended = subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode in (0, -9), ended.stderr
    return ended.returncode == -9


def call_until_killed(
    function: Callable[..., None], *arguments: object, nth: int, names: Sequence[str] = ALL_CHANGES
) -> bool:
    """As `run_until_killed`, for a function of a test module: its process is forked from one that has imported the module already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([function.__module__])
    process = context.Process(target=_call_dying, args=(nth, tuple(names), function, arguments))
    process.start()
    process.join()
    assert process.exitcode in (0, -9)
    return process.exitcode == -9


def _call_dying(nth: int, names: Sequence[str], function: Callable[..., None], arguments: Sequence[object]) -> None:
    exec(KILLER.format(nth=nth, names=names), {})
    function(*arguments)


def kill_after(count: int, patch: pytest.MonkeyPatch) -> None:
    """End an ingest in this process, as Ctrl-C does, once it has dealt with `count` demonstrations."""
    from vilp_data import ingest

    whole, done = ingest._ingest_one, iter(range(count))

    def dying(*arguments: Any) -> Any:
        if next(done, None) is None:
            raise KeyboardInterrupt
        return whole(*arguments)

    patch.setattr(ingest, "_ingest_one", dying)


def run_until_files(code: str, arguments: list[str], *, folder: Path, count: int) -> bool:
    """Run Python code in a process that is killed once `count` files lie below `folder`; False where it ended before that.

    For work that several processes share: none of them knows how far the others are."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    while process.poll() is None and len(list(folder.rglob("*.safetensors"))) < count:
        time.sleep(0.001)
    process.kill()
    error = process.communicate()[1]
    assert process.returncode in (0, -9), error
    return process.returncode == -9


def tree(root: Path) -> dict[str, bytes]:
    """Every file below a folder with its bytes; hidden ones left out (the lock, what is remembered of logs elsewhere), and the history,
    which says when and by which command."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.name.startswith(".") and "history" not in path.relative_to(root).parts
    }
