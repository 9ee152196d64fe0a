"""One call of each operation of surgery on the dataset a, b, c, d, for this process or one about to be killed."""

from __future__ import annotations

from pathlib import Path

from tests.stored_episodes import episode, write_dataset, write_latents
from tests.synthetic import zarr_task_spec
from vilp_data.dataset_split import update_split
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.ingest import ingest_logs
from vilp_data.surgery.merge import merge_datasets
from vilp_data.surgery.operations import plan_trim, relabel_episodes, remove_episodes, trim_episodes
from vilp_data.surgery.undo import undo


def split(root: Path, *, seed: int = 0, redraw: bool = False) -> None:
    update_split(root, ratio=0.5, ratio_from="task", seed=seed, group_by=None, strata=(), redraw=redraw)


def other_dataset(folder: Path) -> Path:
    """b again, as it is in `root`; another c; e."""
    write_dataset(folder, episode("b", 21), episode("e", 25))
    store = EpisodeStore(folder)
    store.write(episode("c", 30), Origin("test", "5eed5eed5eed", "c", "key of another c", {}))
    write_latents(folder, "c")
    store.write_index()
    return folder


def operate(root: Path, what: str) -> None:
    if what == "remove":
        remove_episodes(root, ["b", "d"], reason="dull")
    elif what == "trim":
        trim_episodes(root, plan_trim(root, ["a", "c"], steps=(3, 15)))
    elif what == "relabel":
        relabel_episodes(root, ["a", "b"], labels={"operator": "anna"})
    elif what == "merge":
        merge_datasets(root.parent / "other", root)
    elif what == "split":
        split(root, seed=3, redraw=True)
    elif what == "undo":
        undo(root, 3)
    elif what == "undo the last":
        undo(root)
    else:  # "redo": an undo taken back
        undo(root, 4)


def ingest_all(log: Path, root: Path) -> None:
    ingest_logs([log], root, zarr_task_spec(), workers=1)
