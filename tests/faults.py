"""kill -9 at a chosen moment of a writer's work, and what a folder then holds."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent

# Before a process's n-th call of fsync or rename it kills itself: the moments at which what is on disk changes.
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
os.fsync, os.rename, os.replace = _dying(os.fsync), _dying(os.rename), _dying(os.replace)
"""


def kill_moments(*, few: int, many: int) -> list[Any]:
    """Which fsync or rename to die before: `few` spread over the first `many` by default, all of them when slow."""
    chosen = {1 + i * many // few for i in range(few)}
    return [pytest.param(n, marks=() if n in chosen else pytest.mark.slow, id=f"kill-{n}") for n in range(1, many + 1)]


def run_until_killed(code: str, arguments: list[str], *, nth: int) -> bool:
    """Run Python code in a process that is killed at its n-th fsync or rename; False where it ended before that."""
    program = textwrap.dedent(KILLER.format(nth=nth)) + code
    ended = subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode in (0, -9), ended.stderr
    return ended.returncode == -9


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
