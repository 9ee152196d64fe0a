"""Recorded logs and data sets that tests read where they are present; the project holds no copy of them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def real_data(relative: str) -> Path:
    """The path of a file or folder under VILP_TEST_DATA (default: ../shared/data beside the project); skips where it is absent."""
    base = Path(os.environ.get("VILP_TEST_DATA", ROOT.parent / "shared" / "data"))
    path = base / relative
    if not path.exists():
        pytest.skip(f"real data not present: {path} (set VILP_TEST_DATA)")
    return path
