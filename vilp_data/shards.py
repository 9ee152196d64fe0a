"""Safetensors files that are written once, whole, with a checksum, and read through a memory map.

A file appears under its name only when every byte of it is on disk (temp file, fsync, rename, fsync of the folder), so a file
that is there is complete: its own header is the commit. Bytes depend on content alone: no timestamps, sorted keys.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from vilp_data.errors import StoreError
from vilp_data.keys import byte_blocks

# Names of the safetensors format for the dtypes stored here.
_DTYPES = {
    "BOOL": np.dtype(np.bool_), "U8": np.dtype(np.uint8), "F16": np.dtype("<f2"), "F32": np.dtype("<f4"), "F64": np.dtype("<f8"),
    "I32": np.dtype("<i4"), "I64": np.dtype("<i8"),
}  # fmt: skip
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}
_ALIGNMENT = 64
_MAX_HEADER_BYTES = 16 * 1024 * 1024
_CHECKSUM = "sha256"


@dataclass(frozen=True, slots=True)
class TensorInfo:
    """One tensor of a file: numpy dtype, shape, and its byte range from the start of the file."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class ShardHeader:
    """What a file says about itself: string metadata and its tensors, checked against the file's size."""

    metadata: dict[str, str]
    tensors: dict[str, TensorInfo]


@dataclass(frozen=True, slots=True)
class Shard:
    """An open file: read-only arrays that are views of the memory map (no copy; pages are read when touched)."""

    metadata: dict[str, str]
    arrays: dict[str, npt.NDArray[Any]]


def write_shard(path: Path, tensors: Mapping[str, npt.NDArray[Any]], metadata: Mapping[str, str]) -> None:
    """Write tensors and metadata to `path`, atomically. A checksum over all of it joins the metadata under "sha256".

    Raises StoreError where the disk is full or the folder cannot be written; `path` is then as it was before."""
    arrays = {
        name: np.asanyarray(tensors[name], order="C")
        for name in sorted(tensors, key=lambda n: (-tensors[n].dtype.itemsize, n))
    }
    layout: dict[str, Any] = {}
    offset = 0
    for name, array in arrays.items():
        if array.dtype not in _NAMES:
            raise StoreError(
                f"tensor {name!r} has dtype {array.dtype}, which is not stored",
                where=path,
                remedy=f"use one of {', '.join(map(str, _NAMES))}",
            )
        layout[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": list(array.shape),
            "data_offsets": [offset, offset + array.nbytes],
        }
        offset += array.nbytes
    checksum = _checksum(layout, metadata, (part for array in arrays.values() for part in byte_blocks(array)))
    header = json.dumps(
        {"__metadata__": {**metadata, _CHECKSUM: checksum}, **layout}, sort_keys=True, separators=(",", ":")
    ).encode()
    header += b" " * (-(8 + len(header)) % _ALIGNMENT)
    with atomic_file(path) as file:
        file.write(struct.pack("<Q", len(header)))
        file.write(header)
        for array in arrays.values():
            for part in byte_blocks(array):
                file.write(part)


def read_header(path: Path) -> ShardHeader:
    """Read the header alone. Raises StoreError where the file is missing, is no such file, or is cut off."""
    try:
        with path.open("rb") as file:
            return _parse_header(path, file, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise StoreError(
            "cannot be read", where=path, found=error.strerror, remedy="run the command that makes it again"
        ) from error


def open_shard(path: Path) -> Shard:
    """Map a file into memory. Costs its header's parsing and no file descriptor: thousands may be open at once."""
    import torch  # here, since commands that read headers alone should not wait for it

    header = read_header(path)
    size = max((info.end for info in header.tensors.values()), default=0)
    if size == 0:
        return Shard(header.metadata, {name: np.empty(info.shape, info.dtype) for name, info in header.tensors.items()})
    # Python's mmap keeps a descriptor per map, which meets the limit of 1,024 at a few hundred episodes; this one keeps none.
    storage = torch.UntypedStorage.from_file(str(path), shared=False, nbytes=size)
    data = torch.empty(0, dtype=torch.uint8).set_(storage).numpy()  # type: ignore[arg-type]
    data.flags.writeable = False
    return Shard(header.metadata, {name: _view(data, info) for name, info in header.tensors.items()})


def read_shard(path: Path) -> Shard:
    """Read a whole file into memory, its checksum verified."""
    header = read_header(path)
    data = np.fromfile(path, dtype=np.uint8)
    shard = Shard(header.metadata, {name: _view(data, info) for name, info in header.tensors.items()})
    _verify(path, header, data)
    return shard


def verify_shard(path: Path) -> None:
    """Raise StoreError unless every byte of the file is as it was written."""
    header = read_header(path)
    _verify(path, header, np.fromfile(path, dtype=np.uint8))


def write_atomic(path: Path, data: bytes) -> None:
    """Replace `path` by `data`, whole or not at all."""
    with atomic_file(path) as file:
        file.write(data)


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file that takes the name `path` when the block ends without an exception, and leaves nothing otherwise.

    Raises StoreError for what the operating system refuses (full disk, no permission)."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)
    except OSError as error:
        raise StoreError(
            "cannot be written",
            where=error.filename or path,
            found=error.strerror,
            remedy="free some space, or check the folder's permissions; nothing was replaced",
        ) from error


def sync_folder(folder: Path) -> None:
    """Make renames and deletions in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _view(data: npt.NDArray[np.uint8], info: TensorInfo) -> npt.NDArray[Any]:
    count = int(np.prod(info.shape, dtype=np.int64))
    return (
        np.frombuffer(data, dtype=info.dtype, count=count, offset=info.start).reshape(info.shape)
        if count
        else np.empty(info.shape, info.dtype)
    )


def _parse_header(path: Path, file: BinaryIO, size: int) -> ShardHeader:
    remedy = "the file is damaged: delete it and run the command that makes it again"
    start = file.read(8)
    length = struct.unpack("<Q", start)[0] if len(start) == 8 else -1
    if not 2 <= length <= min(_MAX_HEADER_BYTES, size - 8):
        raise StoreError(
            "not a safetensors file",
            where=path,
            found=f"{size} bytes that begin with {start[:8].hex(' ')}",
            remedy=remedy,
        )
    try:
        table = json.loads(file.read(length))
        metadata = {str(key): str(value) for key, value in table.pop("__metadata__", {}).items()}
        tensors = {name: _tensor_info(entry, 8 + length) for name, entry in table.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError("its header cannot be read", where=path, found=str(error), remedy=remedy) from error
    end = max((info.end for info in tensors.values()), default=8 + length)
    if end != size:
        raise StoreError(
            "its size is not what its header says", where=path, found=f"{size} bytes instead of {end}", remedy=remedy
        )
    return ShardHeader(metadata, tensors)


def _tensor_info(entry: dict[str, Any], data_start: int) -> TensorInfo:
    dtype, shape = _DTYPES[entry["dtype"]], tuple(int(n) for n in entry["shape"])
    begin, end = entry["data_offsets"]
    if end - begin != dtype.itemsize * int(np.prod(shape, dtype=np.int64)) or begin < 0:
        raise ValueError(f"shape {shape} of {dtype} does not fill bytes {begin} to {end}")
    return TensorInfo(dtype, shape, data_start + begin, data_start + end)


def _verify(path: Path, header: ShardHeader, data: npt.NDArray[np.uint8]) -> None:
    start = min((info.start for info in header.tensors.values()), default=0)
    layout = {
        name: {
            "dtype": _NAMES[info.dtype],
            "shape": list(info.shape),
            "data_offsets": [info.start - start, info.end - start],
        }
        for name, info in header.tensors.items()
    }
    metadata = {key: value for key, value in header.metadata.items() if key != _CHECKSUM}
    ordered = sorted(header.tensors.values(), key=lambda info: info.start)
    if _checksum(layout, metadata, (data[info.start : info.end].data for info in ordered)) != header.metadata.get(
        _CHECKSUM
    ):
        raise StoreError(
            "its checksum does not match",
            where=path,
            found="bytes that changed since it was written",
            remedy="delete it and run the command that makes it again",
        )


def _checksum(layout: Mapping[str, Any], metadata: Mapping[str, str], chunks: Iterator[memoryview]) -> str:
    digest = hashlib.sha256(json.dumps([layout, dict(metadata)], sort_keys=True, separators=(",", ":")).encode())
    for chunk in chunks:
        digest.update(chunk)
    return digest.hexdigest()
