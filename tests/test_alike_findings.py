"""What an ingest says the same of many episodes is told once."""

from __future__ import annotations

import shutil
from pathlib import Path

from typer.testing import CliRunner

from tests.json_log import image, joints, write_json_log
from vilp_data.alike_findings import AlikeFindings, alike_findings
from vilp_data.cli import app

TASK = """
name = "leg"
rate_hz = 10
views.front = { topic = "/camera/front/image", height = 48, width = 64 }
low_dim.leg = { topic = "/joint_states" }
"""


def test_sentences_that_differ_in_their_numbers_are_one() -> None:
    found = [("a", "3 of 30 steps"), ("b", "no action"), ("c", "12.5 of 40 steps")]
    found += [
        ("a", "view 1: 3 of 30, first at 2; it jitters: slow"),
        ("b", "view 1: 4 of 20, first at 9; it jitters: slow"),
    ]
    assert alike_findings(found) == [
        AlikeFindings("3 of 30 steps", ("a", "c")),
        AlikeFindings("view 1: 3 of 30, first at 2; it jitters: slow", ("a", "b")),
        AlikeFindings("no action", ("b",)),
    ]


def test_numbers_in_names_tell_findings_apart() -> None:
    """The like of arm1 is not arm2; a name may be a number altogether."""
    subjects = [
        "low_dim arm1",
        "low_dim arm2",
        "view 1",
        "view 2",
        "view 1 left",
        "view 2 left",
        "view a: 1.5",
        "view a: 2.5",
    ]
    said = [(f"e{k}", f"{subject}: missing at {k} of 30 steps") for k, subject in enumerate(subjects)]
    assert alike_findings(said) == [AlikeFindings(sentence, (episode,)) for episode, sentence in said]
    said = [("a", "no /arm1/joint for 3 steps"), ("b", "no /arm2/joint for 3 steps"), ("c", "no /arm-1 for 3 steps")]
    assert len(alike_findings(said)) == 3


def ingested(folder: Path) -> list[str]:
    (folder / "task.toml").write_text(TASK)
    words = ["ingest", str(folder / "logs"), "--task", str(folder / "task.toml"), "--into", str(folder / "data")]
    words += ["--workers", "1"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    return result.output.splitlines()


def test_an_ingest_of_many_copies_says_no_more_than_a_line_a_copy(tmp_path: Path) -> None:
    """Half of them byte for byte, half in other bytes; each has something to be said of."""
    (tmp_path / "logs").mkdir()
    said = [image(k / 10, index=k // 2) for k in range(20)]
    said += [joints(k / 10, ["hip"], [float(k)]) for k in range(5)]
    first = write_json_log(tmp_path / "logs/a0.mcap", said)
    for copy in range(1, 4):
        shutil.copy(first, tmp_path / f"logs/a{copy}.mcap")
        write_json_log(tmp_path / f"logs/b{copy}.mcap", said, chunk_size=1000 * copy)
    lines = ingested(tmp_path)
    assert "4 episodes ingested" in lines[0]
    assert len(lines) <= 7
    (masked,) = [line for line in lines if "masked" in line]
    assert masked.strip().startswith("a0: low_dim leg: missing")
    assert "b1, b2, b3" in masked
