"""Latents: encoded once for each key, again when what they were made from changes, the same bytes after any crash."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.fake_encoder import BlockMeans, encode_all, install
from tests.faults import kill_moments, run_until_killed, tree
from tests.synthetic import write_zarr, zarr_task_spec
from vilp_data import latent_runs, latents, shards, staleness
from vilp_data.dataset_split import update_split
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import SplitError, StoreError, UsageError
from vilp_data.ingest import ingest_logs
from vilp_data.stats import ChannelStats
from vilp_data.types import F16, U8


@pytest.fixture(autouse=True)
def _restore_encoders(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for module in (latents, latent_runs, staleness):
        monkeypatch.setattr(module, "load_encoder", latents.load_encoder)
    yield
    latents._encoders.clear()
    latents._bare_rates.clear()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    log = write_zarr(tmp_path / "replay.zarr", episode_lengths=(12, 9, 20))
    ingest_logs([log.path], tmp_path / "data", zarr_task_spec(), workers=1)
    return tmp_path / "data"


def test_every_stored_frame_has_its_latent_in_its_place(root: Path) -> None:
    encoder = BlockMeans()
    install(encoder)
    done = encode_all(root)
    assert (done.shards, done.written, done.frames) == ({"top": 3}, {"top": 3}, 41)
    store = EpisodeStore(root)
    for entry in store.index():
        stored = shards.open_shard(latents.latents_path(root, "top", encoder.key, entry.id)).arrays["latents"]
        np.testing.assert_array_equal(stored, encoder.encode(store.read_frames("top", entry)))


def test_a_second_run_encodes_nothing_and_other_weights_encode_all_beside(root: Path) -> None:
    install(BlockMeans())
    encode_all(root)
    before = tree(root)
    assert encode_all(root).frames == 0
    assert tree(root) == before
    install(BlockMeans(gain=2.0))
    assert encode_all(root).frames == 41
    assert before.items() <= tree(root).items()


def test_a_new_episode_is_encoded_alone_and_said_to_be_new_to_the_encoder(root: Path, tmp_path: Path) -> None:
    update_split(root, ratio=0.9, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    install(BlockMeans(trained_on=frozenset(entry.key for entry in EpisodeStore(root).index())))
    assert encode_all(root).unseen == ()
    log = write_zarr(tmp_path / "more.zarr", episode_lengths=(6, 7, 8, 9), chunk_rows=5)
    ingest_logs([log.path], root, zarr_task_spec(), workers=1)
    update_split(root, ratio=0.9, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    done = encode_all(root)
    assert done.frames == 30
    assert done.unseen
    assert all(id.startswith("more-") for id in done.unseen)


def test_frames_that_change_make_their_latents_stale_and_no_others(root: Path) -> None:
    install(BlockMeans())
    encode_all(root)
    store = EpisodeStore(root)
    entry = store.index()[1]
    path = latents.latents_path(root, "top", BlockMeans().key, entry.id)
    header = shards.read_header(path).metadata
    header.pop("sha256")
    stale = shards.open_shard(path).arrays["latents"].copy()
    shards.write_shard(path, {"latents": stale}, header | {"source_frames_sha256": "of other frames"})
    assert "frames changed" in str(latents.stale_reason(root, entry, "top", BlockMeans().key))
    assert encode_all(root).frames == entry.n_frames["top"]


def test_statistics_are_of_the_training_episodes_alone(root: Path) -> None:
    install(BlockMeans())
    lock = update_split(root, ratio=0.6, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    encode_all(root)
    (path,) = (root / "latents" / "top" / BlockMeans().key).glob("stats-*.json")
    stats, _ = ChannelStats.from_json(path.read_bytes())
    train = [
        shards.open_shard(latents.latents_path(root, "top", BlockMeans().key, id)).arrays["latents"]
        for id in lock.ids("train")
    ]
    values = np.concatenate(train).astype(np.float64)
    np.testing.assert_allclose(stats.mean, values.mean(axis=(0, 2, 3)), rtol=1e-12)
    np.testing.assert_allclose(stats.std, values.std(axis=(0, 2, 3)), rtol=1e-9)


def test_a_split_changed_by_hand_stops_the_statistics_before_anything_is_encoded(root: Path) -> None:
    install(BlockMeans())
    update_split(root, ratio=0.6, ratio_from="task", seed=0, group_by=None, strata=(), redraw=False)
    path = root / "split.lock.json"
    path.write_bytes(path.read_bytes().replace(b'"val"', b'"train"'))
    with pytest.raises(SplitError, match="changed by hand"):
        encode_all(root)
    assert not (root / "latents").exists()


def test_latents_that_do_not_count_as_many_as_the_frames_are_made_again(root: Path) -> None:
    install(BlockMeans())
    encode_all(root)
    entry = EpisodeStore(root).index()[0]
    path = latents.latents_path(root, "top", BlockMeans().key, entry.id)
    shard = shards.read_shard(path)
    header = {name: value for name, value in shard.metadata.items() if name != "sha256"}
    shards.write_shard(path, {"latents": shard.arrays["latents"][:-1]}, header)
    with pytest.raises(StoreError, match="11 latents of 12 frames"):
        latents.open_latents(root, entry, "top", BlockMeans().key)
    assert encode_all(root).frames == 12


def test_an_encoder_that_shares_one_accelerator_gets_one_worker(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class OnAccelerator(BlockMeans):
        parallel = False

    asked: list[int] = []
    encode = latent_runs.encode_episodes

    def counting(jobs: Sequence[latents.LatentJob], *, workers: int) -> Iterator[object]:
        asked.append(workers)
        return encode(jobs, workers=1)

    monkeypatch.setattr(latent_runs, "encode_episodes", counting)
    for encoder in (OnAccelerator(), BlockMeans(gain=2.0)):
        install(encoder)
        encode_all(root, workers=2)
    assert asked == [1, 2]


def test_encoding_in_this_process_computes_on_one_thread_and_gives_the_others_back(root: Path) -> None:
    class Watching(BlockMeans):
        def encode(self, frames: U8) -> F16:
            threads.add(torch.get_num_threads())
            return super().encode(frames)

    threads: set[int] = set()
    install(Watching())
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        encode_all(root)
        assert (threads, torch.get_num_threads()) == ({1}, 2)
    finally:
        torch.set_num_threads(before)


def test_progress_counts_frames_up_to_all_of_them(root: Path) -> None:
    install(BlockMeans())
    told: list[tuple[int, int]] = []
    spec = EpisodeStore(root).spec()
    run = root / "runs" / "fake-run"
    latent_runs.encode_dataset(root, spec, "fake", run, workers=1, progress=lambda done, of, _: told.append((done, of)))
    assert [of for _, of in told] == [41, 41, 41]
    assert [done for done, _ in told] == [12, 21, 41]


def test_latents_beyond_float16_are_refused(root: Path) -> None:
    install(BlockMeans(gain=1e6))
    with pytest.raises(StoreError, match="cannot be stored"), np.errstate(over="ignore"):
        encode_all(root)
    assert not list((root / "latents").rglob("*.safetensors"))


def test_why_stale_names_the_part_of_the_key_that_changed(root: Path) -> None:
    (root / "runs" / "fake-run").mkdir(parents=True)
    install(BlockMeans())
    encode_all(root)
    assert staleness.stale_latents(root, EpisodeStore(root).spec()) == {}
    install(BlockMeans(gain=2.0))
    (reason,) = staleness.stale_latents(root, EpisodeStore(root).spec()).values()
    assert 'weights: "1" -> "2"' in reason
    assert "vilp-data latents --run" in reason


@pytest.mark.parametrize("name", ["fake", "my_own_run"])
def test_why_stale_looks_into_runs_of_any_name(root: Path, name: str) -> None:
    (root / "runs" / name).mkdir(parents=True)
    install(BlockMeans())
    (reason,) = staleness.stale_latents(root, EpisodeStore(root).spec()).values()
    assert "not encoded yet" in reason


def test_why_stale_passes_over_the_runs_of_other_models(root: Path) -> None:
    (root / "runs" / "planner-cpu").mkdir(parents=True)
    assert staleness.stale_latents(root, EpisodeStore(root).spec()) == {}


def test_the_run_to_use_is_the_only_one_or_must_be_named(root: Path) -> None:
    with pytest.raises(UsageError, match="which fake run"):
        latent_runs.find_run(root, None, "fake")
    (root / "runs" / "fake-a").mkdir(parents=True)
    assert latent_runs.find_run(root, None, "fake").name == "fake-a"
    (root / "runs" / "fake-b").mkdir()
    with pytest.raises(UsageError, match="fake-a.*fake-b"):
        latent_runs.find_run(root, None, "fake")


def test_an_encoder_that_is_not_installed_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'vqgan'"):
        latents.load_encoder("vqgn", Path("x"), "top")


ENCODE = """
import sys
from pathlib import Path
from tests.fake_encoder import BlockMeans, encode_all, install
install(BlockMeans())
encode_all(Path(sys.argv[1]))
"""


@pytest.mark.parametrize("nth", kill_moments(few=3, many=12))
def test_encoding_killed_at_any_moment_and_run_again_gives_the_same_bytes(root: Path, nth: int) -> None:
    install(BlockMeans())
    run_until_killed(ENCODE, [str(root)], nth=nth)
    encode_all(root)
    after_the_kill = tree(root)
    for path in (root / "latents").rglob("*.safetensors"):
        path.unlink()
    encode_all(root)
    assert tree(root) == after_the_kill
