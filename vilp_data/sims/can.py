"""Can: one arm lifts a can out of one bin into its compartment of another, in robosuite's own world (`PickPlaceCan`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from robosuite.environments.manipulation.pick_place import PickPlaceCan

from vilp_data.sims.arm_env import ArmEnv
from vilp_data.sims.arm_scene import ArmScene, Camera
from vilp_data.types import F64

COMPARTMENT = 3  # of four: robosuite counts them as it counts milk, bread, cereal, can


class CanScene(ArmScene, PickPlaceCan):  # type: ignore[misc]  # robosuite has no types
    """robosuite's world, start distribution and success rule, without the three objects that it draws places for and then takes away.

    There they lie on the floor, 14 m from the arm, and cost a quarter of a step's time. The gray shapes in the compartments are drawn,
    as in its pictures, and touch nothing.
    """

    cameras: ClassVar[Mapping[str, Camera | str]] = {
        # Nearer than robosuite's own, so that both bins fill the width.
        "front": Camera((0.72, 0.02, 1.68), (0.06, 0.02, 0.97), 52.0),
        "wrist": "robot0_eye_in_hand",
    }

    def can_position(self) -> F64:
        """The can's middle, float64 [3], world."""
        return np.array(self.sim.data.body_xpos[self.obj_body_id["Can"]])

    def can_axis(self) -> F64:
        """From the can's bottom to its top, float64 [3], world, of length 1."""
        return np.array(self.sim.data.body_xmat[self.obj_body_id["Can"]]).reshape(3, 3)[:, 2]

    def compartment(self) -> F64:
        """The middle of the floor where the can belongs, float64 [3], world; it reaches 98 mm to either side along x, 123 mm along y."""
        x, y, _ = self.bin_size
        return np.asarray(self.bin2_pos + np.array([x / 4, y / 4, 0.02]), np.float64)

    # --- what robosuite calls ---

    objects: list[Any]

    def not_in_bin(self, obj_pos: F64, bin_id: int) -> bool:
        return bool(super().not_in_bin(obj_pos, COMPARTMENT))  # the can is the first of one here, not the last of four

    def _construct_objects(self) -> None:
        super()._construct_objects()
        *self._absent, can = self.objects
        self.objects, self.object_id = [can], 0

    def _get_placement_initializer(self) -> None:
        """The can's place is drawn as robosuite draws it: the last of four, clear of the others."""
        present = self.objects
        self.objects = [*self._absent, *present]
        super()._get_placement_initializer()
        self.objects = present
        draw, absent = self.placement_initializer.sample, {thing.name for thing in self._absent}
        self.placement_initializer.sample = lambda: {
            name: place for name, place in draw().items() if name not in absent
        }


class CanEnv(ArmEnv[CanScene]):
    """Bring the can into its compartment, the near right one as the front view shows it. Views: front, wrist.

    It is solved, as robosuite has it, once the can's middle is inside the compartment, less than 100 mm above the bin's own middle,
    and further than 42 mm from the place between the fingertips. The seed of `reset` draws where the can stands, how it is turned,
    and the joints' first angles.
    """

    def __init__(
        self,
        *,
        robot: str = "Panda",
        height: int = 96,
        width: int = 96,
        cameras: bool = True,
    ) -> None:
        scene = CanScene(robot, image_size=(height, width) if cameras else None)
        super().__init__(scene, height=height, width=width, cameras=cameras)

    def draw_episode(self, rng: np.random.Generator) -> None:
        """Nothing: the scene draws all there is to draw."""

    def is_solved(self) -> bool:
        return bool(self.scene._check_success())

    def tags(self) -> dict[str, Any]:
        return {"goal": "compartment4", "object": "can"}
