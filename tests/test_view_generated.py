"""Truth against dream: what a recording and a page of a generated episode show."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from typer.testing import CliRunner

from tests.generated_episodes import PLAN_STEP, STEP, generated_dataset
from tests.stored_episodes import VIEWS
from tests.synthetic import psnr
from tests.test_mp4 import read_mp4
from tests.test_viewer import column, encoded_frames, entities
from vilp_data.cli import app
from vilp_data.contact_sheet import error_image
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.generated_episode import GeneratedEpisode, generated_path
from vilp_data.viewer import canvas as viewer_canvas
from vilp_data.viewer.canvas import TIMELINE
from vilp_data.viewer.generated import PANELS, draw_generated
from vilp_data.viewer.generated_page import write_generated_page


def recorded(store: EpisodeStore, made: GeneratedEpisode, view: str) -> np.ndarray:
    stored = store.read(made.episode)
    return stored.frames[view][stored.source_index[view][made.step]]


def times(rrd: Path, entity: str) -> list[int]:
    chunks = [chunk for chunk in RrdReader(rrd).stream() if chunk.entity_path == f"/{entity}" and not chunk.is_static]
    return sorted(t for chunk in chunks for t in chunk.to_record_batch().column(TIMELINE).cast("int64").to_pylist())


# --- a recording -------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["in one", "in pieces"])
def pieces(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Short recordings, and ones so long that they do not stay in memory."""
    if request.param == "in pieces":
        monkeypatch.setattr(viewer_canvas, "FLUSH_BYTES", 1000)
        monkeypatch.setattr(viewer_canvas, "SPILL_BYTES", 2000)


@pytest.mark.usefixtures("pieces")
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_each_panel_holds_its_frames_to_the_byte_at_the_same_times(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path / "data")
    drawn = draw_generated(store, made, tmp_path / "a.rrd")
    for view in VIEWS:
        real = recorded(store, made, view)
        shown = (real, made.reconstructed[view], made.imagined[view], error_image(real, made.imagined[view]))
        for name, frames in zip(PANELS, shown, strict=True):
            np.testing.assert_array_equal(np.stack(encoded_frames(drawn.rrd, f"{view}/{name}")), frames)
            assert times(drawn.rrd, f"{view}/{name}") == list(STEP)  # the episode's clock counts steps
    assert {path.name for path in tmp_path.iterdir()} == {"a.rrd", "data"}


@pytest.mark.usefixtures("pieces")
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_curves_break_and_are_marked_where_it_looked_again(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path / "data")
    rrd = draw_generated(store, made, tmp_path / "a.rrd").rrd
    values = [row[0] for row in column(rrd, "front/psnr/imagined", "Scalars:scalars")]
    np.testing.assert_array_equal(values, [20, 21, np.nan, 22, 23, np.nan, 24])
    assert [row[0] for row in column(rrd, "front/psnr/looked", "Scalars:scalars")] == [20, 22, 24]
    assert [row[0] for row in column(rrd, "side/lpips/reconstructed", "Scalars:scalars")] == pytest.approx(
        [0.40, 0.41, 0.42, 0.43, 0.44]
    )
    assert times(rrd, "action/looked") == list(PLAN_STEP)


def test_predicted_actions_lie_beside_the_recorded_ones(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path / "data")
    rrd = draw_generated(store, made, tmp_path / "a.rrd").rrd
    truth = store.read(made.episode).action
    assert truth is not None
    np.testing.assert_array_equal(np.array(column(rrd, "action/recorded", "Scalars:scalars"), np.float32), truth)
    predicted = np.array(column(rrd, "action/predicted", "Scalars:scalars"), np.float32)
    np.testing.assert_array_equal(predicted[np.isfinite(predicted).all(axis=1)], made.action)
    assert len(predicted) == len(truth) + len(PLAN_STEP) - 1


def test_without_lpips_there_is_no_such_curve(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path / "data")
    rrd = draw_generated(store, replace(made, lpips={}), tmp_path / "a.rrd").rrd
    assert not [name for name in entities(rrd) if "lpips" in name]


LIMITED = """
import resource, sys
from pathlib import Path
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import StoreError
from vilp_data.generated_episode import open_generated_episode
from vilp_data.viewer import canvas
from vilp_data.viewer.generated import draw_generated
canvas.FLUSH_BYTES, canvas.SPILL_BYTES = 1000, 2000
store = EpisodeStore(Path(sys.argv[1]))
made = open_generated_episode(store, Path(sys.argv[1]) / "generated" / "planner-x", sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
try:
    draw_generated(store, made, Path(sys.argv[3]))
except StoreError as error:
    print(error.what)
"""


def test_a_disk_that_fills_up_under_a_long_recording_is_a_plain_error_and_leaves_nothing(tmp_path: Path) -> None:
    _, made = generated_dataset(tmp_path / "data")
    (tmp_path / "out").mkdir()
    arguments = [str(tmp_path / "data"), made.episode, str(tmp_path / "out" / "a.rrd")]
    ended = subprocess.run(
        [sys.executable, "-c", LIMITED, *arguments], capture_output=True, text=True, check=True, timeout=120
    )
    assert "cannot be written" in ended.stdout
    assert list((tmp_path / "out").iterdir()) == []


# --- a page ------------------------------------------------------------------------------------------------------------


def page_of(tmp_path: Path) -> tuple[EpisodeStore, GeneratedEpisode, str]:
    store, made = generated_dataset(tmp_path / "data")
    write_generated_page(tmp_path / "a.html", store, made)
    return store, made, (tmp_path / "a.html").read_text(encoding="utf-8")


def test_a_clip_of_each_view_shows_the_panels_side_by_side_at_real_speed(tmp_path: Path) -> None:
    store, made, page = page_of(tmp_path)
    clips = re.findall(r'src="data:video/mp4;base64,([A-Za-z0-9+/=]+)"', page)
    assert len(clips) == len(VIEWS)
    for view, clip in zip(made.views, clips, strict=True):
        (tmp_path / "a.mp4").write_bytes(base64.b64decode(clip))
        back = read_mp4(tmp_path / "a.mp4")
        assert back.shape == (len(STEP), 192, 4 * 16 * 24, 3)
        for number, panel in enumerate((recorded(store, made, view), made.reconstructed[view], made.imagined[view])):
            shown = back[:, 12::24, number * 384 + 12 : (number + 1) * 384 : 24]
            assert psnr(shown, panel) > 25  # random pixels through 4:2:0 at 24 x their size
    assert '"fps":5.0' in page  # ten steps a second, every second one


def test_the_page_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    _, _, page = page_of(tmp_path)
    assert not re.findall(r'(?:src|href|url)\s*[=(]\s*["\']?(?!data:)[^"\']*//', page)
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", page)


def test_curves_of_the_page_break_at_plans(tmp_path: Path) -> None:
    _, _, page = page_of(tmp_path)
    paths = re.findall(r'<path class="imagined" d="([^"]+)"/>', page)
    assert len(paths) == 2 * len(VIEWS)  # PSNR and LPIPS
    assert {path.count("M") for path in paths} == {3}
    assert {path.count("M") for path in re.findall(r'<path class="mark" d="([^"]+)"/>', page)} == {3}
    assert {path.count("M") for path in re.findall(r'<path class="predicted" d="([^"]+)"/>', page)} == {3}


def test_means_are_told_by_how_far_ahead(tmp_path: Path) -> None:
    _, _, page = page_of(tmp_path)
    rows = [re.findall(r"<td>([^<]*)</td>", row) for row in re.findall(r"<tr[^>]*>(.*?)</tr>", page)]
    assert ["2 (0.2 s)", "3", "42.0", "22.0", "0.420", "0.220"] in rows
    assert ["4 (0.4 s)", "2", "42.0", "22.0", "0.420", "0.220"] in rows
    assert ["all", "5", "42.0", "22.0", "0.420", "0.220"] in rows


def test_every_action_has_its_error(tmp_path: Path) -> None:
    _, made, page = page_of(tmp_path)
    rows = [re.findall(r"<td>([^<]*)</td>", row) for row in re.findall(r"<tr[^>]*>(.*?)</tr>", page)]
    errors = [row for row in rows if len(row) == 4 and row[3] == "11"]
    assert [float(row[1]) for row in errors] == [0.5] * made.action.shape[1]


@pytest.mark.filterwarnings("error")
def test_what_nothing_is_known_of_is_a_dash(tmp_path: Path) -> None:
    store, made = generated_dataset(tmp_path / "data")
    psnr = {kind: {view: np.full_like(of, np.nan) for view, of in m.items()} for kind, m in made.psnr_db.items()}
    unknown = replace(made, action=np.full_like(made.action, np.nan), psnr_db=psnr)
    write_generated_page(tmp_path / "a.html", store, unknown)
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    rows = [re.findall(r"<td>([^<]*)</td>", row) for row in re.findall(r"<tr[^>]*>(.*?)</tr>", page)]
    errors = [row[1:] for row in rows if len(row) == 4]
    assert errors == [["–", "–", "0"]] * made.action.shape[1]
    assert ["all", "5", "–", "–", "0.420", "0.220"] in rows
    assert "<b>–</b>dB PSNR, imagined" in page
    assert "nan" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", page)


# --- the command -------------------------------------------------------------------------------------------------------


def run(*words: object) -> str:
    ended = CliRunner().invoke(app, ["view", *map(str, words)], catch_exceptions=False)
    assert ended.exit_code == 0, ended.output
    return ended.output


def test_a_page_or_a_recording_needs_no_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _, made = generated_dataset(tmp_path / "data")
    asked = ("--generated", "planner-x", made.episode, "--data", tmp_path / "data")
    assert "opens in any browser" in run(*asked, "--html", tmp_path / "a.html")
    assert "saved" in run(*asked, "--save", tmp_path / "a.rrd", "--html", tmp_path / "b.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_the_first_of_several_is_shown_and_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _, made = generated_dataset(tmp_path / "data")
    folder = tmp_path / "data" / "generated" / "planner-x"
    shutil.copy(generated_path(folder, made.episode), generated_path(folder, "zzz"))
    words = ("--generated", "planner-x", "--data", tmp_path / "data", "--html", tmp_path / "a.html")
    assert f"2 episodes, showing {made.episode}" in run(*words)


@pytest.mark.parametrize("words", [[], ["episode", "--html", "a.html"]])
def test_wrong_use_is_answered(words: list[str]) -> None:
    error = CliRunner().invoke(app, ["view", *words]).exception
    assert isinstance(error, UsageError)
    assert "--generated" in str(error)
