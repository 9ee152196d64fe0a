"""Gymnasium environments, their scripted experts, and the recorder that turns them into logs.

Importing this package needs no simulator. `register()` makes the environments known to gymnasium by id.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import sys
from collections.abc import Mapping
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


def make_simulator(env: str, options: Mapping[str, Any]) -> Any:
    """The environment of that gymnasium id itself, without wrappers: no limit of steps, no checks. UsageError where there is none of that
    id, or it does not take `options`."""
    register()
    import gymnasium

    try:
        return gymnasium.make(env, disable_env_checker=True, **options).unwrapped
    except TypeError as error:
        remedy = "its constructor must take [sim]'s options, those of [record.variants], and cameras=False for a world without images"
        found = f"{error} (options {', '.join(sorted(options))})"
        raise UsageError("the simulator does not take these options", where=env, found=found, remedy=remedy) from error
    except (gymnasium.error.Error, ImportError) as error:
        own = "`env` of [sim] is a gymnasium id; of a package of yours MODULE:ID, which must be on PYTHONPATH"
        remedy = "make setup" if env in ENVIRONMENTS else own
        raise UsageError("the simulator cannot be made", where=env, found=error, remedy=remedy) from error


def load_entry_point(name: str) -> Any:
    """What "module:name" names; its packages are imported now."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
