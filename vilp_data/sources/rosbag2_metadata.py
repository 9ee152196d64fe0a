"""metadata.yaml, which makes a folder of files one ROS 2 bag, and counts the messages in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from vilp_data.errors import LogError, reason

FILE_NAME = "metadata.yaml"
KEY = "rosbag2_bagfile_information"
LARGEST_BYTES = 16 << 20  # of a metadata.yaml; one of 94 topics has 18 kB
STORAGES = (".mcap", ".db3")
COMPRESSED_SUFFIX = ".zstd"
REINDEX = "`ros2 bag reindex FOLDER`, where ROS 2 is installed, writes it anew; or give the bag's files one by one"


@dataclass(frozen=True)
class BagMetadata:
    """`files` in the order of recording, each once; `counts`: messages by the name of a file, `total`: in all, as far as they are stated;
    `custom` is what the recorder was told to note (`--custom-data`); `release` of ROS 2 and
    `compression` ("zstd, file") are empty where nothing tells."""

    files: tuple[Path, ...]
    counts: Mapping[str, int]
    total: int | None
    custom: dict[str, str]
    release: str
    compression: str


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder is a ROS 2 bag, in whatever state: its metadata.yaml says so."""
    try:
        with (folder / FILE_NAME).open("rb") as stream:
            return KEY.encode() in stream.read(LARGEST_BYTES)
    except OSError:
        return False


def lone_file(folder: Path) -> Path | None:
    """The file that a bag's folder stands for: where there is one, not compressed, and metadata.yaml has nothing to add. Else None."""
    metadata = read_metadata(folder)
    plain = len(metadata.files) == 1 and metadata.files[0].suffix in STORAGES and not metadata.custom
    return metadata.files[0] if plain else None


def read_metadata(folder: Path) -> BagMetadata:
    """LogError where metadata.yaml cannot be understood, or a file that it lists is not there, or is listed twice."""
    table = _table(folder / FILE_NAME)
    names = table.get("relative_file_paths")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or not names:
        raise _unusable(folder, "no list relative_file_paths")
    files = tuple(_file(folder, name) for name in names)
    missing = [name for name, file in zip(names, files, strict=True) if file is None]
    if missing:
        raise LogError(
            "files of the bag are missing",
            where=folder,
            found=", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else ""),
            remedy=f"put them back beside metadata.yaml; {REINDEX}",
        )
    twice = [name for file, n in Counter(files).items() if n > 1 for name in names if _file(folder, name) == file]
    if twice:
        found = ", ".join(twice[:5])
        raise LogError("metadata.yaml lists a file of the bag twice", where=folder, found=found, remedy=REINDEX)
    custom = table.get("custom_data")
    return BagMetadata(
        files=tuple(file for file in files if file is not None),
        counts=_counts(table),
        total=_count(table),
        custom={str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {},
        release=_word(table, "ros_distro"),
        compression=", ".join(
            filter(None, (_word(table, "compression_format"), _word(table, "compression_mode").lower()))
        ),
    )


def missing_messages(metadata: BagMetadata, found: Mapping[Path, int | None]) -> list[str]:
    """A sentence on each file of a bag in which there are other than as many messages as metadata.yaml counts; `found` are those of each
    file, None where nothing tells."""
    sentences = []
    for file, count in found.items():
        stated = metadata.counts.get(file.name.removesuffix(COMPRESSED_SUFFIX))
        if len(metadata.files) == 1 and stated is None:
            stated = metadata.total
        if None not in (stated, count) and stated != count:
            sentences.append(f"{FILE_NAME} counts {stated:,} messages in {file.name}, where {count:,} are")
    counts = [count for count in found.values() if count is not None]
    if not sentences and len(metadata.files) == len(counts) and metadata.total not in (None, sum(counts)):
        sentences.append(f"{FILE_NAME} counts {metadata.total:,} messages in all, where {sum(counts):,} are")
    return sentences


def missing_from_file(file: Path, count: int | None) -> list[str]:
    """The same of one file, where it lies in a bag's folder and is a part of that bag."""
    try:
        metadata = read_metadata(file.parent) if is_bag_folder(file.parent) else None
    except LogError:
        return []
    return missing_messages(metadata, {file: count}) if metadata is not None and file in metadata.files else []


def _counts(table: dict[str, Any]) -> dict[str, int]:
    """Messages by the name of a file, by which of the two names it may have on disk the one that is not compressed."""
    entries = table.get("files")
    found = {}
    for entry in entries if isinstance(entries, list) else ():
        if isinstance(entry, dict) and isinstance(entry.get("path"), str) and (count := _count(entry)) is not None:
            found[PurePosixPath(entry["path"].replace("\\", "/")).name.removesuffix(COMPRESSED_SUFFIX)] = count
    return found


def _count(table: dict[str, Any]) -> int | None:
    count = table.get("message_count")
    return count if isinstance(count, int) and not isinstance(count, bool) else None


def _table(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as stream:
            text = stream.read(LARGEST_BYTES + 1)
        if len(text) > LARGEST_BYTES:
            raise _unusable(path.parent, f"more than {LARGEST_BYTES:,} bytes")
        content = YAML(typ="safe", pure=True).load(text)
    except OSError as error:
        raise LogError("cannot be opened", where=path, found=error.strerror, remedy="check its permissions") from error
    except (YAMLError, ValueError, RecursionError, TypeError, KeyError, AttributeError, IndexError) as error:
        raise _unusable(path.parent, reason(error)) from error
    table = content.get(KEY) if isinstance(content, dict) else None
    if not isinstance(table, dict):
        raise _unusable(path.parent, f"no table {KEY}")
    return table


def _file(folder: Path, name: str) -> Path | None:
    """The file of the bag called `name`, None where it is not there. Only the last part of a name counts: early versions put the
    folder before it, and no other may lead out of the folder."""
    plain = PurePosixPath(name.replace("\\", "/")).name
    if not plain or "\0" in plain:
        return None
    for candidate in (folder / plain, folder / (plain + COMPRESSED_SUFFIX)):
        if candidate.is_file():
            return candidate
    return None


def _word(table: dict[str, Any], name: str) -> str:
    value = table.get(name)
    return value if isinstance(value, str) and value.lower() not in ("none", "unknown") else ""


def _unusable(folder: Path, found: str) -> LogError:
    return LogError("metadata.yaml cannot be understood", where=folder, found=found, remedy=REINDEX)
