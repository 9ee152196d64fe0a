"""Loading windows: this store against a bare copy of the same bytes and against WebDataset, in one run.

    python benchmarks/bench_loading.py [--folder DIR] [--seconds 1.0] [--repeats 5] [--json]

Writes 60 episodes x 150 steps x 2 views of 96x160 (0.9 GB) and 1,000 short episodes through the store's own writers,
then measures, warm and in one process:

    windows/s            random windows of 6 latents and 1 image of 2 views, 24 actions; batches of 64; straight reads,
                         and through the Loader with its read-ahead thread
    bare copy            numpy.take of as many bytes a window from one array in memory: the ceiling
    WebDataset           the same windows as tar samples, shuffle buffer of 1,000, collated into batches of 64
    opening              WindowDataset on 1,000 episodes, split included
    anonymous memory     RssAnon of a process that reads, above the same process after its imports

The four take turns; every rate, and every ratio of two rates of one round, is the median over the rounds.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch

from vilp_data import shards
from vilp_data.dataset import WindowDataset, WindowTensors
from vilp_data.episodes import EpisodeStore, Origin
from vilp_data.latents import latents_path
from vilp_data.loader import Loader
from vilp_data.spec import WindowSpec
from vilp_data.split import SplitEpisode, draw_split
from vilp_data.task_toml import task_from_dict
from vilp_data.types import Episode

BATCH = 64
VIEWS = ("front", "side")
KEYS = dict.fromkeys(VIEWS, "benchmark")
WINDOW = WindowSpec(n_plan_frames=6, frame_stride=4, max_goal_frames=6)


# --- datasets -------------------------------------------------------------------------------------------------------


def write_dataset(root: Path, *, n_episodes: int, n_steps: int, height: int, width: int) -> None:
    """Episodes of random bytes, their latents at an eighth of the size, and an index, by the store's own writers."""
    rng = np.random.default_rng(0)
    store = EpisodeStore(root)
    views = {view: {"topic": f"/{view}", "height": height, "width": width} for view in VIEWS}
    store.write_spec(task_from_dict({"name": "benchmark", "views": views}, where="benchmark"))
    for number in range(n_episodes):
        store.write(_episode(f"episode-{number:04}", rng, n_steps, height, width), Origin("benchmark", "", "", "", {}))
    store.write_index()
    for entry in store.index():
        for view in VIEWS:
            header = {"source_frames_sha256": entry.frames_sha256[view]}
            latents = rng.standard_normal((n_steps, 3, height // 8, width // 8)).astype(np.float16)
            shards.write_shard(latents_path(root, view, KEYS[view], entry.id), {"latents": latents}, header)


def _episode(name: str, rng: np.random.Generator, n_steps: int, height: int, width: int) -> Episode:
    return Episode(
        id=name,
        frames={view: rng.integers(0, 256, (n_steps, height, width, 3), dtype=np.uint8) for view in VIEWS},
        source_index={view: np.arange(n_steps, dtype=np.int32) for view in VIEWS},
        log_time_ns=np.arange(n_steps, dtype=np.int64) * 100_000_000,
        low_dim=rng.standard_normal((n_steps, 9)).astype(np.float32),
        action=rng.standard_normal((n_steps, 7)).astype(np.float32),
        state=None,
        valid=np.ones(n_steps, np.bool_),
        age_s={},
        rate_hz=10.0,
        tags={},
        outcome="success",
    )


def write_split(root: Path, *, ratio: float) -> None:
    episodes = [SplitEpisode(entry.id, entry.content_sha256) for entry in EpisodeStore(root).index()]
    shards.write_atomic(root / "split.lock.json", draw_split(episodes, ratio=ratio, seed=0).to_json())


def open_dataset(root: Path, split: str = "all") -> WindowDataset:
    return WindowDataset(root, split=split, latent_keys=KEYS, window=WINDOW)  # type: ignore[arg-type]


# --- rates ----------------------------------------------------------------------------------------------------------


def windows_per_second(streams: Mapping[str, Iterator[int]], *, seconds: float, repeats: int) -> dict[str, list[float]]:
    """Rates of endless streams of batches that each say how many windows they held.

    Streams take turns, so that what else the machine does meets all of them alike; the first round warms up."""
    rates: dict[str, list[float]] = {name: [] for name in streams}
    for _ in range(repeats + 1):
        for name, stream in streams.items():
            count, started = 0, time.perf_counter()
            while (elapsed := time.perf_counter() - started) < seconds:
                count += next(stream)
            rates[name].append(count / elapsed)
    return {name: rounds[1:] for name, rounds in rates.items()}


def straight_reads(dataset: WindowDataset) -> Iterator[int]:
    rng = np.random.default_rng(0)
    while True:
        yield len(dataset.read(rng.integers(0, len(dataset), BATCH)))


def loader_reads(dataset: WindowDataset) -> Iterator[int]:
    loader = Loader(dataset, batch_size=BATCH)
    while True:
        for batch in loader:
            yield len(batch)


def bare_copies(window_bytes: int, total_bytes: int) -> Iterator[int]:
    rng = np.random.default_rng(0)
    source = rng.integers(0, 256, (total_bytes // window_bytes, window_bytes), dtype=np.uint8)
    while True:
        yield len(source.take(rng.integers(0, len(source), BATCH), axis=0))


def webdataset_reads(folder: Path) -> Iterator[int]:
    import webdataset

    def collated(samples: list[dict[str, bytes]]) -> dict[str, torch.Tensor]:
        names = [name for name in samples[0] if not name.startswith("__")]
        return {
            name: torch.from_numpy(np.stack([np.frombuffer(sample[name], np.uint8) for sample in samples]))
            for name in names
        }

    urls = sorted(str(path) for path in folder.glob("*.tar"))
    pipeline = webdataset.WebDataset(urls, shardshuffle=len(urls), seed=0, empty_check=False)
    pipeline = pipeline.shuffle(1000).batched(BATCH, collation_fn=collated, partial=False).repeat()
    for batch in pipeline:
        yield len(batch["low_dim"])


def write_webdataset(dataset: WindowDataset, folder: Path, *, n_windows: int) -> None:
    """The same windows, one tar sample each, a member for every array."""
    import webdataset

    folder.mkdir()
    numbers = np.random.default_rng(0).permutation(len(dataset))[:n_windows]
    with webdataset.ShardWriter(str(folder / "windows-%04d.tar"), maxcount=512, verbose=0) as writer:
        for number in numbers.tolist():
            writer.write({"__key__": f"{number:06}"} | {k: v.tobytes() for k, v in arrays_of(dataset[number]).items()})


def arrays_of(batch: WindowTensors) -> dict[str, np.ndarray]:
    arrays = {f"frames_{view}": tensor for view, tensor in batch.frames.items()}
    arrays |= {f"latents_{view}": tensor for view, tensor in batch.latents.items()}
    arrays |= {name: getattr(batch, name) for name in ("latent_mask", "low_dim", "action", "action_mask")}
    return {name: tensor.numpy() for name, tensor in arrays.items()}


# --- opening and memory ---------------------------------------------------------------------------------------------


def opening_ms(root: Path, *, repeats: int) -> float:
    times = []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        open_dataset(root, "train")
        times.append((time.perf_counter() - started) * 1e3)
    return statistics.median(times[1:])


def anonymous_mb(root: Path, split: str) -> float:
    """Anonymous memory that reading every episode adds to a fresh process, in MB."""
    command = [sys.executable, __file__, "--measure-memory", str(root), split]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def measure_memory(root: Path, split: str) -> float:
    """What the process named by `anonymous_mb` does: reads 200 batches, after one window of every episode."""
    tiny = torch.zeros(1).numpy()  # what torch and numpy set up on first use belongs to the imports
    before = _anonymous_kb() + 0 * int(tiny[0])
    dataset = open_dataset(root, split)
    rng = np.random.default_rng(0)
    every = np.arange(0, len(dataset), max(len(dataset) // (2 * len(dataset.episode_ids)), 1))
    for numbers in [*np.array_split(every, -(-len(every) // BATCH)), *rng.integers(0, len(dataset), (200, BATCH))]:
        dataset.read(numbers)
    return (_anonymous_kb() - before) / 1024


def _anonymous_kb() -> int:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("RssAnon"))
    return int(line.split()[1])


# --- report ---------------------------------------------------------------------------------------------------------


def measure(folder: Path, *, seconds: float, repeats: int) -> dict[str, float]:
    main, many = folder / "main", folder / "many"
    write_dataset(main, n_episodes=60, n_steps=150, height=96, width=160)
    write_dataset(many, n_episodes=1000, n_steps=10, height=48, width=80)
    dataset = open_dataset(main)
    window_bytes = sum(array.nbytes for array in arrays_of(dataset[0]).values())
    write_webdataset(dataset, folder / "webdataset", n_windows=4096)

    streams = {
        "reads": straight_reads(dataset),
        "loader": loader_reads(dataset),
        "bare": bare_copies(window_bytes, total_bytes=512 * 2**20),
        "webdataset": webdataset_reads(folder / "webdataset"),
    }
    rates = windows_per_second(streams, seconds=seconds, repeats=repeats)
    results = {f"{name}_windows_per_s": statistics.median(rounds) for name, rounds in rates.items()}
    for ours, other in itertools.product(("reads", "loader"), ("bare", "webdataset")):
        ratios = [a / b for a, b in zip(rates[ours], rates[other], strict=True)]
        results[f"{ours}_over_{other}"] = statistics.median(ratios)
    results["window_bytes"] = float(window_bytes)
    results["anonymous_mb_60_episodes_of_150_steps"] = anonymous_mb(main, "all")
    for n_episodes in (60, 600):
        write_split(many, ratio=n_episodes / 1000)
        results[f"anonymous_mb_{n_episodes}_short_episodes"] = anonymous_mb(many, "train")
    write_split(many, ratio=0.999)
    return results | {"opening_1000_episodes_ms": opening_ms(many, repeats=max(repeats, 5))}


def report(results: dict[str, float]) -> str:
    lines = [f"a window is {results['window_bytes'] / 1e3:.1f} kB; batches of {BATCH}; torch {torch.__version__}"]
    for name, label in (("reads", "straight reads"), ("loader", "Loader")):
        rate, bare, peer = (results[f"{name}_{what}"] for what in ("windows_per_s", "over_bare", "over_webdataset"))
        lines.append(f"windows/s, {label:20}{rate:10,.0f}   {bare:6.2f} x bare copy   {peer:6.1f} x WebDataset")
    for name, label in (("bare", "bare numpy copy"), ("webdataset", "WebDataset")):
        lines.append(f"windows/s, {label:20}{results[f'{name}_windows_per_s']:10,.0f}")
    lines.append(f"opening 1,000 episodes         {results['opening_1000_episodes_ms']:10.1f} ms")
    for name, label in (
        ("60_episodes_of_150_steps", "60 x 150 steps, 96x160"),
        ("60_short_episodes", "60 x 10 steps, 48x80"),
        ("600_short_episodes", "600 x 10 steps, 48x80"),
    ):
        lines.append(f"anonymous memory above imports {results[f'anonymous_mb_{name}']:10.1f} MB   ({label})")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="where to write the datasets (default: a temporary folder)")
    parser.add_argument("--seconds", type=float, default=1.0, help="length of one repeat")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
    parser.add_argument("--measure-memory", nargs=2, metavar=("ROOT", "SPLIT"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure_memory:
        print(measure_memory(Path(arguments.measure_memory[0]), arguments.measure_memory[1]))
        return
    with tempfile.TemporaryDirectory(dir=arguments.folder, prefix="bench-loading-") as folder:
        results = measure(Path(folder), seconds=arguments.seconds, repeats=arguments.repeats)
    print(json.dumps(results) if arguments.json else report(results))


if __name__ == "__main__":
    main()
