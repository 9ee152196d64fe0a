"""The folder of a rollout: what a killed one leaves, and who may write beside whom."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from tests.faults import ALL_CHANGES, call_until_killed
from vilp_data.errors import BusyError, StoreError
from vilp_models.rollout_folder import find_rollout, new_rollout

N_CHANGES = 16
"""On disk, by a rollout that replaces another: the ninth is the second rename."""


def rolled_out(folder: Path, policy: str) -> None:
    with new_rollout(folder) as making:
        (making / "videos").mkdir()
        (making / "videos" / "best.mp4").write_bytes(policy.encode())
        (making / "report.json").write_text(
            json.dumps({"policy": policy, "starts": "0:1", "max_steps": 1, "episodes": []})
        )


def killed_midway(folder: Path) -> None:
    with new_rollout(folder) as making:
        (making / "half.mcap").write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)


def policy_in(folder: Path) -> str | None:
    table = find_rollout(folder)
    return None if table is None else table["policy"] + (folder / "videos" / "best.mp4").read_text()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_what_a_killed_rollout_left_is_cleared_away_by_the_next(tmp_path: Path) -> None:
    folder = tmp_path / "stay"
    assert call_until_killed(killed_midway, folder, nth=1, names=())
    [left] = [path for path in tmp_path.iterdir() if path.is_dir()]
    words = left.name.split(".")  # a process number in it would be this process's: they recur in containers
    left.rename(left.with_name(".".join(str(os.getpid()) if word.isdigit() else word for word in words)))
    rolled_out(folder, "new")
    assert names(tmp_path) == ["stay"]
    assert names(folder) == ["report.json", "videos"]


@pytest.mark.parametrize(
    "nth", [pytest.param(n, marks=() if n in (3, 9) else pytest.mark.slow) for n in range(1, N_CHANGES + 2)]
)
def test_a_rollout_killed_while_it_replaces_another_leaves_one_of_them_whole(tmp_path: Path, nth: int) -> None:
    folder = tmp_path / "stay"
    rolled_out(folder, "old")
    killed = call_until_killed(rolled_out, folder, "new", nth=nth, names=("mkdir", *ALL_CHANGES))
    assert killed == (nth <= N_CHANGES)
    assert policy_in(folder) in ("oldold", "newnew")  # as compare reads it, before any other rollout begins
    rolled_out(folder, "next")
    assert policy_in(folder) == "nextnext"
    assert names(tmp_path) == ["stay"]


def test_a_rollout_that_is_being_made_is_left_alone(tmp_path: Path) -> None:
    with new_rollout(tmp_path / "stay") as making:
        (making / "half.mcap").write_bytes(b"half")
        with pytest.raises(BusyError, match="another process is writing this rollout"):
            rolled_out(tmp_path / "stay", "other")
        rolled_out(tmp_path / "beside", "other")
        assert names(making) == ["half.mcap"]
        (making / "half.mcap").unlink()
    assert names(tmp_path) == ["beside", "stay"]


def test_a_rollout_is_found_through_a_link_to_another_disk(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "stay").symlink_to(tmp_path / "disk" / "stay")
    rolled_out(tmp_path / "stay", "old")
    assert call_until_killed(rolled_out, tmp_path / "stay", "new", nth=2, names=("rename",))
    assert policy_in(tmp_path / "stay") == "oldold"
    assert (tmp_path / "stay").is_symlink()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_where_nothing_may_be_written_is_said(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(StoreError, match="the rollout cannot be written"):
        rolled_out(tmp_path / "stay", "new")
