"""Gymnasium environments, their scripted experts, and the recorder that turns them into logs.

Importing this package needs no simulator. `register()` makes the environments known to gymnasium by id.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import sys

from vilp_data.errors import UsageError

# Both are read when robosuite is first imported: draw without a display or GPU, and keep its advice on unused robots to itself.
if sys.platform.startswith("linux"):
    os.environ.setdefault("MUJOCO_GL", "osmesa")
logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)

ENVIRONMENTS = {
    "vilp/Hanoi-v0": "vilp_data.sims.hanoi:HanoiEnv",
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
