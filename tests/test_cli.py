"""The command lines: what they print, how they end, which dataset they mean."""

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
import typer

from docs.make_cli_reference import PAGE, reference
from tests.synthetic import write_mcap, write_zarr
from vilp_data.cli import app as data_app
from vilp_models.cli import app as models_app

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = {"vilp-data": ("vilp_data.cli", data_app), "vilp-models": ("vilp_models.cli", models_app)}

TASK = """
name = "synthetic"
rate_hz = 10.0
[views.front]
topic = "/camera/front/image"
height = 48
width = 64
[low_dim.joints]
topic = "/joint_states"
fields = ["position"]
[action.target]
topic = "/action"
"""

ZARR_TASK = """
name = "zarr"
rate_hz = 10.0
[views.top]
topic = "img"
clock = "log"
height = 32
width = 32
"""


def run(cwd: Path, *words: str, program: str = "vilp-data") -> subprocess.CompletedProcess[str]:
    code = f"import sys; sys.argv[0] = {program!r}; from {PROGRAMS[program][0]} import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *words], cwd=cwd, capture_output=True, text=True, check=False, timeout=120
    )


@pytest.fixture
def work(tmp_path: Path) -> Path:
    """A working folder with a task, two logs and a zarr store."""
    (tmp_path / "task.toml").write_text(TASK)
    (tmp_path / "zarr.toml").write_text(ZARR_TASK)
    (tmp_path / "logs").mkdir()
    for i in range(2):
        write_mcap(tmp_path / "logs" / f"run{i}.mcap", jitter_s=0.001, seed=i)
    write_zarr(tmp_path / "replay.zarr")
    return tmp_path


def test_the_verbs_work_as_the_readme_writes_them(work: Path) -> None:
    ingested = run(work, "ingest", "logs", "--task", "task.toml")
    assert ingested.returncode == 0, ingested.stderr
    assert "2 episodes ingested, 0 already there" in ingested.stdout
    split = run(work, "split", "--ratio", "0.5")
    assert split.returncode == 0, split.stderr
    assert "1 training, 1 validation episodes (ratio 0.5 from the command line" in split.stdout
    assert "dataset: data/synthetic" in split.stderr
    again = run(work, "split")
    assert "ratio 0.5 from the command line" in again.stdout
    assert run(work, "split", "--check").returncode == 0
    assert run(work, "why-stale").returncode == 0
    recorded = run(work, "view", "logs/run0.mcap", "--save", "run0.rrd")
    assert recorded.returncode == 0, recorded.stderr
    assert (work / "run0.rrd").stat().st_size > 0
    assert run(work, "view", "run0", "--save", "ingested.rrd").returncode == 0


def test_json_output_is_json(work: Path) -> None:
    assert len(json.loads(run(work, "ingest", "logs", "--task", "task.toml", "--json").stdout)["written"]) == 2
    assert json.loads(run(work, "inspect", "logs/run0.mcap", "--json").stdout)["format"] == "mcap"
    assert set(json.loads(run(work, "split", "--json").stdout)["assignment"].values()) == {"train", "val"}
    assert json.loads(run(work, "why-stale", "--json").stdout) == {}
    changed = TASK.replace("height = 48", "height = 24").replace("width = 64", "width = 32")
    (work / "task.toml").write_text(changed)
    stale = run(work, "why-stale", "--task", "task.toml", "--json")
    assert stale.returncode == 1
    assert "views.front.height: 48 -> 24" in json.loads(stale.stdout)["run0"]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["ingest", "nowhere.mcap", "--task", "task.toml"], 2, "no such file"),
        (["ingest", "logs", "--task", "tsk"], 2, "no task called 'tsk'"),
        (["ingest", "logs"], 2, "which task"),
        (["ingest", "task.toml", "--task", "task.toml"], 1, "not a log"),
        (["inspect", "nowhere.mcap"], 2, "no such log"),
        (["inspect", "task.toml"], 1, "not a log"),
        (["inspect", "logs"], 2, "a folder of logs, not one log"),
        (["split"], 2, "which dataset"),
        (["split", "logs"], 2, "not a dataset"),
        (["view", "logs/run0.mcap"], 2, "--screenshot"),
        (["view", "nowhere.mcap"], 2, "no such log"),
        (["record", "--task", "zarr.toml"], 2, "no scripted expert"),
        (["splt"], 2, "Did you mean 'split'"),
        (["split", "--ratio", "much"], 2, "--ratio"),
    ],
)
def test_wrong_use_ends_with_its_code_and_a_remedy(
    work: Path, words: list[str], code: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    ended = run(work, *words)
    assert ended.returncode == code, ended.stderr
    assert said in ended.stderr
    assert "Traceback" not in ended.stderr


def test_partial_loss_is_said_and_ends_with_one(work: Path) -> None:
    (work / "logs" / "broken.mcap").write_bytes((work / "logs" / "run0.mcap").read_bytes()[:5000])
    ended = run(work, "ingest", "logs", "--task", "task.toml")
    assert ended.returncode == 1
    assert "2 episodes ingested, 0 already there, 1 could not be read" in ended.stdout
    assert "broken.mcap" in ended.stderr


def test_ctrl_c_ends_in_words_and_the_next_run_goes_on(work: Path) -> None:
    write_zarr(work / "long.zarr", episode_lengths=[60] * 80, chunk_rows=60)
    code = "import sys; from vilp_data.cli import main; main()"
    words = ["ingest", "long.zarr", "--task", "zarr.toml", "--workers", "1"]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *words], cwd=work, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60
    while not list((work / "data").rglob("steps/*.safetensors")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "run the same command again to go on" in error
    assert "Traceback" not in error
    ended = run(work, *words)
    assert ended.returncode == 0
    done, fresh = map(int, re.findall(r"(\d+) episodes ingested, (\d+) already there", ended.stdout)[0])
    assert done + fresh == 80
    assert fresh >= 1


@pytest.mark.parametrize("package", ["vilp_data", "vilp_models"])
def test_ctrl_c_while_the_command_line_is_still_loading_ends_in_words(package: str) -> None:
    code = f"""
import sys
from {package}.__main__ import main

class Pressed:
    def find_spec(self, name, *_):
        if name == "typer":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Pressed())
main()
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert ended.returncode == 130
    assert ended.stderr == f"{package.replace('_', '-')}: stopped before it began\n"


def test_the_dataset_meant_is_the_one_here_or_the_last_used_or_the_only_one(work: Path) -> None:
    run(work, "ingest", "logs", "--task", "task.toml")
    run(work, "ingest", "replay.zarr", "--task", "zarr.toml")
    assert "dataset: data/zarr" in run(work, "split").stderr
    assert "dataset: data/zarr" in run(work, "why-stale").stderr
    run(work, "split", "data/synthetic")
    assert "dataset: data/synthetic" in run(work, "why-stale").stderr
    inside = run(work / "data" / "zarr" / "episodes", "why-stale")
    assert inside.stderr.rstrip().endswith("data/zarr")
    (work / ".vilp" / "last-dataset").unlink()
    ended = run(work, "split")
    assert ended.returncode == 2
    assert "data/synthetic, data/zarr" in ended.stderr


# --- the docs say what is --------------------------------------------------------------------------------------------------


def test_the_reference_page_is_what_help_prints() -> None:
    assert PAGE.read_text(encoding="utf-8") == reference(), "run `make docs`"


def commands_in(page: Path) -> list[str]:
    fenced = "\n".join(re.findall(r"```(?:sh|console)\n(.*?)```", page.read_text(encoding="utf-8"), re.S))
    return [line.removeprefix("$ ") for line in fenced.splitlines() if re.match(r"(\$ )?vilp-(data|models) ", line)]


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize(("page", "command"), [(page.name, command) for page in PAGES for command in commands_in(page)])
def test_every_command_in_the_docs_exists_with_its_options(page: str, command: str) -> None:
    program, *words = shlex.split(command, comments=True)
    node = typer.main.get_command(PROGRAMS[program][1])
    while hasattr(node, "commands"):
        node = node.commands[words.pop(0)]
    known = {option for parameter in node.params for option in parameter.opts} | {"--help"}
    assert {word for word in words if word.startswith("--")} <= known


def test_every_verb_has_an_example_in_its_help() -> None:
    pages = reference().split("### ")[1:]
    verbs = [page for page in pages if "COMMAND [ARGS]" not in page]
    assert verbs
    for page in verbs:
        assert "Example: vilp-" in page, page.splitlines()[0]
