"""A depth view through the whole line: log, frames of one channel, a VQGAN of its own, latents, report, models, viewer."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from rerun.chunk import RrdReader

from tests.models.conftest import tiny_recipe
from tests.stored_episodes import write_split
from tests.synthetic import START_NS, card_frame
from tests.video_logs import DEPTH, PERIOD_NS, Row, joints, spec_of, write_log
from vilp_data import viewer
from vilp_data.dataset_split import read_split
from vilp_data.decode.depth import level_metres
from vilp_data.episodes import EpisodeStore
from vilp_data.errors import UsageError
from vilp_data.ingest import ingest_logs
from vilp_data.keys import first_difference
from vilp_data.latent_runs import encode_dataset
from vilp_data.spec import DepthSpec, TaskSpec
from vilp_models.contract import DataContract
from vilp_models.fidelity import fidelity_report
from vilp_models.fidelity_page import write_report
from vilp_models.low_level import LowLevelPolicy
from vilp_models.planner import Planner
from vilp_models.recipe import BcRecipe, PlannerRecipe, PolicyRecipe, load_recipe
from vilp_models.train import train_vqgan
from vilp_models.vqgan import load_frame_encoder

HEIGHT, WIDTH, STEPS = 32, 48, 12
NEAR_M, FAR_M = 0.4, 2.4
CAMERA = "/camera/rgb"


def depth_image(index: int) -> npt.NDArray[np.uint16]:
    """Millimetres: a slope from 1 m to 2 m, no reading in the left columns, a box at 0.6 m that moves right."""
    image = np.tile(np.linspace(1000, 2000, WIDTH).astype(np.uint16), (HEIGHT, 1))
    image[:, :4] = 0
    left = 6 + 2 * index % (WIDTH - 16)
    image[10:22, left : left + 10] = 600
    return image


def write_camera_log(path: Path, number: int) -> Path:
    """A camera of pictures and one of distances."""
    rows = []
    for i in range(STEPS):
        colour, distance = card_frame(i + 3 * number, HEIGHT, WIDTH), depth_image(i + 3 * number)
        size = {"height": HEIGHT, "width": WIDTH}
        rgb = RawImage(encoding="rgb8", step=3 * WIDTH, data=colour.tobytes(), **size)
        mm = RawImage(encoding="16UC1", step=2 * WIDTH, data=distance.astype("<u2").tobytes(), **size)
        rows += [Row(START_NS + i * PERIOD_NS, CAMERA, rgb), Row(START_NS + i * PERIOD_NS, DEPTH, mm)]
    return write_log(path, [*rows, *joints(STEPS, first_s=number)])


def depth_spec(**depth: object) -> TaskSpec:
    table = spec_of(CAMERA, height=HEIGHT, width=WIDTH).model_dump(by_alias=True)
    told = {"unit": "mm", "near_m": NEAR_M, "far_m": FAR_M} | depth
    table["views"]["depth"] = {"topic": DEPTH, "height": HEIGHT, "width": WIDTH, "depth": told}
    table["window"] = {"n_plan_frames": 2, "frame_stride": 2}
    return TaskSpec.model_validate(table)


class Line(NamedTuple):
    store: EpisodeStore
    spec: TaskSpec
    run: Path
    logs: list[Path]


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> Line:
    folder = tmp_path_factory.mktemp("line")
    spec = depth_spec()
    logs = [write_camera_log(folder / f"run{n}.mcap", n) for n in range(3)]
    root = folder / "dataset"
    report = ingest_logs(logs, root, spec, workers=1)
    assert len(report.written) == 3, report.failed
    write_split(root, ratio=0.67)
    recipe, ids = tiny_recipe(share_views=True, discriminator_weight=0.5), read_split(root).ids("train")
    train_vqgan(root, spec, recipe, folder / "run", train_episodes=ids, split_hash="", show=False)
    encode_dataset(root, spec, "vqgan", folder / "run", workers=1)
    return Line(EpisodeStore(root), spec, folder / "run", logs)


def test_stored_levels_are_the_distances_of_the_log(line: Line) -> None:
    for number, entry in enumerate(line.store.index()):
        levels = line.store.read(entry.id).frames["depth"]
        assert levels.shape == (STEPS, HEIGHT, WIDTH, 1)
        depth = line.spec.views["depth"].depth
        assert depth is not None
        found = level_metres(levels, depth)[..., 0]
        for i in range(STEPS):
            image = depth_image(i + 3 * number)
            expected = np.where(image == 0, np.nan, image / 1000)
            np.testing.assert_allclose(found[i], expected, atol=(FAR_M - NEAR_M) / 254 / 2 + 1e-6)


def test_pictures_and_depth_have_a_vqgan_each_though_views_share(line: Line) -> None:
    assert sorted(path.name for path in line.run.iterdir()) == ["camera", "depth"]
    encoder, other = load_frame_encoder(line.run, "depth"), load_frame_encoder(line.run, "camera")
    assert (encoder.image_channels, other.image_channels) == (1, 3)
    assert encoder.key_fields["image_channels"] == "1"
    assert "image_channels" not in other.key_fields  # whose latents keep the key that they had
    frames = line.store.read("run0").frames
    assert encoder.decode(encoder.encode(frames["depth"])).shape == frames["depth"].shape
    with pytest.raises(UsageError, match="1 channels, a VQGAN of 3"):
        other.encode(frames["depth"])


def test_a_fidelity_report_measures_and_shows_depth(line: Line, tmp_path: Path) -> None:
    report = fidelity_report(line.store, line.run, read_split(line.store.root).ids("val"))
    depth = next(view for view in report.views if view.view == "depth")
    assert np.isfinite(depth.lpips)
    assert depth.total("vqgan").moving_count > 0
    pages = write_report(report, tmp_path, {})
    assert all(path.stat().st_size for path in pages)


def test_networks_see_as_many_channels_as_a_view_has(line: Line) -> None:
    keys = {view: load_frame_encoder(line.run, view).key for view in line.spec.views}
    contract = DataContract.of(line.store.root, line.spec, train=line.store.index(), latent_keys=keys)
    assert {view: contract.image_channels(view) for view in contract.views} == {"camera": 3, "depth": 1}
    policy = LowLevelPolicy(load_recipe(PolicyRecipe, "policy", {}, preset="tiny", where="test"), contract)
    planner = Planner(load_recipe(PlannerRecipe, "planner", {}, preset="tiny", where="test"), contract, "depth")
    assert {net.stem[0].in_channels for net in policy.vision.values()} == {1, 3}  # type: ignore[union-attr]
    assert planner is not None
    assert load_recipe(BcRecipe, "bc", {}, preset="tiny", where="test") is not None


@pytest.mark.parametrize("change", [{"far_m": 3.0}, {"unit": "m"}, {"near_m": 0.1}])
def test_another_depth_is_another_ingest_and_another_contract(line: Line, change: dict[str, object]) -> None:
    other = depth_spec(**change)
    (name,) = change
    difference = first_difference(line.spec.ingest_fields(), other.ingest_fields())
    assert difference is not None
    assert difference.startswith(f"views.depth.depth.{name}")
    contract = DataContract.of(line.store.root, line.spec, train=line.store.index())
    with pytest.raises(UsageError, match="depth"):
        contract.require_same(contract.as_said_by(other), where="run")
    assert DataContract.from_json(contract.to_json()) == contract


def test_a_contract_of_before_there_was_depth_is_one_without(line: Line) -> None:
    table = DataContract.of(line.store.root, line.spec, train=line.store.index()).to_json()
    del table["depth"]
    assert DataContract.from_json(table).depth == {}


def test_views_without_depth_have_the_ingest_fields_that_they_had() -> None:
    spec = spec_of(CAMERA)
    fields = {"topic", "clock", "offset_s", "stale_after_s", "height", "width", "fit"}
    assert set(spec.ingest_fields()["views"]["camera"]) == fields
    assert set(spec.model_dump()["views"]["camera"]) == fields


def test_the_viewer_shows_an_episode_and_its_log(line: Line, tmp_path: Path) -> None:
    encoders = {view: load_frame_encoder(line.run, view) for view in line.spec.views}
    drawn = viewer.draw_episode(line.store, "run0", tmp_path / "episode.rrd", encoders=encoders)
    assert drawn.notes == ()
    shown = {chunk.entity_path for chunk in RrdReader(drawn.rrd).stream()}
    assert {"/depth/real", "/depth/reconstructed", "/depth/error"} <= shown
    drawn = viewer.draw_log(line.logs[0], tmp_path / "log.rrd")
    assert drawn.notes == ()
    assert {"/camera/depth", "/camera/rgb"} <= {chunk.entity_path for chunk in RrdReader(drawn.rrd).stream()}


def test_a_depth_topic_read_as_a_picture_is_refused_with_the_table_that_it_needs(line: Line, tmp_path: Path) -> None:
    spec = spec_of(DEPTH, height=HEIGHT, width=WIDTH)
    report = ingest_logs(line.logs[:1], tmp_path / "dataset", spec, workers=1)
    ((_, why),) = report.failed
    assert "depth = { unit, near_m, far_m }" in why
    assert DepthSpec(unit="m", near_m=0, far_m=1).near_m == 0
