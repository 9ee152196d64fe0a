"""`vilp-data salvage`: what it prints, how it ends, what it leaves when it is stopped."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.damage import LAYOUTS, read_log, write_log
from vilp_data.cli import app
from vilp_data.errors import LogError, VilpDataError, copy_or_salvage
from vilp_data.sources import open_log

ROOT = Path(__file__).resolve().parent.parent


def salvage(*words: str | Path) -> tuple[int, str]:
    """(exit code, what was printed or said)."""
    result = CliRunner().invoke(app, ["salvage", *map(str, words)])
    if isinstance(result.exception, VilpDataError):
        return result.exception.exit_code, str(result.exception)
    return result.exit_code, result.output


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write_log(tmp_path / "run.mcap", **LAYOUTS["lz4"])
    return tmp_path / "run.mcap"


def test_a_whole_log_ends_with_0(log: Path) -> None:
    code, said = salvage(log, "-o", log.with_name("out.mcap"))
    assert code == 0
    assert "is whole (150 messages); copied as it is" in said


def test_a_loss_ends_with_1_and_names_each_topic(log: Path) -> None:
    log.write_bytes(log.read_bytes()[:15_000])
    code, said = salvage(log, "-o", log.with_name("out.mcap"))
    assert code == 1
    assert "recovered from" in said
    assert all(f"/topic{i}" in said for i in range(3))
    assert "cut off" in said


def test_json_is_the_whole_report(log: Path) -> None:
    log.write_bytes(log.read_bytes()[:15_000])
    code, said = salvage(log, "-o", log.with_name("out.mcap"), "--json")
    report = json.loads(said)
    assert code == 1
    assert report["complete"] is False
    assert report["recovered"] == sum(topic["recovered"] for topic in report["topics"])
    assert report["recovered"] == len(read_log(log.with_name("out.mcap")))
    assert report["lost"] is None


@pytest.mark.parametrize("name", ["run.mcap", "a run.mcap", "run.mcap.active"])
def test_the_command_that_errors_advise_works_as_it_stands(log: Path, name: str) -> None:
    damaged = log.rename(log.with_name(name))
    damaged.write_bytes(damaged.read_bytes()[:15_000])
    with pytest.raises(LogError) as caught:
        open_log(damaged)
    command = re.search(r"`vilp-data salvage (.*)`", str(caught.value.remedy))
    assert command is not None
    code, said = salvage(*shlex.split(command[1]))
    assert code == 1, said
    assert read_log(Path(shlex.split(command[1])[-1]))


def test_a_packed_log_is_inflated_before_it_is_salvaged() -> None:
    assert copy_or_salvage(Path("bag/a b.db3.zstd")).endswith(
        "`zstd -d 'bag/a b.db3.zstd' -o 'bag/a b.db3'` inflates what is there, and "
        "`vilp-data salvage 'bag/a b.db3' -o 'bag/a b-salvaged.mcap'` takes that"
    )


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["nowhere.mcap", "-o", "out.mcap"], 2, "no such log"),
        (["run.mcap", "-o", "there.mcap"], 2, "--force"),
        (["run.mcap", "-o", "run.mcap"], 2, "the log itself"),
        (["run.mcap", "-o", "."], 2, "name a file"),
        ([".", "-o", "out.mcap"], 2, "name the damaged file"),
        (["run.mcap"], 2, "out"),
        (["there.mcap", "-o", "out.mcap"], 1, "not a log that can be salvaged"),
    ],
)
def test_wrong_use_ends_with_its_code_and_a_remedy(
    log: Path, words: list[str], code: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(log.parent)
    (log.parent / "there.mcap").write_bytes(b"precious")
    found, text = salvage(*words)
    assert found == code, text
    assert said in text
    assert (log.parent / "there.mcap").read_bytes() == b"precious"


INTERRUPTED = """
import sys, time
from pathlib import Path
from vilp_data.cli import main
from vilp_data.sources.mcap_clean import CleanMcap

folder = sys.argv[1]

def wait(clean):
    Path(folder, "waiting").touch()
    time.sleep(60)

CleanMcap.finish = wait
sys.argv = ["vilp-data", "salvage", f"{folder}/run.mcap", "-o", f"{folder}/out.mcap"]
main()
"""


def test_ctrl_c_leaves_no_half_written_file(tmp_path: Path) -> None:
    """It comes when every message is written and the file's end is not."""
    path = tmp_path / "run.mcap"
    write_log(path, n=50, use_chunking=False)
    path.write_bytes(path.read_bytes()[:10_000])
    process = subprocess.Popen([sys.executable, "-c", INTERRUPTED, str(tmp_path)], cwd=ROOT, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 30
    while not (tmp_path / "waiting").exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.005)
    assert list(tmp_path.glob(".out.mcap.*.tmp"))
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=30) == 130
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["run.mcap", "waiting"]
