"""Logs, episodes and messages that name one column differently: it is said, and nothing is called by a name that may be another's."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.column_logs import LEG, ingested, ingested_json, leg, whole
from tests.json_log import Said, image, joints
from vilp_data.check.dataset import check_dataset
from vilp_data.dataset_card import make_card
from vilp_data.episodes import EpisodeEntry, EpisodeStore
from vilp_data.export import export_dataset
from vilp_data.ingest import ingest_logs
from vilp_data.surgery.merge import merge_datasets

ORDERS = ["hip", "knee", "toe"], ["knee", "hip", "toe"]


def test_logs_that_name_a_column_differently_are_said_to(tmp_path: Path) -> None:
    logs = [leg(names, first=3 * number) for number, names in enumerate(ORDERS)]
    store, report = ingested_json(tmp_path, *logs, low_dim=LEG)
    assert any("low_dim.leg" in note and "differently" in note and "`names`" in note for note in report.notes)
    card = make_card(store).markdown
    assert "Logs name the numbers of low_dim.leg differently" in card
    assert "| `low_dim[0]` | `leg.0` |" in card
    assert "| `low_dim[2]` | `leg.toe` |" in card


def test_digits_that_a_log_uses_as_names_are_names(tmp_path: Path) -> None:
    logs = leg(["0", "1", "2"]), leg(["2", "1", "0"], first=3)
    parts = {"leg": {"topic": "/joint_states", "fields": ["position[0:3]"]}}
    _, report = ingested_json(tmp_path, *logs, low_dim=parts)
    assert any("differently" in note for note in report.notes)


def test_a_log_without_names_contradicts_none(tmp_path: Path) -> None:
    store, report = ingested_json(tmp_path, leg(ORDERS[0]), leg([], first=3), low_dim=LEG)
    assert report.notes == []
    assert "| `low_dim[1]` | `leg.knee` |" in make_card(store).markdown


def test_merged_datasets_that_name_a_column_differently_are_said_to(tmp_path: Path) -> None:
    for number, names in enumerate(ORDERS):
        ingested_json(tmp_path / names[0], leg(names, first=3 * number), low_dim=LEG)
    report = merge_datasets(tmp_path / "knee/data", tmp_path / "hip/data")
    assert len(report.added) == 1
    assert any("low_dim.leg" in note and "differently" in note for note in report.notes)


def test_an_episode_that_another_dataset_names_otherwise_stays_as_it_is_and_that_is_said(tmp_path: Path) -> None:
    for names in ORDERS:
        ingested_json(tmp_path / names[0], leg(["hip", "knee", "toe"]), low_dim=LEG)
    store = EpisodeStore(tmp_path / "knee/data")
    (entry,) = store.index()
    store.rewrite_entry(entry_named(entry, ["knee", "hip", "toe"]))
    store.write_index()
    (note,) = merge_datasets(store.root, tmp_path / "hip/data").notes
    assert "named otherwise there; it stays as it is here" in note


def entry_named(entry: EpisodeEntry, names: list[str]) -> EpisodeEntry:
    return replace(entry, column_names={"low_dim": {"leg": names}})


def test_an_export_of_episodes_that_differ_says_so(tmp_path: Path) -> None:
    logs = [leg(names, first=3 * number) for number, names in enumerate(ORDERS)]
    store, _ = ingested_json(tmp_path, *logs, low_dim=LEG)
    report = export_dataset(store.root, tmp_path / "out", "lerobot", images="png")
    assert any("low_dim.leg" in note and "differently" in note for note in report.notes)
    names = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]["observation.state"]["names"]
    assert names == ["leg.0", "leg.1", "leg.toe"]


@pytest.mark.parametrize("late", [1, 6, 11])
def test_a_publisher_that_changes_its_order_names_no_column_and_is_found(tmp_path: Path, late: int) -> None:
    said = [image(k / 10, index=k) for k in range(12)]
    said += [joints(k / 10, ["hip", "knee"] if k < late else ["knee", "hip"], [k, -k]) for k in range(12)]
    store, report = ingested_json(tmp_path, said, low_dim=LEG)
    (entry,) = store.index()
    assert not any(entry.column_names["low_dim"]["leg"])
    (finding,) = report.findings[entry.id]
    assert finding.startswith("low_dim leg: ")
    assert "differently" in finding
    assert [one.severity for one in check_dataset(store.root).findings if one.what == finding] == ["warning"]


def test_findings_about_stored_columns_bear_the_log_s_names_where_episodes_share_them(tmp_path: Path) -> None:
    def log(names: list[str], first: int) -> list[Said]:
        frames = [image(k / 10, index=k + first) for k in range(80)]
        return [*frames, *(joints(k / 10, names, [k, min(float(np.sin(k)), 0.5), 1.0]) for k in range(80))]

    store, _ = ingested_json(tmp_path, log(["hip", "knee", "toe"], 0), log(["hip", "ankle", "heel"], 5), low_dim=LEG)
    told = [finding.what for finding in check_dataset(store.root).findings]
    assert any(what.startswith("leg.knee sits at its highest value") for what in told)
    assert any(what.startswith("leg.ankle sits at its highest value") for what in told)
    assert "leg.1, leg.2 move in no episode" in told


# --- names that are corrected -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("corrected", "expected"), [('"hand"', ["one", "hand"]), ('"one"', ["", ""]), ('"two", "three"', ["", ""])]
)
def test_names_corrected_beside_the_messages_arrive_with_the_next_ingest(
    tmp_path: Path, corrected: str, expected: list[str]
) -> None:
    store = ingested(tmp_path)
    before = {entry.id: (entry.key, entry.content_sha256) for entry in store.index()}
    assert [entry.column_names["low_dim"]["joints"] for entry in store.index()] == [["one", "two"]] * 2
    info = tmp_path / "log/meta/info.json"
    info.write_text(info.read_text().replace('"two"', corrected))
    report = ingest_logs([tmp_path / "log"], store.root, whole(), workers=1)
    assert (report.written, report.restated) == ([], sorted(before))
    assert [entry.column_names["low_dim"]["joints"] for entry in store.index()] == [expected] * 2
    assert {entry.id: (entry.key, entry.content_sha256) for entry in store.index()} == before
    assert ingest_logs([tmp_path / "log"], store.root, whole(), workers=1).restated == []


def test_names_taken_out_beside_the_messages_are_gone_with_the_next_ingest(tmp_path: Path) -> None:
    store = ingested(tmp_path)
    info = tmp_path / "log/meta/info.json"
    info.write_text(info.read_text().replace('{"motors": ["one", "two"]}', "null"))
    ingest_logs([tmp_path / "log"], store.root, whole(), workers=1)
    assert [entry.column_names["low_dim"]["joints"] for entry in store.index()] == [["", ""]] * 2
    assert "| `low_dim[1]` | `joints.1` |" in make_card(store).markdown


def test_a_dataset_from_before_there_were_names_gets_those_beside_the_messages(tmp_path: Path) -> None:
    store = ingested(tmp_path)
    for entry in store.index():
        store.rewrite_entry(replace(entry, column_names={}))
    store.write_index()
    ingest_logs([tmp_path / "log"], store.root, whole(), workers=1)
    assert [entry.column_names["action"]["joints"] for entry in store.index()] == [["one"]] * 2
