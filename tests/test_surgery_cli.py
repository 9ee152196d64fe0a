"""The verbs of surgery as typed: what they print, how they end, and that every command in docs/surgery.md is one."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.stored_episodes import add_episodes, episode, write_dataset
from tests.surgery_operations import ingest_all, other_dataset
from tests.synthetic import write_zarr
from tests.test_cli import ZARR_TASK
from vilp_data.cli import main
from vilp_data.dataset_state import DatasetState, EpisodeState, read_state
from vilp_data.edits import edited, edits_of, relabelled, trimmed
from vilp_data.episode_entry import EpisodeEntry
from vilp_data.episodes import EpisodeStore
from vilp_data.surgery.state_diff import compare_states

DOCS = Path(__file__).resolve().parent.parent / "docs" / "surgery.md"


class Shell:
    """Runs `vilp-data WORDS…` in this process, in a working folder."""

    def __init__(self, patch: pytest.MonkeyPatch, capture: pytest.CaptureFixture[str]) -> None:
        self._patch, self._capture = patch, capture

    def __call__(self, command: str, *, ends: int = 0) -> str:
        self._patch.setattr(sys, "argv", ["vilp-data", *shlex.split(command)])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
        said = self._capture.readouterr()
        assert code == ends, said
        return said.out + said.err


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shell:
    """In a folder with the datasets data/tuesday (a, b, c, d) and data/monday."""
    write_dataset(tmp_path / "data" / "tuesday", *(episode(name, 20 + i) for i, name in enumerate("abcd")))
    other_dataset(tmp_path / "data" / "monday")
    monkeypatch.chdir(tmp_path)
    return Shell(monkeypatch, capsys)


def test_a_session_of_surgery_reads_as_it_should(shell: Shell) -> None:
    assert "1 episode removed (operation 2;" in shell('remove b --reason "too dark" --data data/tuesday')
    assert "nothing to remove\n  b: removed already, by operation 2" in shell("remove b")
    assert "a: keeps steps 3 to 14, 12 of 20; 0.3 s at the start, 0.5 s at the end go" in shell("trim a --steps 3:15")
    assert "1 episode relabelled" in shell("relabel c --set operator=anna --outcome failure")
    assert "2 episodes taken from data/monday, with 4 latent files" in shell("merge data/monday data/tuesday")
    log = shell("log data/tuesday")
    for words in (
        "remove: 1 episode (b) removed: too dark",
        "$ vilp-data trim a --steps 3:15",
        "merge: 2 episodes taken",
    ):
        assert words in log
    changed = shell("diff 1", ends=1)
    for words in (
        "- b (21 steps)",
        "+ e (25 steps)",
        "~ a: 20 -> 12 steps",
        "~ c: operator (none) -> anna",
        "outcome success -> failure",
    ):
        assert words in changed
    assert "operation 5 (merge) taken back" in shell("undo")
    assert "the same 3 episodes" in shell("diff 4")
    assert "taken back by operation 6" in shell("log")
    assert "nothing to delete" in shell("gc --dry-run --keep 20 data/monday")


def test_reports_as_json_are_json(shell: Shell) -> None:
    assert json.loads(shell("remove b --data data/tuesday --json"))["changed"] == ["b"]
    assert json.loads(shell("trim c --steps 2:9 --dry-run --json --data data/tuesday"))["cuts"][0]["end"] == 9
    assert [entry["what"] for entry in json.loads(shell("log data/tuesday --json"))] == ["found", "remove"]
    assert json.loads(shell("diff 1 2 --data data/tuesday --json", ends=1))["only_first"] == ["b"]
    assert json.loads(shell("undo data/tuesday --json"))["undoes"] == 2
    assert "found" in json.loads(shell("gc data/tuesday --dry-run --json"))


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("remove aa --data data/tuesday", "did you mean 'a'?"),
        ("remove a --data nowhere", "not a dataset"),
        ("trim --steps 1:3 --data data/tuesday", "which episodes have these steps?"),
        ("trim a --steps 3 --data data/tuesday", "FIRST:END"),
        ("trim a --threshold 2 --data data/tuesday", "between 0 and 1"),
        ("trim a --margin -1 --data data/tuesday", "no negative number"),
        ("relabel a --data data/tuesday", "no label to set"),
        ("relabel a --set operator --data data/tuesday", "--set KEY=VALUE"),
        ("relabel a --outcome maybe --data data/tuesday", "--outcome success or"),
        ("relabel a --outcome success --set success=false --data data/tuesday", "two outcomes"),
        ("merge data/tuesday data/tuesday", "into itself"),
        ("merge nowhere data/tuesday", "not a dataset"),
        ("undo data/tuesday", "no operation to take back"),
        ("undo data/tuesday --operation 9", "no operation 9"),
        ("diff 7 --data data/tuesday", "no operation 7"),
        ("diff nowhere --data data/tuesday", "neither a dataset nor an operation"),
        ("gc data/tuesday --keep -1", "is not negative"),
        ("gc data/tuesday --run runs/vqgna", "not the run of a frame encoder"),
        ("trim a --steps 100:200 --dry-run --data data/tuesday", "no such range"),
        ("relabel a --set success=maybe --data data/tuesday", "true or false"),
    ],
)
def test_wrong_use_ends_with_2_and_says_what_to_do(shell: Shell, command: str, words: str) -> None:
    said = shell(command, ends=2)
    assert words in said
    assert "->" in said
    assert "Traceback" not in said


def test_a_damaged_entry_of_the_log_is_named_and_the_others_are_shown(shell: Shell) -> None:
    shell("relabel a --set operator=anna --data data/tuesday")
    Path("data/tuesday/history/0001.json").write_text("{")
    said = shell("log data/tuesday", ends=1)
    assert "relabel: 1 episode (a)" in said
    assert "0001.json: not an entry" in said
    assert "operation 2 (relabel) taken back" in shell("undo data/tuesday")


def test_what_an_undo_took_comes_back_by_the_command_it_names(shell: Shell) -> None:
    shell("relabel a --set operator=anna --data data/tuesday")
    said = shell("undo data/tuesday")
    command = said.partition("`vilp-data ")[2].partition("`")[0]
    assert "operation 2 (relabel) brought again" in shell(command)
    assert EpisodeStore(Path("data/tuesday")).entry("a").tags == {"operator": "anna"}


def test_the_first_ingest_taken_back_comes_back_by_the_command_it_names(shell: Shell) -> None:
    root = Path("data/my logs")
    write_zarr(Path("push.zarr"))
    ingest_all(Path("push.zarr"), root)
    before = read_state(root).digest
    said = shell(f"undo '{root}'")
    assert "operation 1 (ingest) taken back" in said
    assert "operation 1 (ingest) taken back" in shell("log")
    assert "0 episodes" in shell("diff 1", ends=1)
    shell("gc --dry-run")
    command = said.partition("`vilp-data ")[2].partition("`")[0]
    assert "operation 1 (ingest) brought again; 3 episodes" in shell(command)
    assert read_state(root).digest == before


def test_a_dataset_given_for_a_log_is_told_apart(shell: Shell) -> None:
    said = shell("inspect data/tuesday", ends=2)
    assert "a dataset, not a log" in said
    assert "`vilp-data check data/tuesday`" in said
    assert "`vilp-data view data/tuesday --html PAGE.html`" in shell("view data/tuesday", ends=2)
    Path("data/stopped").mkdir()
    Path("data/stopped/.lock").touch()
    assert "holds no episode yet" in shell("check data/stopped", ends=2)


def test_a_misspelt_episode_of_many_lists_a_screenful(shell: Shell) -> None:
    add_episodes(Path("data/tuesday"), *(episode(f"more-{i:03d}", 2) for i in range(50)))
    said = shell("remove nosuch --data data/tuesday", ends=2)
    assert "a, b, c, d, more-000" in said
    assert said.count("more-") == 16
    assert "and 34 more" in said


@pytest.mark.parametrize(("verb", "instead"), [("redo", "undo --operation N"), ("add", "ingest LOGS")])
def test_verbs_that_people_look_for_name_the_one_there_is(shell: Shell, verb: str, instead: str) -> None:
    assert instead in shell(f"{verb} data/tuesday", ends=2)


def test_a_range_past_the_last_step_is_kept_to_and_said(shell: Shell) -> None:
    said = shell("trim a --steps 10:9999 --data data/tuesday")
    assert "10 of 20" in said
    assert "a: the range goes on past its last step" in said


def test_an_ingest_after_an_undone_one_says_that_its_history_goes_on(shell: Shell) -> None:
    Path("zarr.toml").write_text(ZARR_TASK)
    write_zarr(Path("push.zarr"), episode_lengths=(5,))
    ingest = "ingest push.zarr --task zarr.toml --workers 1"
    assert "data/zarr: 1 episode ingested" in shell(ingest)
    shell("undo data/zarr")
    assert "its history goes on: `vilp-data log data/zarr`" in shell(ingest)


def test_a_log_that_cannot_be_read_is_named_once(shell: Shell) -> None:
    Path("zarr.toml").write_text(ZARR_TASK)
    Path("cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    assert shell("ingest cut.mcap --task zarr.toml --workers 1", ends=1).count("cut.mcap: ") == 1


def test_verbs_that_need_episodes_say_how_those_of_an_undone_ingest_come_back(shell: Shell) -> None:
    write_zarr(Path("push.zarr"))
    ingest_all(Path("push.zarr"), Path("data/push"))
    shell("undo data/push")
    assert "`vilp-data undo data/push --operation N` brings again" in shell("split data/push", ends=2)


def test_a_dataset_that_is_called_as_an_operation_is_asked_about(shell: Shell) -> None:
    shell("relabel a --set operator=anna --data data/tuesday")
    Path("data/monday").rename("2")
    said = shell("diff 2 --data data/tuesday", ends=2)
    assert "./2 for the dataset, 02 for the operation" in said
    assert "4 episodes" in shell("diff 02 --data data/tuesday")
    assert "3 episodes" in shell("diff ./2 --data data/tuesday", ends=1)


def test_a_damaged_split_is_drawn_anew_as_its_error_says(shell: Shell) -> None:
    Path("data/tuesday/split.lock.json").write_text("{")
    assert "--redraw" in shell("split data/tuesday", ends=1)
    assert "training" in shell("split data/tuesday --redraw")


def test_a_trim_that_is_only_looked_at_changes_nothing(shell: Shell) -> None:
    before = EpisodeStore(Path("data/tuesday")).index()
    shell("trim c --steps 2:9 --dry-run --data data/tuesday")
    assert EpisodeStore(Path("data/tuesday")).index() == before
    assert not Path("data/tuesday/history").exists()


def test_every_command_in_the_docs_is_one(shell: Shell) -> None:
    """Those of the first block, on data that has such episodes."""
    for name in ("run3", "run5", "run7"):
        add_episodes(Path("data/tuesday"), episode(name, 160))
    block = DOCS.read_text(encoding="utf-8").split("```")[1].strip().splitlines()
    commands = [line.partition("#")[0].strip().removeprefix("vilp-data ") for line in block]
    shell("log data/tuesday")  # from now on the dataset in use
    shell("relabel run3 --set operator=ben")
    for command in [one for one in commands if not one.startswith("remove")] + [commands[0]]:
        shell(command, ends=1 if command.startswith("diff") else 0)


# --- the pure parts ------------------------------------------------------------------------------------------------------------


def an_entry(n_steps: int) -> tuple[EpisodeEntry, dict[str, np.ndarray]]:  # type: ignore[type-arg]
    index = (np.arange(n_steps) // 2).astype(np.int32)
    steps = {
        "log_time_ns": np.arange(n_steps, dtype=np.int64) * 100, "low_dim": np.arange(n_steps, dtype=np.float32)[:, None],
        "valid": np.ones(n_steps, np.bool_), "source_index/top": index,
    }  # fmt: skip
    entry = EpisodeEntry(
        id="a", source="log", source_sha256="5ha", source_episode="log", key="key", ingest={}, n_steps=n_steps, n_valid=n_steps,
        rate_hz=10.0, outcome="unknown", tags={"operator": "ben", "seed": "1"}, findings=("a gap",), frames_sha256={"top": "f00d"},
        n_frames={"top": int(index[-1]) + 1}, content_sha256="c0de", has_action=False, has_state=False,
    )  # fmt: skip
    return entry, steps


@settings(deadline=None, max_examples=60)
@given(st.integers(2, 40), st.data())
def test_any_trims_one_after_the_other_are_one_trim(n_steps: int, data: st.DataObject) -> None:
    entry, steps = an_entry(n_steps)
    frames, kept, cut = np.arange(entry.n_frames["top"]), entry, steps
    for _ in range(3):
        first = data.draw(st.integers(0, kept.n_steps - 2))
        end = data.draw(st.integers(first + 2, kept.n_steps))
        kept, cut = trimmed(kept, cut, first, end)
    begin, end = kept.first_step, kept.first_step + kept.n_steps
    assert (kept, {name: array.tolist() for name, array in cut.items()}) == (
        (once := trimmed(entry, steps, begin, end))[0], {name: array.tolist() for name, array in once[1].items()},
    )  # fmt: skip
    seen = frames[kept.first_frame("top") :][: kept.n_frames["top"]]
    assert seen[cut["source_index/top"]].tolist() == steps["source_index/top"][begin:end].tolist()
    assert set(seen) == set(steps["source_index/top"][begin:end])  # and no frame besides
    assert kept.stored_frames("top") == len(frames)
    again, same = edited(entry, steps, edits_of(kept.edits))  # as after another ingest
    assert again == kept
    assert same["log_time_ns"].tolist() == cut["log_time_ns"].tolist()


TAGS = st.dictionaries(
    st.sampled_from(["operator", "seed", "success", "table"]), st.sampled_from(["a", "true", "false"])
)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(TAGS, st.sets(st.sampled_from(["operator", "seed", "success", "table"]))), max_size=4))
def test_labels_say_what_was_said_last_and_go_without_a_trace(calls: list[tuple[dict[str, str], set[str]]]) -> None:
    entry, steps = an_entry(10)
    now, expected = entry, dict(entry.tags)
    for labels, unset in calls:
        labels = {tag: value for tag, value in labels.items() if tag not in unset}
        now = relabelled(now, labels=labels, unset=tuple(sorted(unset)))
        expected = {tag: value for tag, value in {**expected, **labels}.items() if tag not in unset}
    assert now.tags == expected
    assert edited(entry, steps, edits_of(now.edits))[0] == now
    added = tuple(sorted(now.tags.keys() - entry.tags.keys()))
    assert relabelled(now, labels=dict(entry.tags), unset=added) == entry


def test_a_diff_backwards_is_the_diff_turned_round() -> None:
    def state(**episodes: EpisodeState) -> DatasetState:
        return DatasetState(episodes)

    one = EpisodeState("s1", {"top": "f1"}, "c1", "log", 10, "unknown", {}, "train")
    other = EpisodeState("s2", {"top": "f1"}, "c2", "log", 8, "success", {"a": "b"}, "val")
    forth, back = (
        compare_states(state(x=one, y=one), state(x=other)),
        compare_states(state(x=other), state(x=one, y=one)),
    )
    assert (forth.only_first, forth.sides) == (back.only_second, {"x": ("train", "val")})
    assert back.sides == {"x": ("val", "train")}
    assert (forth.content["x"], back.content["x"]) == ("10 -> 8 steps", "8 -> 10 steps")
