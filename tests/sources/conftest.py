"""One recording as an MCAP log, as a ROS 1 bag and as a ROS 2 database, for all tests of bags."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.synthetic import SyntheticLog, write_mcap
from tests.synthetic_bags import write_rosbag1, write_rosbag2


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticLog:
    folder = tmp_path_factory.mktemp("source")
    return write_mcap(folder / "run.mcap", image_codec="png", n_frames=6, height=16, width=24, jitter_s=0.004)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory, log: SyntheticLog) -> Path:
    return write_rosbag1(tmp_path_factory.mktemp("ros1") / "run.bag", log)


@pytest.fixture(scope="module")
def db3(tmp_path_factory: pytest.TempPathFactory, log: SyntheticLog) -> Path:
    return write_rosbag2(tmp_path_factory.mktemp("ros2") / "run", log) / "run.db3"
