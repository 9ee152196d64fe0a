"""Generated videos: what they hold, and how they are written."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.models.conftest import VIEWS
from tests.models.encoded_cards import DECODERS, ENCODER, WINDOW, futures, write_card_latents
from tests.models.fake_planner import FakePlanner
from tests.synthetic import psnr
from tests.test_mp4 import read_mp4
from tests.test_viewer import column, entities, raw_frames
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_models.generate import Generated, imagine_clips, imagine_long, sheet, video_frames, write_generated
from vilp_models.imagined import Imagination


@pytest.fixture
def known(store: EpisodeStore) -> Imagination:
    """Planners that know the future."""
    write_card_latents(store)
    planners = {view: FakePlanner(view, futures=futures(store, view)) for view in VIEWS}
    return Imagination(planners, WINDOW.n_plan_frames)


def clip(store: EpisodeStore, imagination: Imagination) -> Generated:
    return next(imagine_clips(store, imagination, DECODERS, store.index()[2:], WINDOW, n_clips=1))


def test_a_clip_holds_the_present_and_the_planned_frames(store: EpisodeStore, known: Imagination) -> None:
    clips = list(imagine_clips(store, known, DECODERS, store.index()[2:], WINDOW, n_clips=3))
    assert [(one.episode, one.step) for one in clips] == [("c", 0), ("d", 0), ("d", 5)]
    for one in clips:
        for view, video in one.views.items():
            real = store.read(one.episode).frames[view][one.step : one.step + 7 : 2]
            np.testing.assert_array_equal(video.real, real)
            np.testing.assert_array_equal(video.reconstructed, ENCODER.decode(ENCODER.encode(real)))
            np.testing.assert_array_equal(video.imagined, video.reconstructed)  # it knows the future


def test_a_long_video_feeds_its_last_frame_back(store: EpisodeStore) -> None:
    latents = write_card_latents(store)
    planners = {view: FakePlanner(view, noise=40.0) for view in VIEWS}
    imagination = Imagination(planners, WINDOW.n_plan_frames)
    long = imagine_long(store, imagination, DECODERS, store.entry("c"), WINDOW, n_frames=7)
    assert long.n_frames == 8
    assert long.n_recorded == 6  # steps 0, 2 … 10 of 12
    assert planners["front"].calls == 3
    for view, video in long.views.items():
        now = latents[view]["c"][:1]
        for first in (0, 3, 6):
            named = [("c", 2 * first)]
            given = {v: ENCODER.decode(now) for v in VIEWS}
            plan = imagination.samples(
                given, dict.fromkeys(VIEWS, now), np.zeros((1, 1), np.float32), names=named, n_samples=1
            )[view][0, 0]
            frames = ENCODER.decode(plan)
            shown = video.imagined[first + 1 : first + 4]
            np.testing.assert_array_equal(shown, frames[: len(shown)])
            now = ENCODER.encode(frames[-1:])
        for held in (6, 7):
            np.testing.assert_array_equal(video.real[held], store.read("c").frames[view][-1])
        assert np.isnan(long.psnr[view][[0, 6, 7]]).all()
        assert np.isfinite(long.psnr[view][1:6]).all()


def test_a_long_video_by_a_planner_that_sees_low_dim_is_refused(store: EpisodeStore) -> None:
    write_card_latents(store)
    imagination = Imagination({"front": FakePlanner("front", sees_low_dim=True)}, WINDOW.n_plan_frames)
    with pytest.raises(UsageError, match=r"without low_dim(.|\n)*view 'front'(.|\n)*low_dim = false"):
        imagine_long(store, imagination, DECODERS, store.entry("c"), WINDOW, n_frames=4)


def test_the_video_shows_every_panel_of_every_view_at_real_speed(
    store: EpisodeStore, known: Imagination, tmp_path: Path
) -> None:
    one = clip(store, known)
    paths = write_generated(one, tmp_path / "generated", "c-0")
    assert [path.name for path in paths] == ["c-0.mp4", "c-0.png", "c-0.rrd"]
    shown = video_frames(one)
    assert shown.shape == (4, 2 * (18 + 18 + 192), 4 * 288, 3)
    np.testing.assert_array_equal(shown[2, 36 : 36 + 192 : 6, :288:6], one.views["front"].real[2])
    np.testing.assert_array_equal(shown[2, 36 : 36 + 192 : 6, 576:864:6], one.views["front"].imagined[2])
    np.testing.assert_array_equal(shown[2, -192::6, 864::6], one.views["side"].error[2])
    back = read_mp4(paths[0])
    assert psnr(back[2], shown[2]) > 25
    assert cv2.VideoCapture(str(paths[0])).get(cv2.CAP_PROP_FPS) == 5  # 10 steps a second, every second one


def test_the_sheet_has_a_column_for_each_frame(store: EpisodeStore, known: Imagination, tmp_path: Path) -> None:
    one = clip(store, known)
    picture = sheet(one)
    first = picture[18 + 18 :][: 2 * 32 : 2, 96::2]
    np.testing.assert_array_equal(first, np.concatenate(one.views["front"].real, axis=1))
    paths = write_generated(one, tmp_path, "c-0")
    np.testing.assert_array_equal(cv2.imread(str(paths[1]))[..., ::-1], picture)


def test_the_recording_holds_every_panel_and_the_psnr(store: EpisodeStore, known: Imagination, tmp_path: Path) -> None:
    one = clip(store, known)
    rrd = write_generated(one, tmp_path, "c-0")[2]
    names = {name.replace("\\", "") for name in entities(rrd)}
    assert {f"{view}/{name}" for view in VIEWS for name in ("real", "imagined", "error x4", "psnr")} <= names
    for view in VIEWS:
        drawn = raw_frames(rrd, f"{view}/imagined", 32, 48)
        np.testing.assert_array_equal(drawn, one.views[view].imagined)
        lines = np.array(column(rrd, f"{view}/psnr", "Scalars:scalars"), float)
        np.testing.assert_allclose(lines[1:, 0], one.psnr[view][1:])
        assert np.isnan(lines[0, 0])
