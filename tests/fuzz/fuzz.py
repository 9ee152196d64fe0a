"""Damage a log over and over and read what is left, as `inspect`, `ingest` and `salvage` do.

    python -m tests.fuzz.fuzz mcap bag --seconds 120 --seed 1

One line of JSON on stdout says what was found. Every exception but VilpDataError is a finding, and so are more than LIMIT_S for one
log, more than MEMORY_MB held at any time, and other than as many messages as the whole log has where neither an error nor a doubt says
so; the damaged log is then kept in --keep. A crash of the process leaves it there too.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from itertools import islice
from pathlib import Path

MEMORY_MB = 512
LIMIT_S = 10
MOST_MESSAGES = 1000  # of a topic: more than any seed has
UNGUARDED = ("mcap-no-index", "hdf5")
"""Sources that keep neither checksums nor a second count of what is in them: what they lose, nobody can tell."""


class SilentLossError(Exception):
    """A damaged log gave other than as many messages as were recorded, and nothing said so."""


class TooSlow(BaseException):
    """One log took longer than LIMIT_S."""


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--rounds", type=int, default=1 << 60, help="of each source, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "vilp-fuzz")
    given = parser.parse_args()
    # What a log claims may ask for any amount; the process must be refused, and say so, rather than be killed.
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _too_slow)
    os.fsync = lambda _: None  # nothing here needs to survive a power cut
    bad = 0
    for source in given.sources:
        bad += _fuzz(source, given.seconds, given.rounds, given.seed, given.keep)
    return 1 if bad else 0


def _too_slow(*_: object) -> None:
    raise TooSlow


def _fuzz(name: str, seconds: float, rounds: int, seed: int, keep: Path) -> int:
    from tests.fuzz.seeds import SEEDS
    from vilp_data.errors import VilpDataError

    rng = random.Random(f"{name} {seed}")
    count = refused = 0
    findings: dict[str, str] = {}
    slowest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "whole").mkdir()
        whole = SEEDS[name](Path(folder) / "whole")
        recorded = _read(whole, Path(folder))
        end = time.monotonic() + seconds
        while time.monotonic() < end and count < rounds:
            damaged = _damaged(whole, Path(folder) / "damaged", rng)
            kept = keep / name
            shutil.rmtree(kept, ignore_errors=True)
            kept.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(Path(folder) / "damaged", kept)
            begin = time.monotonic()
            signal.alarm(LIMIT_S)
            try:
                count_of = _read(damaged, Path(folder))
                if count_of not in (recorded, None) and name not in UNGUARDED:
                    raise SilentLossError(f"{count_of} of {recorded} messages")
            except VilpDataError:
                refused += 1
            except TooSlow:
                _keep(findings, kept, "slow", f"more than {LIMIT_S} s\n{traceback.format_exc()}")
            except BaseException as error:
                place = traceback.extract_tb(error.__traceback__)[-1]
                _keep(
                    findings,
                    kept,
                    f"{type(error).__name__} {Path(place.filename).name} {place.name}",
                    traceback.format_exc(),
                )
            finally:
                signal.alarm(0)
            slowest = max(slowest, time.monotonic() - begin)
            count += 1
            if _memory_mb() > MEMORY_MB:
                _keep(findings, kept, "memory", f"{_memory_mb()} MB")
                break
        shutil.rmtree(keep / name, ignore_errors=True)
    said = {
        "source": name,
        "logs": count,
        "refused": refused,
        "slowest_s": round(slowest, 2),
        "memory_mb": _memory_mb(),
    }
    print(json.dumps(said | {"findings": findings}), flush=True)
    return len(findings)


def _keep(findings: dict[str, str], kept: Path, kind: str, text: str) -> None:
    if kind not in findings:
        findings[kind] = text
        place = kept.with_name(f"{kept.name}-{''.join(c if c.isalnum() else '_' for c in kind)}")
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(kept, place)


def _memory_mb() -> int:
    """The most memory this process had at once. Not ru_maxrss, which a process takes over from the one that started it."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) // 1024


def _damaged(whole: Path, folder: Path, rng: random.Random) -> Path:
    """A copy of the log in which one file, or a few, are damaged."""
    from tests.damage import mutated

    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole.parent, folder)
    path = folder / whole.name
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    for file in rng.sample(files, min(len(files), rng.choice((1, 1, 1, 3)))):
        content = file.read_bytes()
        file.write_bytes(content[: rng.randrange(len(content) + 1)] if rng.random() < 0.1 else mutated(content, rng))
    return path


def _read(path: Path, folder: Path) -> int | None:
    """Everything that a user's commands do with a log; how many messages it gives, None where the log says of itself that some lack."""
    from vilp_data.decode import decode_image, is_image
    from vilp_data.errors import VilpDataError
    from vilp_data.log_summary import format_summary, summarise
    from vilp_data.salvage import salvage_log
    from vilp_data.salvage_report import format_report
    from vilp_data.sources import open_log

    refused: VilpDataError | None = None
    found, doubts = 0, list[str]()
    try:
        format_summary(summarise(path))
        with open_log(path) as log:
            log.episodes()
            log.metadata()
            log.sha256()
            doubts = log.doubts()
            for topic in log.topics():
                try:
                    for message in islice(log.messages([topic.name]), MOST_MESSAGES):
                        found += 1
                        if is_image(message):
                            decode_image(message)
                except VilpDataError as error:
                    refused = error
    except VilpDataError as error:
        refused = error
    if path.is_file() and path.suffix in (".mcap", ".bag", ".db3"):
        try:
            format_report(salvage_log(path, folder / "clean.mcap", force=True))
        except VilpDataError as error:
            refused = error
        else:
            with open_log(folder / "clean.mcap") as log:  # what salvage writes is whole, whatever it was made of
                log.sha256()
                log.message_times()
    if refused is not None:
        str(refused)
        raise refused
    return None if doubts else found


if __name__ == "__main__":
    sys.exit(main())
