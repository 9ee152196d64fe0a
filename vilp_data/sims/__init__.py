"""Gymnasium environments, their scripted experts, and the recorder that turns them into logs.

Importing this package needs no simulator. `register()` makes the environments known to gymnasium by id.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import sys
from typing import Any

from vilp_data.errors import UsageError

# Both are read when robosuite is first imported: draw without a display or GPU, and keep its advice on unused robots to itself.
if sys.platform.startswith("linux"):
    os.environ.setdefault("MUJOCO_GL", "osmesa")
logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)

ENVIRONMENTS = {
    "vilp/ArrangeBlocks-v0": "vilp_data.sims.arrange_blocks:ArrangeBlocksEnv",
    "vilp/Can-v0": "vilp_data.sims.can:CanEnv",
    "vilp/Hanoi-v0": "vilp_data.sims.hanoi:HanoiEnv",
    "vilp/MoveTheStack-v0": "vilp_data.sims.move_the_stack:MoveTheStackEnv",
    "vilp/NutAssembly-v0": "vilp_data.sims.nut_assembly:NutAssemblyEnv",
    "vilp/PushT-v0": "vilp_data.sims.pusht:PushTEnv",
}


def register() -> None:
    """Register the ids of `ENVIRONMENTS` with gymnasium; calling it twice is fine. UsageError where gymnasium is absent."""
    if importlib.util.find_spec("gymnasium") is None:
        raise UsageError("the simulators are not installed", found="no package called gymnasium", remedy="make setup")
    import gymnasium

    for name, entry_point in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=entry_point)


def load_entry_point(name: str) -> Any:
    """What "module:name" names; its packages are imported now."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
