"""A run's curves and clips for TensorBoard, under <run>/tensorboard."""

from __future__ import annotations

import io
import shutil
from collections.abc import Mapping
from pathlib import Path

from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard.writer import SummaryWriter

from vilp_data.contact_sheet import as_rgb
from vilp_data.types import U8

FRAME_MS = 200
FOLDER = "tensorboard"


class Curves:
    """What one process writes after `first` steps. Close it: what was written last is lost otherwise.

    A run that goes on at `first` has TensorBoard drop what a killed one wrote past it, so that no step is drawn twice."""

    def __init__(self, run: Path, *, first: int) -> None:
        if first == 0:
            shutil.rmtree(run / FOLDER, ignore_errors=True)
        self._writer = SummaryWriter(str(run / FOLDER), purge_step=first + 1 if first else None)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def clips(self, step: int, clips: Mapping[str, U8]) -> None:
        """Each clip, uint8 [T,H,W,3] or [T,H,W,1], as an animated image."""
        for name, frames in clips.items():
            image = Summary.Image(
                height=frames.shape[1], width=frames.shape[2], colorspace=3, encoded_image_string=gif(frames)
            )
            writer = self._writer._get_file_writer()  # type: ignore[no-untyped-call]
            writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), step)
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


def gif(frames: U8) -> bytes:
    """An endless GIF of uint8 [T,H,W,3], or of grey [T,H,W,1]."""
    first, *rest = [Image.fromarray(frame) for frame in as_rgb(frames)]
    out = io.BytesIO()
    first.save(out, "GIF", save_all=True, append_images=rest, duration=FRAME_MS, loop=0)
    return out.getvalue()
