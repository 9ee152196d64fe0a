"""robosuite's Nut-Assembly with one nut: it is to go around a peg."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from robosuite.environments.manipulation.nut_assembly import NutAssembly

from vilp_data.errors import UsageError
from vilp_data.sims.arm_env import ArmEnv
from vilp_data.sims.arm_scene import ArmScene, Camera
from vilp_data.types import F64

SHAPES = ("square", "round")  # robosuite's order, of nuts and of pegs


class NutScene(ArmScene, NutAssembly):  # type: ignore[misc]  # robosuite has no types
    """robosuite's own world, start and success rule for one nut, whose goal may be the other peg.

    robosuite drops the nut that is not asked for far away from the table; here it is left out of the world.
    """

    cameras: ClassVar[Mapping[str, Camera | str]] = {
        "front": Camera((0.75, 0.0, 1.30), (0.04, 0.0, 0.905), 38.0),
        "side": Camera((0.05, 0.70, 1.40), (0.035, 0.01, 0.885), 42.0),  # so high that no peg hides the other
    }

    def __init__(self, robot: str, *, nut: str, peg: str, image_size: tuple[int, int] | None) -> None:
        self.nut_shape, self.peg_shape = nut, peg
        super().__init__(robot, image_size=image_size)

    @property
    def peg_xy(self) -> F64:
        """Where the goal peg stands: float64 [2], world."""
        return np.array(
            self.sim.data.body_xpos[(self.peg1_body_id, self.peg2_body_id)[SHAPES.index(self.peg_shape)]][:2]
        )

    def nut_position(self) -> F64:
        """Centre of the nut, float64 [3], world."""
        return np.array(self.sim.data.body_xpos[self.obj_body_id[self.nuts[0].name]])

    def nut_rotation(self) -> F64:
        """Float64 [3,3]: its first column points along the handle, its third up where the nut lies flat."""
        return np.array(self.sim.data.body_xmat[self.obj_body_id[self.nuts[0].name]]).reshape(3, 3)

    def handle_position(self) -> F64:
        """Middle of the nut's handle, float64 [3], world."""
        return np.array(self.sim.data.site_xpos[self.object_site_ids[0]])

    # --- what robosuite calls ---

    def on_peg(self, obj_pos: F64, peg_id: int) -> bool:
        """Of the goal peg, whichever the nut's own would be."""
        return bool(super().on_peg(obj_pos, SHAPES.index(self.peg_shape)))

    def _load_model(self) -> None:
        super()._load_model()
        for shape, nut in zip(SHAPES, tuple(self.nuts), strict=True):
            if shape != self.nut_shape:
                self.nuts.remove(nut)  # the model's objects are this list
                self.model.worldbody.remove(self.model.worldbody.find(f"body[@name='{nut.root_body}']"))
                self.placement_initializer.samplers[f"{nut.name}Sampler"].reset()


class NutAssemblyEnv(ArmEnv[NutScene]):
    """Bring a nut around a peg: the square nut around the square peg, unless `nut` and `peg` say otherwise. Views: front, side.

    It is solved as robosuite's `NutAssemblySquare` is: the nut's centre less than 30 mm beside the peg's in x and in y, and less than
    50 mm above the table, and the place between the fingertips more than 42 mm from it.
    """

    def __init__(
        self,
        *,
        nut: str = "square",
        peg: str = "square",
        robot: str = "Panda",
        height: int = 80,
        width: int = 80,
        cameras: bool = True,
    ) -> None:
        for name, shape in (("nut", nut), ("peg", peg)):
            if shape not in SHAPES:
                raise UsageError(f"a {name} is square or round", where=name, found=shape)
        self.nut, self.peg = nut, peg
        scene = NutScene(robot, nut=nut, peg=peg, image_size=(height, width) if cameras else None)
        super().__init__(scene, height=height, width=width, cameras=cameras)

    def draw_episode(self, rng: np.random.Generator) -> None:
        """Nothing here: where the nut lies, robosuite draws."""

    def tags(self) -> dict[str, str]:
        return {"goal": f"{self.peg}_peg", "object": f"{self.nut}_nut"}

    def is_solved(self) -> bool:
        return bool(self.scene._check_success())
