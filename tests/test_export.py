"""Exports in all three formats: what goes in, what comes back, what is refused, and that nothing half is ever left."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.export_datasets import SPEC, blind_dataset, demonstration, plain_dataset, shown, write
from tests.faults import run_until_killed, tree
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import SpecError, SplitError, StoreError, UsageError
from vilp_data.export import Choice, export_dataset
from vilp_data.export.folder import out_folder
from vilp_data.export.segments import Segment, common_rate_hz
from vilp_data.ingest import ingest_logs
from vilp_data.task_toml import task_from_dict

ALL = ("lerobot", "robomimic", "diffusion-policy")

# How each format is read as a log: where it lies, its topics.
READ: dict[str, tuple[str, str, list[str], str]] = {
    "lerobot": ("", "observation.images.{}", ["observation.state"], "action"),
    "robomimic": ("demos.hdf5", "obs/{}_image", ["obs/arm", "obs/gripper"], "actions"),
    "diffusion-policy": ("replay.zarr", "img_{}", ["state"], "action"),
}


def ingested_again(folder: Path, to: str, root: Path, *, views: Any = SPEC["views"]) -> list[Any]:
    """The export, ingested as any log of its format would be."""
    inside, image, vectors, action = READ[to]
    topic = {"clock": "log"}
    views = {name: {**table, **topic, "topic": image.format(name)} for name, table in views.items()}
    low_dim = {f"part{i}": {**topic, "topic": name} for i, name in enumerate(vectors)}
    table = {
        "name": "again",
        "rate_hz": 10.0,
        "views": views,
        "low_dim": low_dim,
        "action": {"a": {**topic, "topic": action}},
    }
    report = ingest_logs([folder / inside], root, task_from_dict(table, where="test"), workers=1)
    assert not report.failed, report.failed
    store = EpisodeStore(root)
    return [store.read(entry.id) for entry in store.index()]


@pytest.mark.parametrize(
    ("to", "images"), [("lerobot", "lossless"), ("lerobot", "png"), ("robomimic", None), ("diffusion-policy", None)]
)
def test_an_export_ingested_again_is_the_dataset_it_came_from(tmp_path: Path, to: str, images: Any) -> None:
    episodes = plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", to, images=images)
    again = ingested_again(tmp_path / "out", to, tmp_path / "again")
    assert [one.n_steps for one in again] == [14, 9, 11]
    for before, after in zip(episodes, again, strict=True):
        for view in SPEC["views"]:
            assert np.array_equal(shown(after, view), shown(before, view))
        assert np.array_equal(after.low_dim, before.low_dim)
        assert np.array_equal(after.action, before.action)
        assert after.valid.all()


@pytest.mark.parametrize("to", ALL)
def test_marked_steps_come_back_masked_and_their_numbers_are_nobodys(tmp_path: Path, to: str) -> None:
    one = demonstration("gap", 12, invalid=(0, 4, 5))
    write(tmp_path / "data", one)
    report = export_dataset(tmp_path / "data", tmp_path / "out", to, choice=Choice(masked="mark"))
    assert (report.episodes, report.rows, report.masked) == (1, 12, {"gap": 3})
    (after,) = ingested_again(tmp_path / "out", to, tmp_path / "again")
    assert np.array_equal(after.valid, one.valid)
    assert np.array_equal(after.low_dim[after.valid], one.low_dim[one.valid])


@pytest.mark.parametrize("to", ALL)
def test_an_episode_is_cut_at_masked_steps_and_every_loss_is_counted(tmp_path: Path, to: str) -> None:
    one = demonstration("gap", 12, invalid=(0, 4, 6))  # runs 1-3, 5, 7-11
    write(tmp_path / "data", one, demonstration("never", 3, invalid=(0, 2)))
    report = export_dataset(tmp_path / "data", tmp_path / "out", to)
    assert (report.episodes, report.stored_episodes, report.rows) == (2, 1, 8)
    assert report.masked == {"gap": 3, "never": 2}
    assert report.cut_away == {"gap": 1, "never": 1}
    assert report.left_out == {"no two valid steps in a row": ["never"]}
    first, second = ingested_again(tmp_path / "out", to, tmp_path / "again")
    assert np.array_equal(first.action, one.action[1:4])
    assert np.array_equal(second.action, one.action[7:])
    with pytest.raises(UsageError, match=r"masked steps[\s\S]*--masked"):
        export_dataset(tmp_path / "data", tmp_path / "none", to, choice=Choice(masked="refuse"))


def test_what_is_left_out_by_default_is_said_and_can_be_asked_for(tmp_path: Path) -> None:
    write(
        tmp_path / "data", demonstration("good", 6), demonstration("bad", 6, outcome="failure"),
        demonstration("watched", 6, with_action=False), demonstration("policy", 6, tags={"source": "rollout"}),
    )  # fmt: skip
    report = export_dataset(tmp_path / "data", tmp_path / "out", "diffusion-policy")
    assert report.episodes == 1
    assert report.left_out == {"failures": ["bad"], "rollouts of a policy": ["policy"], "without actions": ["watched"]}
    choice = Choice(with_failures=True, with_rollouts=True, with_unlabelled=True)
    full = export_dataset(tmp_path / "data", tmp_path / "full", "diffusion-policy", choice=choice)
    assert (full.episodes, full.left_out) == (4, {})
    assert "episodes without actions, theirs are NaN: 1" in full.notes


@pytest.mark.parametrize("to", ALL)
def test_a_dataset_without_cameras_is_exported_as_its_numbers(tmp_path: Path, to: str) -> None:
    episodes = blind_dataset(tmp_path / "data")
    report = export_dataset(tmp_path / "data", tmp_path / "out", to)
    assert (report.episodes, report.views) == (2, {})
    assert not [line for line in report.verified if "frames" in line]
    assert sorted(path.suffix for path in (tmp_path / "out").rglob("*.png")) == []
    again = ingested_again(tmp_path / "out", to, tmp_path / "again", views={})
    for before, after in zip(episodes, again, strict=True):
        assert np.array_equal(after.low_dim, before.low_dim)
        assert np.array_equal(after.action, before.action)


def test_a_dataset_without_any_actions_is_exported_without(tmp_path: Path) -> None:
    write(tmp_path / "data", demonstration("watched", 6, with_action=False))
    for to in ALL:
        report = export_dataset(tmp_path / "data", tmp_path / to, to)
        assert "no episode has actions: video and low_dim alone" in report.notes


def test_one_side_of_the_split_alone(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    report = export_dataset(tmp_path / "data", tmp_path / "out", "robomimic", choice=Choice(split="val"))
    assert report.sides == {"val": 1}
    assert report.left_out == {"not on the side 'val'": ["pick", "place"]}
    (tmp_path / "data" / "split.lock.json").unlink()
    with pytest.raises(SplitError, match="no split yet"):
        export_dataset(tmp_path / "data", tmp_path / "other", "robomimic", choice=Choice(split="val"))


@pytest.mark.parametrize("to", ALL)
def test_the_same_dataset_gives_the_same_bytes(tmp_path: Path, to: str) -> None:
    plain_dataset(tmp_path / "data")
    for name in ("one", "two"):
        export_dataset(tmp_path / "data", tmp_path / name, to)
    assert tree(tmp_path / "one") == tree(tmp_path / "two")


def test_the_manifest_tells_where_everything_came_from(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", "lerobot")
    manifest = json.loads((tmp_path / "out" / "export.json").read_text())
    first = manifest["episode_list"][0]
    assert (first["episode"], first["side"], first["outcome"]) == ("pick", "train", "success")
    assert first["source_sha256"] == "ab" * 32
    assert manifest["spec"]["action"]["target"]["unit"] == "m"
    assert set(manifest["sha256"]) == set(tree(tmp_path / "out")) - {"export.json"}


# --- rates ---------------------------------------------------------------------------------------------------------------


def at_rates(root: Path, *rates: float) -> list[Any]:
    """Episodes of a task that states no rate: each has that of its own camera."""
    episodes = []
    for number, rate_hz in enumerate(rates):
        one = demonstration(f"run{number}", 8 + number)
        ticks = np.round(np.arange(one.n_steps) * 1e9 / rate_hz).astype(np.int64) + 7
        episodes.append(replace(one, rate_hz=rate_hz, log_time_ns=ticks))
    spec = {name: value for name, value in SPEC.items() if name != "rate_hz"}
    write(root, *episodes, spec=spec)
    return episodes


@pytest.mark.parametrize("to", ALL)
def test_rates_that_scatter_as_cameras_do_are_one_rate_and_the_true_times_are_kept(tmp_path: Path, to: str) -> None:
    episodes = at_rates(tmp_path / "data", 9.96, 10.06, 9.97)
    report = export_dataset(tmp_path / "data", tmp_path / "out", to, images="lossless" if to == "lerobot" else None)
    assert report.rate_hz == 10
    assert "9.96 to 10.06 Hz" in report.not_carried["the rate of each episode"]
    again = ingested_again(tmp_path / "out", to, tmp_path / "again")
    for before, after in zip(episodes, again, strict=True):
        assert np.array_equal(after.action, before.action)
        assert np.array_equal(shown(after, "front"), shown(before, "front"))
    listed = json.loads((tmp_path / "out" / "export.json").read_text())["episode_list"]
    assert [one["rate_hz"] for one in listed] == [9.96, 10.06, 9.97]


def test_the_rate_is_the_roundest_of_those_there_are() -> None:
    def rate(*rates: float) -> float:
        return common_rate_hz([Segment(SimpleNamespace(rate_hz=one), 0, 2, None) for one in rates])  # type: ignore[arg-type]

    assert rate(29.97002997) == 29.97002997
    assert rate(29.97, 30.02) == 30
    assert rate(14.981, 14.992, 14.987) == 14.99
    assert rate(9.8, 10, 10.2) == 10  # as far apart as an ingest at 10 Hz lets them be


def test_rates_too_far_apart_for_one_dataset_are_refused(tmp_path: Path) -> None:
    at_rates(tmp_path / "data", 9.5, 10.0)
    with pytest.raises(SpecError, match="different rates"):
        export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")


# --- nothing half, nothing lost ------------------------------------------------------------------------------------------


def test_an_export_is_replaced_by_force_alone_and_another_folder_never(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")
    with pytest.raises(UsageError, match="--force"):
        export_dataset(tmp_path / "data", tmp_path / "out", "diffusion-policy")
    export_dataset(tmp_path / "data", tmp_path / "out", "diffusion-policy", force=True)
    assert not (tmp_path / "out" / "demos.hdf5").exists()
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    for force in (False, True):
        with pytest.raises(UsageError, match="thesis.tex"):
            export_dataset(tmp_path / "data", tmp_path / "home", "robomimic", force=force)
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years of work"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "home", "out"]


def test_an_export_into_the_datasets_own_files_is_refused(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    with pytest.raises(UsageError, match="own files"):
        export_dataset(tmp_path / "data", tmp_path / "data" / "episodes" / "out", "robomimic")


def test_a_disk_too_small_is_said_before_anything_is_written(tmp_path: Path) -> None:
    with (
        pytest.raises(StoreError, match="not enough room"),
        out_folder(tmp_path / "out", force=False, needed_bytes=10**18),
    ):
        pytest.fail("it began to write")
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_on_the_way_ends_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """HDF5 would end the process, so there must be room for each demonstration before it is written."""
    plain_dataset(tmp_path / "data")
    usage = shutil.disk_usage(tmp_path)
    left = iter([usage, usage, usage._replace(free=1000)])
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: next(left))
    with pytest.raises(StoreError, match="not enough room"):
        export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data"]


@pytest.mark.parametrize("to", ALL)
def test_a_damaged_episode_stops_the_export_and_leaves_nothing(tmp_path: Path, to: str) -> None:
    plain_dataset(tmp_path / "data")
    path = EpisodeStore(tmp_path / "data").frames_path("side", "hand")
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(StoreError, match="checksum"):
        export_dataset(tmp_path / "data", tmp_path / "out", to)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data"]


def test_an_export_that_came_out_wrong_never_takes_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vilp_data.export import diffusion_policy, lerobot, robomimic

    plain_dataset(tmp_path / "data")
    broken: list[tuple[str, Any, str, Any]] = [
        ("diffusion-policy", diffusion_policy, "columns", _off_by_one(diffusion_policy.columns)),
        ("robomimic", robomimic, "_arrays", _off_by_one(robomimic._arrays)),
        ("lerobot", lerobot, "_columns", _off_by_one(lerobot._columns)),
    ]
    for to, module, name, function in broken:
        with monkeypatch.context() as patch, pytest.raises(StoreError, match="came out different"):
            patch.setattr(module, name, function)
            export_dataset(tmp_path / "data", tmp_path / "out", to)
        assert not (tmp_path / "out").exists()


def _off_by_one(honest: Any) -> Any:
    """A writer's function that shifts what it gives by a row, the first time it is asked, and never when it is checked."""
    asked = 0

    def shifting(*arguments: Any) -> Any:
        nonlocal asked
        asked += 1
        arrays = honest(*arguments)
        key = next(key for key in arrays if "action" in key)
        return arrays | {key: np.roll(arrays[key], 1, axis=0)} if asked == 1 else arrays

    return shifting


def test_ctrl_c_leaves_nothing_and_what_was_there_before(tmp_path: Path) -> None:
    write(tmp_path / "data", *(demonstration(f"long{i}", 150) for i in range(8)))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "export.json").write_text("{}")
    before = tree(tmp_path / "out")
    code = "import sys; from vilp_data.cli import main; main()"
    words = ["export", str(tmp_path / "data"), "--to", "lerobot", "-o", str(tmp_path / "out"), "--force"]
    process = subprocess.Popen([sys.executable, "-c", code, *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".out.export.tmp/videos/*/*/*.mp4")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert tree(tmp_path / "out") == before
    assert [path.name for path in tmp_path.iterdir() if "export" in path.name] == []


def test_what_a_killed_export_left_is_cleared_away_by_the_next(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data")
    leftover = tmp_path / ".out.export.tmp"
    (leftover / "videos").mkdir(parents=True)
    (leftover / "half.hdf5").write_bytes(b"half")
    export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")
    assert not (tmp_path / "out" / "half.hdf5").exists()
    assert not leftover.exists()


REPLACE = """
import sys
from pathlib import Path
from vilp_data.export import export_dataset
export_dataset(Path(sys.argv[1]), Path(sys.argv[2]), "robomimic", licence="MIT", force=True)
"""
MOMENTS = 15  # fsyncs and renames of such an export; the 13th is the rename between the two


@pytest.mark.parametrize("nth", [pytest.param(n, marks=() if n == 13 else pytest.mark.slow) for n in range(1, 17)])
def test_an_export_killed_while_it_replaces_another_leaves_one_of_them_whole(tmp_path: Path, nth: int) -> None:
    plain_dataset(tmp_path / "data")
    export_dataset(tmp_path / "data", tmp_path / "new", "robomimic", licence="MIT")
    export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")
    new, old = tree(tmp_path / "new"), tree(tmp_path / "out")
    killed = run_until_killed(REPLACE, [str(tmp_path / "data"), str(tmp_path / "out")], nth=nth)
    assert killed == (nth <= MOMENTS)
    with pytest.raises(UsageError, match="there is an export already"):  # whichever of them it is
        export_dataset(tmp_path / "data", tmp_path / "out", "robomimic")
    assert tree(tmp_path / "out") in (new, old)
    export_dataset(tmp_path / "data", tmp_path / "out", "robomimic", licence="MIT", force=True)
    assert tree(tmp_path / "out") == new
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "new", "out"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"to": "lerobt"}, "lerobot"),
        ({"to": "robomimic", "images": "png"}, "keeps every pixel"),
        ({"to": "lerobot", "images": "png", "crf": 3}, "--crf"),
        ({"to": "lerobot", "crf": 99}, "0 .best. to 51"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path: Path, options: dict[str, Any], said: str) -> None:
    plain_dataset(tmp_path / "data")
    with pytest.raises(UsageError, match=said):
        export_dataset(tmp_path / "data", tmp_path / "out", options.pop("to"), **options)
