"""Pictures of many frames at once, under the name that the models' pages know: `vilp_data.contact_sheet`."""

from __future__ import annotations

from vilp_data.contact_sheet import ERROR_GAIN, SCALE, as_rgb, captioned, error_image, grid, stacked, to_png

__all__ = ["ERROR_GAIN", "SCALE", "as_rgb", "captioned", "error_image", "grid", "stacked", "to_png"]
