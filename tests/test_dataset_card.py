"""The dataset card: says what is in the dataset, beside a contact sheet, the same bytes each time."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.export_datasets import SPEC, blind_dataset, demonstration, plain_dataset, write
from vilp_data.contact_sheet import captioned, stacked
from vilp_data.dataset_card import SHEET_EPISODES, make_card, write_card
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.surgery.operations import plan_trim, relabel_episodes, trim_episodes
from vilp_data.task_toml import task_from_dict


def section(text: str, title: str) -> str:
    return text.split(f"## {title}\n")[1].split("\n## ")[0]


def test_the_card_counts_what_is_there(tmp_path: Path) -> None:
    episodes = plain_dataset(tmp_path)
    text = make_card(EpisodeStore(tmp_path), licence="CC-BY-4.0").markdown
    assert "3 episodes, 34 steps at 10 Hz: 0 min 03 s in all, from 0.9 s to 1.4 s each, the middle one 1.1 s." in text
    assert "| `side` | 32 x 24 | RGB | 18 | 0.53 | `/side` |" in section(text, "Views")
    assert "| training | 2 | 23 |" in section(text, "Split")
    tags = section(text, "Outcomes and tags")
    assert "| (outcome) | `success` (2), `unknown` (1) |" in tags
    assert "| `operator` | `ann` (1); 2 without |" in tags
    assert "`pick.mcap`" in section(text, "Sources")
    assert "ab" * 32 in section(text, "Sources")
    assert "CC-BY-4.0" in section(text, "Licence")
    assert text.startswith("---\nlicense: cc-by-4.0\n")
    numbers = section(text, "Numbers")
    training = np.concatenate([one.action for one in episodes[:2] if one.action is not None])
    row = next(line for line in numbers.splitlines() if line.startswith("| `action[1]`"))
    assert "| `target.y` | absolute, m, frame base |" in row
    assert f"{training[:, 1].astype(np.float64).mean():.6g}" in row
    assert "valid steps of 2 training episodes" in numbers


def test_masked_steps_and_findings_are_told_once_with_counts(tmp_path: Path) -> None:
    from dataclasses import replace

    def finding(name: str, count: int) -> str:
        return f"view front: {count} of 12 steps see the image of the step before"

    episodes = [
        replace(demonstration(name, 12, invalid=(3,)), findings=(finding(name, i + 1),)) for i, name in enumerate("abc")
    ]
    write(tmp_path, *episodes)
    told = section(make_card(EpisodeStore(tmp_path)).markdown, "Masked steps and findings")
    assert "Masked: 3 steps of 3 episodes." in told
    assert told.count("see the image of the step before") == 1
    assert "(and the like in 2 more)" in told


def test_the_same_dataset_gives_the_same_bytes_and_no_date(tmp_path: Path) -> None:
    plain_dataset(tmp_path)
    one, two = (make_card(EpisodeStore(tmp_path)) for _ in range(2))
    assert one == two
    assert not re.search(r"\b20\d\d-\d\d", one.markdown)


def test_the_contact_sheet_shows_episodes_from_first_frame_to_last(tmp_path: Path) -> None:
    episodes = plain_dataset(tmp_path / "data")
    sheet_path = write_card(EpisodeStore(tmp_path / "data"), tmp_path / "card.md")
    assert f"]({sheet_path.name})" in (tmp_path / "card.md").read_text()
    sheet = cv2.imread(str(sheet_path))[..., ::-1]
    hand = sorted(episodes, key=lambda one: one.id)[0].frames["front"]
    for frame in (hand[0], hand[-1]):
        large = frame.repeat(5, axis=0).repeat(5, axis=1)
        found = cv2.matchTemplate(np.ascontiguousarray(sheet), np.ascontiguousarray(large), cv2.TM_SQDIFF)
        assert found.min() < 1e-6 * 255**2 * large.size  # the matcher rounds


def test_a_dataset_without_cameras_has_a_card_without_pictures(tmp_path: Path) -> None:
    blind_dataset(tmp_path / "data")
    assert write_card(EpisodeStore(tmp_path / "data"), tmp_path / "card.md") is None
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["card.md"]
    text = (tmp_path / "card.md").read_text()
    assert "![" not in text
    assert "None: numbers alone." in section(text, "Views")
    assert "| `action[1]`" in section(text, "Numbers")


def test_many_episodes_are_shown_by_a_few(tmp_path: Path) -> None:
    write(tmp_path, *(demonstration(f"run{i:02d}", 3) for i in range(20)))
    text = make_card(EpisodeStore(tmp_path)).markdown
    assert f"frames of {SHEET_EPISODES} episodes" in text
    assert "None drawn." in section(text, "Split")


def test_a_name_that_would_break_the_table_does_not(tmp_path: Path) -> None:
    write(tmp_path, demonstration("odd", 4, tags={"note": "left | right\nup", "`<b>": "`</code><img src=x>"}))
    markdown = make_card(EpisodeStore(tmp_path)).markdown
    assert "`left \\| right up` (1)" in markdown
    assert "| `'<b>` | `'</code><img src=x>` (1) |" in markdown


def test_parts_of_unknown_width_are_said_to_be_so(tmp_path: Path) -> None:
    low_dim = {"arm": {"topic": "/arm"}, "hand": {"topic": "/hand"}}
    write(tmp_path, demonstration("plain", 4), spec={**SPEC, "low_dim": low_dim})
    assert (
        "does not say how wide each part of low_dim is; in order: arm, hand"
        in make_card(EpisodeStore(tmp_path)).markdown
    )


def test_what_was_edited_since_the_ingest_is_said(tmp_path: Path) -> None:
    write(tmp_path, demonstration("one", 6), demonstration("two", 6))
    relabel_episodes(tmp_path, ["one"], labels={"success": "false"})
    trim_episodes(tmp_path, [plan_trim(tmp_path, ["two"], steps=(1, 5))[0]])
    assert "Since the ingest: 1 episode relabelled, 1 episode trimmed." in section(
        make_card(EpisodeStore(tmp_path)).markdown, "Outcomes and tags"
    )


def test_a_card_of_nothing_is_refused(tmp_path: Path) -> None:
    EpisodeStore(tmp_path).write_spec(task_from_dict(SPEC, where="test"))
    with pytest.raises(UsageError, match="vilp-data ingest"):
        make_card(EpisodeStore(tmp_path))
    plain_dataset(tmp_path)
    with pytest.raises(UsageError, match="a folder"):
        write_card(EpisodeStore(tmp_path), tmp_path)


def test_pictures_of_several_widths_stack_and_keep_their_captions() -> None:
    narrow, wide = np.full((4, 8, 3), 9, np.uint8), np.full((4, 20, 3), 7, np.uint8)
    sheet = stacked([narrow, wide])
    assert sheet.shape == (8, 20, 3)
    assert (sheet[:4, 8:] == 0).all()
    assert (captioned("x", wide)[-4:] == wide).all()
