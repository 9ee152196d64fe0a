"""Every source under damaged bytes: an answer or an error in words, in bounded time and memory; never a crash."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz.fuzz import MEMORY_MB
from tests.fuzz.seeds import SEEDS

ROOT = Path(__file__).resolve().parent.parent.parent
MINUTES_EACH = 2


def fuzz(keep: Path, *words: str, timeout_s: int) -> list[dict[str, object]]:
    """What the run says of each source; a failed test shows it whole, with the place where the log is kept."""
    ended = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.fuzz", *words, "--keep", str(keep)],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=timeout_s,
    )  # fmt: skip
    assert ended.returncode == 0, (
        f"exit {ended.returncode}, the log is in {keep}\n{ended.stdout}\n{ended.stderr[-3000:]}"
    )
    return [json.loads(line) for line in ended.stdout.splitlines()]


def test_no_source_crashes_hangs_or_grows_on_damaged_logs(tmp_path: Path) -> None:
    names = list(SEEDS)
    reports = fuzz(tmp_path, *names, "--rounds", "2", "--seed", "3", timeout_s=120)
    assert [report["source"] for report in reports] == names
    assert all(isinstance(report["memory_mb"], int) and report["memory_mb"] < MEMORY_MB for report in reports)


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEDS)
def test_two_minutes_of_damage_find_nothing(tmp_path: Path, name: str) -> None:
    (report,) = fuzz(tmp_path, name, "--seconds", str(60 * MINUTES_EACH), timeout_s=60 * MINUTES_EACH + 120)
    assert report["logs"]
