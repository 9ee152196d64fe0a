"""What a check prints and writes: text, JSON, one page that needs nothing else; exit codes."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.faulty_logs import write_faulty
from vilp_data.check.findings import Finding, Place, grouped, verdict, worst_first
from vilp_data.check.page import page
from vilp_data.check.sources import check_sources
from vilp_data.check.text import format_report
from vilp_data.cli import app
from vilp_data.errors import StoreError

VOID = {"meta", "img", "br", "line", "rect", "polygon", "polyline", "link"}


def check(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["check", "--workers", "1", *arguments])
    return result.exit_code, result.stdout


class _Balanced(HTMLParser):
    """Every tag is closed, in order; nothing is fetched from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in ("script", "link", "iframe"), tag
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "srcset")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


def test_errors_end_with_1_warnings_with_0_wrong_use_with_2(tmp_path: Path) -> None:
    assert check(str(write_faulty(tmp_path / "good.mcap")))[0] == 0
    assert check(str(write_faulty(tmp_path / "gap.mcap", gap=(5.0, 7.0))))[0] == 0
    assert check(str(write_faulty(tmp_path / "jump.mcap", clock_back=(5.0, 30.0))))[0] == 1
    result = CliRunner().invoke(app, ["check", str(tmp_path / "none.mcap")])
    assert getattr(result.exception, "exit_code", None) == 2


def test_text_names_the_place_the_evidence_and_the_remedy_and_ends_with_the_verdict(tmp_path: Path) -> None:
    code, text = check(str(write_faulty(tmp_path / "bad.mcap", gap=(8.0, 10.0), clock_back=(15.0, 30.0))))
    assert code == 1
    assert text.index("ERROR") < text.index("WARNING")
    assert re.search(r"WARNING /joint_states, 8\.00 to 10\.00 s\n +silent for 2\.00 s", text)
    assert "-> read it by its arrival" in text
    assert text.rstrip().endswith(verdict(check_sources([tmp_path / "bad.mcap"]).findings))


def test_json_holds_every_finding_and_figure(tmp_path: Path) -> None:
    _, text = check(str(write_faulty(tmp_path / "bad.mcap", gap=(8.0, 10.0))), "--json")
    report = json.loads(text)
    (gap,) = (finding for finding in report["findings"] if finding["kind"] == "gap")
    assert gap["severity"] == "warning"
    assert gap["place"]["topic"] == "/joint_states"
    assert gap["place"]["start_s"] == pytest.approx(8.0, abs=0.01)
    assert gap["evidence"]["gap_s"] == pytest.approx(2.0, abs=0.01)
    rates = {topic["name"]: topic["rate_hz"] for topic in report["checked"][0]["topics"]}
    assert rates["/joint_states"] == pytest.approx(20.0, rel=0.01)
    assert report["action_fits"][0]["best_shift"] == 0


def test_the_page_is_whole_and_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    log = write_faulty(tmp_path / "bad <b>&.mcap", gap=(8.0, 10.0), black=(12.0, 15.0), action_late=1, drift_s=0.1)
    assert check(str(log), "--html", str(tmp_path / "out" / "page.html"))[0] == 0
    text = (tmp_path / "out" / "page.html").read_text()
    parser = _Balanced()
    parser.feed(text)
    assert parser.open == []
    assert parser.sources
    assert all(source.startswith("data:image/jpeg;base64,") for source in parser.sources)
    assert "http" not in re.sub(r"data:image/jpeg;base64,[^\"]*", "", text)
    assert "url(" not in text
    assert "bad &lt;b&gt;&amp;.mcap" in text
    assert "<b>&" not in text
    assert text.count("<svg") >= 4
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text


def test_a_place_where_no_page_can_be_is_said_before_anything_is_checked(tmp_path: Path) -> None:
    log = write_faulty(tmp_path / "run.mcap", duration_s=2)
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path, tmp_path / "file" / "page.html"):
        result = CliRunner().invoke(app, ["check", str(log), "--html", str(place)])
        assert getattr(result.exception, "exit_code", None) == 2
        assert result.stdout == ""


def test_a_page_that_cannot_be_written_costs_none_of_the_findings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(path: Path, data: bytes) -> None:
        raise StoreError("cannot be written", where=path, found="No space left on device")

    log = write_faulty(tmp_path / "run.mcap", gap=(8.0, 10.0))
    monkeypatch.setattr("vilp_data.shards.write_atomic", full_disk)
    result = CliRunner().invoke(app, ["check", "--workers", "1", str(log), "--html", str(tmp_path / "page.html")])
    assert getattr(result.exception, "exit_code", None) == 1
    assert "silent for 2.00 s" in result.stdout


def test_a_page_of_nothing_readable_is_still_a_page(tmp_path: Path) -> None:
    (tmp_path / "junk.mcap").write_bytes(b"")
    parser = _Balanced()
    parser.feed(page(check_sources([tmp_path / "junk.mcap"])))
    assert parser.open == []


def test_logs_of_one_folder_are_told_by_their_names(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_faulty(tmp_path / f"{name}.mcap", seed=ord(name), gap=(8.0, 10.0))
    text = format_report(check_sources([tmp_path]))
    assert "WARNING a.mcap, /joint_states, 8.00 to 10.00 s" in text
    assert "also b.mcap, /joint_states" in text


def test_findings_are_grouped_worst_first() -> None:
    def finding(severity: str, kind: str, topic: str) -> Finding:
        return Finding(severity=severity, kind=kind, place=Place(topic=topic), what="")  # type: ignore[arg-type]

    found = [
        finding("note", "x", "1"),
        finding("warning", "y", "2"),
        finding("error", "x", "3"),
        finding("warning", "y", "4"),
    ]
    assert [f.place.topic for f in worst_first(found)] == ["3", "2", "4", "1"]
    groups = grouped(found)
    assert [(group.first.kind, [f.place.topic for f in group.findings]) for group in groups] == [
        ("x", ["3"]), ("y", ["2", "4"]), ("x", ["1"]),
    ]  # fmt: skip
    assert verdict(found) == "1 error, 2 warnings, 1 note"
    assert verdict([]) == "nothing to complain about"
