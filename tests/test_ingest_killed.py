"""A store that was damaged, or whose ingest was killed at any moment, is made whole by the next ingest, to the byte."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.faults import kill_moments, run_until_files, run_until_killed, tree
from tests.synthetic import task_spec, write_mcap, write_zarr, zarr_task_spec
from tests.test_ingest import ingest
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import StoreError
from vilp_data.ingest import ingest_logs
from vilp_data.task_toml import load_task
from vilp_data.writer_lock import writer_lock


def test_a_lost_or_damaged_index_is_rebuilt_from_the_headers(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "replay.zarr")
    ingest([log.path], tmp_path / "data", zarr_task_spec())
    store = EpisodeStore(tmp_path / "data")
    entries = store.index()
    store.index_path.write_bytes(b"PAR1 damaged PAR1")
    assert store.index() == entries
    store.index_path.unlink()
    assert store.index() == entries
    store.steps_path(entries[0].id).unlink()
    assert store.index() == entries[1:]


def test_frames_of_another_ingest_are_noticed(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "replay.zarr")
    ingest([log.path], tmp_path / "data", zarr_task_spec())
    store = EpisodeStore(tmp_path / "data")
    one, two = store.index()[:2]
    store.frames_path("top", one.id).write_bytes(store.frames_path("top", two.id).read_bytes())
    with pytest.raises(StoreError, match="not the frames"):
        store.read(one.id)


@pytest.mark.parametrize("damage", ["deleted", "cut", "of another episode"])
def test_frames_that_do_not_fit_are_made_again(tmp_path: Path, damage: str) -> None:
    log, root = write_zarr(tmp_path / "replay.zarr"), tmp_path / "data"
    ingest([log.path], root, zarr_task_spec())
    before, store = tree(root), EpisodeStore(root)
    one, two = store.index()[:2]
    path = store.frames_path("top", one.id)
    whole, other = path.read_bytes(), store.frames_path("top", two.id).read_bytes()
    path.unlink() if damage == "deleted" else path.write_bytes(whole[:-5] if damage == "cut" else other)
    assert ingest([log.path], root, zarr_task_spec()).written == [one.id]
    assert tree(root) == before


def test_a_dataset_of_another_format_version_is_refused(tmp_path: Path) -> None:
    log = write_zarr(tmp_path / "replay.zarr")
    ingest([log.path], tmp_path / "data", zarr_task_spec())
    path = tmp_path / "data" / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 99}))
    with pytest.raises(StoreError, match="another version"):
        EpisodeStore(tmp_path / "data").spec()


def test_what_a_killed_ingest_left_half_written_goes_with_the_next(tmp_path: Path) -> None:
    log, root = write_mcap(tmp_path / "run.mcap"), tmp_path / "data"
    half = root / "episodes" / "frames" / "front" / ".run.safetensors.1.tmp"
    half.parent.mkdir(parents=True)
    half.write_bytes(b"half")
    ingest([log.path], root, task_spec(log))
    assert not half.exists()


# --- killed at any moment ------------------------------------------------------------------------------------------------

INGEST = """
import sys
from pathlib import Path
from tests.synthetic import zarr_task_spec
from vilp_data.ingest import ingest_logs
ingest_logs([Path(sys.argv[1])], Path(sys.argv[2]), zarr_task_spec(), workers=1)
"""


@pytest.mark.parametrize("nth", kill_moments(few=4, many=44))
def test_ingest_killed_at_any_moment_and_run_again_gives_the_same_bytes(tmp_path: Path, nth: int) -> None:
    log = write_zarr(tmp_path / "replay.zarr", episode_lengths=(12, 9, 5, 14))
    killed = run_until_killed(INGEST, [str(log.path), str(tmp_path / "killed")], nth=nth)
    assert killed or nth > 30
    ingest([log.path], tmp_path / "killed", zarr_task_spec())
    ingest([log.path], tmp_path / "whole", zarr_task_spec())
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


TWO_WORKERS = """
import sys
from pathlib import Path
from vilp_data.ingest import ingest_logs
from vilp_data.task_toml import load_task
ingest_logs([Path(sys.argv[1])], Path(sys.argv[2]), load_task(sys.argv[3]), workers=2)
"""


@pytest.mark.parametrize(
    "count", [1, 5, pytest.param(3, marks=pytest.mark.slow), pytest.param(9, marks=pytest.mark.slow)]
)
def test_two_workers_killed_and_run_again_give_the_bytes_of_one(tmp_path: Path, count: int) -> None:
    logs, task = tmp_path / "logs", tmp_path / "task.toml"
    logs.mkdir()
    for i in range(6):
        log = write_mcap(logs / f"run{i}.mcap", jitter_s=0.001, seed=i)
    task.write_text(
        'name = "synthetic"\nrate_hz = 10.0\n[low_dim.joints]\ntopic = "/joint_states"\nfields = ["position"]\n'
        '[views.front]\ntopic = "/camera/front/image"\nheight = 48\nwidth = 64\n'
    )
    killed = tmp_path / "killed"
    assert run_until_files(TWO_WORKERS, [str(logs), str(killed), str(task)], folder=killed, count=count)
    with writer_lock(killed):  # whoever could still write is gone
        after = tree(killed)
    spec = load_task(str(task))
    report = ingest_logs([logs], killed, spec, workers=2)
    assert len(report.written) + len(report.fresh) == 6
    assert report.written
    assert not {name for name in after if "/steps/" in name and tree(killed)[name] != after[name]}
    ingest([log.path.parent], tmp_path / "whole", spec)
    assert tree(killed) == tree(tmp_path / "whole")
