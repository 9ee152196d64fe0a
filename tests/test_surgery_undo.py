"""Undo: what it brings back, what it leaves alone, and how it is itself taken back."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.faults import tree
from tests.stored_episodes import episode, write_dataset
from tests.surgery_operations import operate, other_dataset
from tests.synthetic import task_spec, write_mcap
from vilp_data import shards
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.history import read_history
from vilp_data.ingest import ingest_logs
from vilp_data.surgery.operations import plan_trim, relabel_episodes, trim_episodes
from vilp_data.surgery.undo import undo


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Episodes a, b, c, d with latents and a split, written by no verb."""
    write_dataset(tmp_path / "data", *(episode(name, 20 + i) for i, name in enumerate("abcd")))
    return tmp_path / "data"


OPERATIONS = ("remove", "trim", "relabel", "merge", "split")


# --- undo --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", OPERATIONS)
def test_undo_brings_back_every_byte(root: Path, what: str) -> None:
    other_dataset(root.parent / "other")
    before = tree(root)
    operate(root, what)
    assert tree(root) != before
    assert undo(root).undoes == 2
    after = tree(root)
    if what == "merge":  # latents of nobody: gc's
        after = {name: data for name, data in after.items() if not name.startswith("latents/") or name in before}
    assert after == before


def test_undo_goes_back_step_by_step_to_the_beginning(tmp_path: Path) -> None:
    other_dataset(tmp_path / "other")
    write_dataset(root := tmp_path / "data", *(episode(name, 20 + i) for i, name in enumerate("abcd")))
    states = [tree(root)]
    for what in ("trim", "relabel", "merge", "split", "remove", "trim"):
        if what == "trim" and len(states) > 1:
            trim_episodes(root, plan_trim(root, ["a"], steps=(1, 8)))
        else:
            operate(root, what)
        states.append(tree(root))
    for state in reversed(states[:-1]):
        undo(root)
        now = tree(root)
        assert {name: now[name] for name in state} == state
        assert not {name for name in now.keys() - state.keys() if not name.startswith("latents/")}
    with pytest.raises(UsageError, match="no operation to take back"):
        undo(root)


def test_undo_of_an_ingest_takes_its_episodes_and_puts_replaced_ones_back(tmp_path: Path) -> None:
    log, root = write_mcap(tmp_path / "run.mcap"), tmp_path / "data"
    spec = task_spec(log)
    ingest_logs([log.path], root, spec, workers=1)
    one = tree(root)
    table = spec.model_dump(by_alias=True)
    table["views"]["front"] |= {"height": 24, "width": 32}
    ingest_logs([log.path], root, spec.model_validate(table), workers=1)
    assert tree(root) != one
    undo(root)
    assert tree(root) == one
    undo(root)
    assert tree(root) == {}


def test_an_operation_named_is_taken_back_once(root: Path) -> None:
    operate(root, "trim")
    operate(root, "relabel")
    with pytest.raises(UsageError, match=r"operation 2 is not the last one(.|\n)*operation 3, relabel"):
        undo(root, 2)
    undo(root, 3)
    state = tree(root)
    assert undo(root, 3).note == "operation 3 (relabel) taken back"
    assert tree(root) == state
    assert len(read_history(root)) == 4


def test_an_undo_taken_back_brings_again_what_it_took(root: Path) -> None:
    before = tree(root)
    operate(root, "trim")
    trimmed = tree(root)
    operate(root, "relabel")
    relabelled = tree(root)
    assert [undo(root).number, undo(root).number] == [4, 5]
    with pytest.raises(UsageError, match=r"something was done since operation 4(.|\n)*operation 5"):
        undo(root, 4)
    assert undo(root, 5).note == "operation 2 (trim) brought again"
    assert tree(root) == trimmed
    assert undo(root, 5).number == 6  # twice does nothing more
    assert undo(root, 4).note == "operation 3 (relabel) brought again"
    assert tree(root) == relabelled
    assert [undo(root).note, undo(root).note] == ["operation 3 (relabel) taken back", "operation 2 (trim) taken back"]
    assert tree(root) == before


def test_what_was_taken_back_cannot_be_brought_again_past_other_work(root: Path) -> None:
    operate(root, "trim")
    undo(root)
    relabel_episodes(root, ["d"], labels={"operator": "ben"})
    state = tree(root)
    with pytest.raises(UsageError, match=r"something was done since operation 3(.|\n)*operation 4"):
        undo(root, 3)
    assert tree(root) == state
    assert undo(root, 2).number == 3  # taken back already
    assert tree(root) == state


@pytest.mark.parametrize("what", ["trim", "split"])
def test_an_undo_stopped_before_its_index_is_finished_and_no_more_is_taken_back(
    root: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    relabelled = tree(root)
    operate(root, what)

    def stopped(self: EpisodeStore) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(EpisodeStore, "write_index", stopped)
        undo(root)
    assert undo(root).note == f"operation 3 ({what}) taken back"
    assert tree(root) == relabelled
    assert undo(root).note == "operation 2 (relabel) taken back"


def test_a_file_changed_by_hand_hinders_only_the_undo_of_what_wrote_it(root: Path) -> None:
    store, before = EpisodeStore(root), tree(root)
    operate(root, "remove")  # b and d
    relabel_episodes(root, ["a"], labels={"operator": "anna"})
    frames = store.frames_path("front", "c")
    frames.unlink()
    assert undo(root).what == "undo"
    steps = store.steps_path("a")
    relabel_episodes(root, ["a"], labels={"operator": "ben"})
    whole = steps.read_bytes()
    shards.write_shard(
        steps, shards.read_shard(steps).arrays, {**shards.read_header(steps).metadata, "findings": "[]", "rate_hz": "9"}
    )
    with pytest.raises(UsageError, match=r"changed by hand since(.|\n)*episodes/steps/a.safetensors"):
        undo(root)
    steps.write_bytes(whole)
    undo(root)
    undo(root)
    missing = {str(frames.relative_to(root))}
    assert tree(root) == {name: data for name, data in before.items() if name not in missing}


def test_what_was_put_back_by_hand_is_left_as_it_is(root: Path) -> None:
    before = tree(root)
    operate(root, "remove")  # b and d
    held = root / "history" / "held" / "0002"
    for path in held.rglob("b.safetensors"):
        shutil.copy(path, root / path.relative_to(held))
    assert undo(root).undoes == 2
    assert tree(root) == before


def test_an_entry_of_the_version_before_can_be_taken_back(root: Path) -> None:
    before = tree(root)
    operate(root, "remove")
    for path in (root / "history").glob("*.json"):
        table = json.loads(path.read_text())
        del table["touched"]
        path.write_text(json.dumps(table))
    undo(root)
    assert tree(root) == before


def test_undo_refuses_when_what_it_needs_is_gone(root: Path) -> None:
    operate(root, "remove")
    before = tree(root)
    shutil.rmtree(root / "history" / "held")
    with pytest.raises(UsageError, match=r"can no longer be taken back(.|\n)*--again"):
        undo(root)
    assert tree(root) == before
