"""Render: Push-T drawn from recorded states matches the data's frames, and a wrong channel, row or step does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.pusht_human import N_EPISODES, human_episode, simulator
from vilp_data.errors import UsageError
from vilp_models.replay import RENDER_MIN_DB, format_render, render_match

pytestmark = pytest.mark.sim

EVERY = 5


def with_frames(episode, frames):
    return replace(episode, frames={"top": np.ascontiguousarray(frames)})


@pytest.mark.parametrize("number", [0, 40, 100, 205])
def test_drawing_recorded_states_gives_the_stored_frames(number):
    report = render_match(human_episode(number), simulator(), every=EVERY)
    assert min(report.psnr_db["top"]) >= RENDER_MIN_DB
    assert np.median(report.psnr_db["top"]) > 60  # most are equal byte for byte
    assert report.proves()
    assert ": matches at 40 dB" in format_render(report)[0]


@pytest.mark.parametrize(
    ("damage", "at_most_db"),
    [
        pytest.param(lambda frames: frames[..., ::-1], 30, id="red and blue swapped"),
        pytest.param(lambda frames: frames[:, ::-1], 25, id="upside down"),
        pytest.param(lambda frames: frames[:, :, ::-1], 25, id="mirrored"),
    ],
)
def test_damaged_frames_fail_at_every_step(damage, at_most_db):
    episode = human_episode(0)
    report = render_match(with_frames(episode, damage(episode.frames["top"])), simulator(), every=EVERY)
    assert max(report.psnr_db["top"]) < at_most_db
    assert not report.proves()
    assert "does NOT match" in format_render(report)[0]


@pytest.mark.parametrize("shift", [-1, 1])
def test_frames_stored_one_step_off_fail(shift):
    episode = human_episode(0)
    steps = np.clip(np.arange(episode.n_steps) + shift, 0, episode.n_steps - 1).astype(np.int32)
    report = render_match(replace(episode, source_index={"top": steps}), simulator(), every=EVERY)
    assert min(report.psnr_db["top"]) < 30
    assert not report.proves()


def test_a_view_the_simulator_does_not_draw_is_refused():
    episode = human_episode(0)
    with pytest.raises(UsageError, match="no view 'side'"):
        render_match(
            replace(
                episode, frames={"side": episode.frames["top"]}, source_index={"side": episode.source_index["top"]}
            ),
            simulator(),
        )
    with pytest.raises(UsageError, match="another size"):
        render_match(with_frames(episode, episode.frames["top"][:, ::2, ::2]), simulator())


@pytest.mark.slow
def test_every_human_frame_is_drawn_as_stored():
    env = simulator()
    reports = [render_match(human_episode(number), env) for number in range(N_EPISODES)]
    scores = np.concatenate([report.psnr_db["top"] for report in reports])
    off = np.concatenate([report.next_step_db["top"] for report in reports])
    print(f"{len(scores)} frames: worst {scores.min():.1f} dB, equal {np.mean(scores == 100):.1%}")
    print(
        f"one step off: median {np.median(off):.1f} dB, {np.mean(off < RENDER_MIN_DB):.1%} below {RENDER_MIN_DB:g} dB"
    )
    assert all(report.proves() for report in reports)
