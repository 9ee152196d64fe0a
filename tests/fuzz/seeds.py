"""A small log of every format, to be damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from mcap.writer import CompressionType, IndexType

from tests.lerobot_folders import write_v3, write_v21
from tests.synthetic import write_mcap, write_zarr
from tests.synthetic_bags import write_rosbag1, write_rosbag2

N = 8


def _mcap(**options: object) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        settings = {"n_frames": N, "height": 16, "width": 16, "chunk_size": 1500, "tags": {"success": "true"}} | options
        return write_mcap(folder / "run.mcap", **settings).path  # type: ignore[arg-type]

    return write


def _bag(compression: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        log = write_mcap(folder / "source.mcap", n_frames=N, height=16, width=16)
        path = write_rosbag1(folder / "run.bag", log, compression=compression, chunk_bytes=1500)  # type: ignore[arg-type]
        log.path.unlink()
        return path

    return write


def _rosbag2(storage: str, compression: str = "none", parts: int = 1) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        log = write_mcap(folder / "source.mcap", n_frames=N, height=16, width=16)
        path = write_rosbag2(folder / "run", log, storage=storage, compression=compression, parts=parts)  # type: ignore[arg-type]
        log.path.unlink()
        return path

    return write


def _db3(folder: Path) -> Path:
    bag = _rosbag2("sqlite3")(folder)
    (file,) = bag.glob("*.db3")
    return file.rename(folder / "run.db3")


def _zarr(folder: Path) -> Path:
    return write_zarr(folder / "run.zarr").path


def _hdf5(folder: Path) -> Path:
    """The layout of robomimic."""
    path = folder / "run.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = '{"env_kwargs": {"control_freq": 20}}'
        for number in range(2):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = N
            demo.create_dataset("actions", data=np.linspace(0, 1, N * 3, dtype=np.float32).reshape(N, 3), chunks=(4, 3))
            pixels = np.arange(N * 12 * 12 * 3, dtype=np.uint32).astype(np.uint8).reshape(N, 12, 12, 3)
            demo.create_dataset("obs/image", data=pixels, compression="gzip", chunks=(2, 12, 12, 3))
            demo.create_dataset("obs/joints", data=np.zeros((N, 2)))
    return path


def _v21(folder: Path) -> Path:
    return write_v21(folder / "run", lengths=(6, 5), codec="mpeg4").path


def _v3(folder: Path) -> Path:
    return write_v3(folder / "run", lengths=(6, 5), per_file=2).path


SEEDS: dict[str, Callable[[Path], Path]] = {
    "mcap": _mcap(),
    "mcap-lz4": _mcap(compression=CompressionType.LZ4, encoding="json"),
    "mcap-none": _mcap(compression=CompressionType.NONE, encoding="protobuf", enable_crcs=False),
    "mcap-unchunked": _mcap(use_chunking=False, image_codec="png"),
    "mcap-no-index": _mcap(index_types=IndexType.NONE, compression=CompressionType.NONE, enable_crcs=False),
    "bag": _bag("none"),
    "bag-lz4": _bag("lz4"),
    "bag-bz2": _bag("bz2"),
    "db3": _db3,
    "rosbag2": _rosbag2("sqlite3"),
    "rosbag2-mcap": _rosbag2("mcap", parts=2),
    "rosbag2-packed": _rosbag2("sqlite3", "file"),
    "rosbag2-messages": _rosbag2("sqlite3", "message"),
    "zarr": _zarr,
    "hdf5": _hdf5,
    "lerobot-v21": _v21,
    "lerobot-v3": _v3,
}
