"""Three ways to look at a drawing that is on disk: a native window, a page for browsers, a picture."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

from rerun.experimental import ViewerClient

from vilp_data import shards
from vilp_data.errors import UsageError
from vilp_data.viewer.canvas import TIMELINE, Drawn
from vilp_data.viewer.process import (
    LOCALHOST,
    POLL_S,
    WINDOW_SIZE,
    ViewerProcess,
    free_port,
    require_display,
    rerun,
    wait_for_port,
)

TIMEOUT_S = 60.0
SETTLE_S = 1.0  # the picture must not change for this long

Draw = Callable[[Path], Drawn]
Say = Callable[[str], None]


def present(
    draw: Draw, *, web: bool = False, save: Path | None = None, screenshot: Path | None = None, say: Say | None = None
) -> None:
    """Draw, and do what was asked: save the file, take a picture, serve a page until Ctrl-C; with nothing asked, open a window.

    Raises UsageError at once where a window is wanted and there is no display."""
    tell: Say = say or (lambda line: None)
    if not (web or save or screenshot):
        require_display()
    with tempfile.TemporaryDirectory(prefix="vilp-view-") as folder:
        drawn = draw(save or Path(folder) / "view.rrd")
        for note in drawn.notes:
            tell(note)
        if save:
            tell(f"saved {save} ({save.stat().st_size / 1e6:.1f} MB); open it with `rerun {save}`")
        if screenshot:
            take_screenshot(drawn, screenshot)
            tell(f"wrote {screenshot}")
        if web:
            serve_web(drawn, on_url=lambda url: tell(f"{url}\nCtrl-C ends it"))
        if not (web or save or screenshot):
            open_window(drawn)


def open_window(drawn: Drawn) -> None:
    """Show the drawing in a native window; returns when that is closed. Raises UsageError without a display."""
    require_display()
    arguments = [str(drawn.rrd), "--bind", LOCALHOST, "--port", str(free_port()), "--hide-welcome-screen"]
    with rerun(arguments) as viewer:
        try:
            code = viewer.process.wait()
        except KeyboardInterrupt:
            return
        if code != 0:
            viewer.check_alive()


def serve_web(
    drawn: Drawn, *, on_url: Say, web_port: int = 9090, data_port: int = 9876, timeout_s: float = TIMEOUT_S
) -> None:
    """Serve the drawing to browsers of this machine until Ctrl-C; `on_url` is told the address once it answers.

    The ports are wishes: a taken one is replaced by a free one, since a viewer that is there already would take the data."""
    web_port, data_port = free_port(web_port), free_port(data_port)
    data = quote(f"rerun+http://{LOCALHOST}:{data_port}/proxy", safe="")
    arguments = [str(drawn.rrd), "--serve-web", "--bind", LOCALHOST, "--port", str(data_port)]
    arguments += ["--web-viewer-port", str(web_port), "--server-memory-limit", "75%"]
    with rerun(arguments) as viewer:
        try:
            wait_for_port(viewer, web_port, timeout_s)
            on_url(f"http://{LOCALHOST}:{web_port}/?url={data}&renderer=webgl")
            viewer.process.wait()
            viewer.check_alive()
        except KeyboardInterrupt:
            return


def take_screenshot(drawn: Drawn, png: Path, *, timeout_s: float = TIMEOUT_S) -> None:
    """Write a picture of the drawing at its middle moment, without any display. Raises ViewerError with the package to install
    where there is no graphics driver, or when `timeout_s` is over; nothing is written then."""
    if not png.parent.is_dir():
        raise UsageError("no such folder", where=png.parent, remedy="make it, or save somewhere else")
    deadline = time.monotonic() + timeout_s
    port = free_port()
    arguments = [str(drawn.rrd.resolve()), "--headless", "--bind", LOCALHOST, "--port", str(port)]
    arguments += ["--hide-welcome-screen", "--window-size", WINDOW_SIZE]
    with rerun(arguments) as viewer:
        wait_for_port(viewer, port, timeout_s)
        client = ViewerClient.connect(f"rerun+http://{LOCALHOST}:{port}/proxy")
        _wait_until_loaded(viewer, client, drawn.recording_id, deadline)
        client.set_time(TIMELINE, play_state="paused", **drawn.middle)
        shards.write_atomic(png, _settled_picture(viewer, client, deadline))


def _wait_until_loaded(viewer: ViewerProcess, client: ViewerClient, recording_id: str, deadline: float) -> None:
    while time.monotonic() < deadline:
        viewer.check_alive()
        try:
            state = client.get_state()
        except (ConnectionError, RuntimeError):  # the port answers a little before the viewer does
            time.sleep(POLL_S)
            continue
        ours = [known for known in state.recordings if known.store_id.endswith(f":{recording_id}")]
        if ours and ours[0].timelines and not state.loading:
            return
        time.sleep(POLL_S)
    raise viewer.failure("the viewer did not load the drawing in time")


def _settled_picture(viewer: ViewerProcess, client: ViewerClient, deadline: float) -> bytes:
    """PNG bytes once the picture no longer changes: images are decoded, and panels drawn, some frames after they are asked for."""
    latest, since = b"", time.monotonic()
    while time.monotonic() < deadline:
        viewer.check_alive()
        picture: bytes = client.take_screenshot()
        if picture != latest:
            latest, since = picture, time.monotonic()
        elif time.monotonic() - since >= SETTLE_S:
            return picture
        time.sleep(POLL_S)
    raise viewer.failure("the viewer's picture did not settle in time")
