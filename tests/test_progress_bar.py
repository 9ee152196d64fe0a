"""Long work says that it goes on, also where nobody looks at a bar."""

from __future__ import annotations

import pytest

from vilp_data.cli import options


def test_without_a_terminal_progress_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(options, "LINE_EVERY_S", 0.0)
    with options.progress_bar("imagining", None) as advance:
        advance(3, 200)
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "imagining: 3 of 200\n")


def test_short_work_says_nothing_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with options.progress_bar("imagining", 2) as advance:
        advance(1)
        advance(2)
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "")
