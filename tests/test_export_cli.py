"""`vilp-data export` and `vilp-data card` as a user types them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.export_datasets import demonstration, plain_dataset, write
from vilp_data.cli import app
from vilp_data.errors import VilpDataError
from vilp_data.log_files import find_logs
from vilp_data.sources import open_log


def invoke(*words: str) -> str:
    """What the command prints; its VilpDataError is raised, as `main` would catch it."""
    ended = CliRunner().invoke(app, words, catch_exceptions=True)
    if isinstance(ended.exception, VilpDataError):
        raise ended.exception
    assert ended.exit_code == 0, ended.output
    return ended.stdout


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_what_is_exported_left_out_and_compared_is_said(tmp_path: Path) -> None:
    write(tmp_path / "data/arm", demonstration("good", 8, invalid=(3,)), demonstration("bad", 6, outcome="failure"))
    said = invoke("export", "--to", "lerobot")
    assert said.startswith("arm-lerobot: 2 episodes (2 on no side), 7 rows at 10 Hz; ")
    assert "view front: observation.images.front, H.264, yuv444p, CRF 18; PSNR " in said
    assert "read back: 14 frames decoded in order, row k against frame k" in said
    assert "left out, failures: 1 episode, such as bad" in said
    assert "masked steps: 1 in 1 episode; cut there" in said
    assert "no split was drawn" in said
    assert (tmp_path / "arm-lerobot" / "README.md").is_file()


def test_json_is_json_and_says_the_same(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data/arm")
    report = json.loads(invoke("export", "data/arm", "--to", "robomimic", "-o", "out", "--licence", "MIT", "--json"))
    assert (report["episodes"], report["sides"]) == (3, {"train": 2, "val": 1})
    assert report["bytes"] == sum(path.stat().st_size for path in Path("out").rglob("*") if path.is_file())
    assert "license: mit" in Path("out/README.md").read_text()
    card = json.loads(invoke("card", "data/arm", "-o", "page.md", "--json"))
    assert all(Path(path).is_file() for path in card.values())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["export", "nowhere", "--to", "lerobot"], "not a dataset"),
        (["export", "data/arm", "--to", "lerobot", "-o", "taken", "--force"], "mine.txt"),
        (["export", "data/arm", "--to", "robomimic", "--images", "png"], "keeps every pixel"),
        (["card", "nowhere"], "not a dataset"),
    ],
)
def test_wrong_use_ends_with_two_and_a_remedy(tmp_path: Path, words: list[str], said: str) -> None:
    plain_dataset(tmp_path / "data/arm")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").write_text("mine")
    with pytest.raises(VilpDataError, match=said) as raised:
        invoke(*words)
    assert raised.value.exit_code == 2


def test_a_format_that_is_not_written_is_refused_by_name(tmp_path: Path) -> None:
    ended = CliRunner().invoke(app, ["export", "data/arm", "--to", "webdataset"])
    assert ended.exit_code == 2
    assert "diffusion-policy" in ended.output


def test_the_folder_of_an_export_is_found_as_one_log(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data/arm")
    for to in ("lerobot", "robomimic", "diffusion-policy"):
        invoke("export", "data/arm", "--to", to, "-o", to)
        (path,) = find_logs([tmp_path / to]).logs
        with open_log(path) as log:
            assert len(log.episodes()) == 3


def test_a_card_never_replaces_a_page_that_somebody_wrote(tmp_path: Path) -> None:
    plain_dataset(tmp_path / "data/arm")
    page = tmp_path / "data/arm" / "README.md"
    invoke("card", "data/arm", "--licence", "MIT")
    invoke("card", "data/arm", "--licence", "CC0-1.0")  # its own page it may
    assert "license: cc0-1.0" in page.read_text()
    page.write_text("MY NOTES")
    with pytest.raises(VilpDataError, match="-o") as raised:
        invoke("card", "data/arm")
    assert raised.value.exit_code == 2
    assert page.read_text() == "MY NOTES"
    invoke("card", "data/arm", "--force")
    assert page.read_text().startswith("---")
