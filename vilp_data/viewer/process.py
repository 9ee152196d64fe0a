"""The Rerun viewer as a child process: started on ports that are free, listening on this machine alone, never left behind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from vilp_data.errors import UsageError, VilpDataError

LOCALHOST = "127.0.0.1"
WINDOW_SIZE = "1600x900"
STOP_S = 5.0  # between asking a viewer to end and ending it
POLL_S = 0.1
SHOWN_OUTPUT = 600  # characters of a failed viewer's last words
GRAPHICS_PACKAGE = "sudo apt-get install -y --no-install-recommends mesa-vulkan-drivers"
NO_GRAPHICS = ("render context", "raphics adapter", "libvulkan")
WINDOW_PACKAGES = "sudo apt-get install -y --no-install-recommends mesa-vulkan-drivers libxkbcommon-x11-0"


class ViewerError(VilpDataError):
    """The viewer could not start, ended on its own, or did not answer in time."""


@dataclass(frozen=True)
class ViewerProcess:
    """A running viewer and what it has said so far."""

    process: subprocess.Popen[bytes]
    output: IO[bytes]

    def check_alive(self) -> None:
        """Raises ViewerError, with the viewer's last words and the remedy where it is known, once it has ended."""
        code = self.process.poll()
        if code is not None:
            raise self.failure("the viewer ended on its own")

    def failure(self, what: str) -> ViewerError:
        self.output.flush()
        said = Path(self.output.name).read_text(encoding="utf-8", errors="replace")
        said = said.partition("stack backtrace:")[0].strip()
        remedy = "update the graphics driver, or look at the log elsewhere: `--save x.rrd`, then `rerun x.rrd`"
        if any(word in said for word in NO_GRAPHICS):
            remedy = f"it found no graphics driver, not even a software one: {GRAPHICS_PACKAGE}"
        elif "xkbcommon" in said:
            remedy = f"a window needs one more library: {WINDOW_PACKAGES}"
        return ViewerError(what, found=said[-SHOWN_OUTPUT:] or None, remedy=remedy)


@contextmanager
def rerun(arguments: list[str]) -> Iterator[ViewerProcess]:
    """Run `rerun` with these arguments; however the block is left, the viewer and all it started have ended."""
    # RERUN_APP_ONLY: no first-run banner. RUST_LOG: what Rerun logs below an error, it also pops up over the picture.
    environment = {**os.environ, "RERUN_APP_ONLY": "true", "RUST_LOG": "error"}
    command = [sys.executable, "-m", "rerun_cli", *arguments]
    with tempfile.NamedTemporaryFile(prefix="vilp-viewer-", suffix=".log") as output:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        try:
            yield ViewerProcess(process, output)
        finally:
            _stop(process)


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End the process group: the launcher and the viewer it started, even where the launcher has ended by itself."""
    for kind in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, kind)
        with suppress(subprocess.TimeoutExpired):
            process.wait(STOP_S)
        if not _group_alive(process.pid):
            return


def _group_alive(group: int) -> bool:
    """Whether any process of the group still runs, after waiting a moment for those that are ending."""
    deadline = time.monotonic() + STOP_S
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return False
        time.sleep(POLL_S / 4)
    return True


def free_port(preferred: int = 0) -> int:
    """`preferred` if nothing listens there, else some free port of this machine. A viewer already on a port would take the data."""
    for port in (preferred, 0):
        with socket.socket() as probe, suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((LOCALHOST, port))
            return int(probe.getsockname()[1])
    raise ViewerError("no free port on this machine", where=LOCALHOST, remedy="end some servers")


def wait_for_port(viewer: ViewerProcess, port: int, timeout_s: float) -> None:
    """Return once something answers on the port. Raises ViewerError when the viewer ends first, or time is up."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        viewer.check_alive()
        with socket.socket() as probe:
            probe.settimeout(POLL_S)
            if probe.connect_ex((LOCALHOST, port)) == 0:
                return
        time.sleep(POLL_S)
    raise viewer.failure(f"the viewer did not answer within {timeout_s:.0f} s")


def has_display() -> bool:
    """Whether a window can be opened from here."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def require_display() -> None:
    """Raises UsageError, naming the ways that need no display, where there is none."""
    if not has_display():
        remedy = "use --web (look at it in a browser), --save x.rrd (look at it elsewhere) or --screenshot x.png"
        raise UsageError(
            "no display to open a window on", found="neither DISPLAY nor WAYLAND_DISPLAY is set", remedy=remedy
        )
