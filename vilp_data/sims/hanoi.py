"""Towers of Hanoi with one arm in robosuite."""

from __future__ import annotations

import numpy as np

from vilp_data.errors import UsageError
from vilp_data.sims.arm_env import ArmEnv
from vilp_data.sims.arm_scene import TABLE_HEIGHT
from vilp_data.sims.hanoi_scene import DISC_HEIGHT, DISC_RADII, HanoiScene

ON_PEG_RADIUS = 0.010  # a disc on a peg can be 6 mm off centre
ON_PEG_HEIGHT_ERROR = 0.004


class HanoiEnv(ArmEnv[HanoiScene]):
    """Move `n_discs` discs, one at a time, from peg 0 to peg `goal_peg`, never a larger one on a smaller one. Views: front, side.

    It is solved once all discs lie on the goal peg in order and the gripper has let go: the end alone is judged, not whether a disc was
    ever carried with another or lay on a smaller one. The seed of `reset` draws the base angle, uniform in (pi/4, 3pi/4); the arm
    begins in one pose.
    """

    def __init__(
        self,
        n_discs: int = 3,
        *,
        robot: str = "Panda",
        goal_peg: int = 2,
        height: int = 96,
        width: int = 160,
        cameras: bool = True,
    ) -> None:
        if not 1 <= n_discs <= len(DISC_RADII):
            raise UsageError("Towers of Hanoi has 1 to 3 discs", where="n_discs", found=n_discs)
        if goal_peg not in (1, 2):
            raise UsageError("the goal is peg 1 or 2; all discs begin on peg 0", where="goal_peg", found=goal_peg)
        self.n_discs, self.goal_peg = n_discs, goal_peg
        scene = HanoiScene(robot, n_discs, image_size=(height, width) if cameras else None)
        super().__init__(scene, height=height, width=width, cameras=cameras)

    def draw_episode(self, rng: np.random.Generator) -> None:
        self.scene.base_angle = float(rng.uniform(np.pi / 4, 3 * np.pi / 4))

    @property
    def base_angle(self) -> float:
        """Angle of the row of pegs, rad."""
        return self.scene.base_angle

    def tags(self) -> dict[str, str]:
        goal, angle = f"peg{self.goal_peg}", f"{self.base_angle:.6f}"
        return {"goal": goal, "object": "discs", "n_discs": str(self.n_discs), "base_angle": angle}

    def is_on_peg(self, disc: int, peg: int, level: int) -> bool:
        """Whether `disc` lies flat on `peg` with `level` discs below it."""
        offset = self.scene.disc_position(disc) - [*self.scene.peg_xy[peg], TABLE_HEIGHT + (level + 0.5) * DISC_HEIGHT]
        return bool(np.hypot(*offset[:2]) < ON_PEG_RADIUS and abs(offset[2]) < ON_PEG_HEIGHT_ERROR)

    def is_solved(self) -> bool:
        """Every disc at its height on the goal peg, which also puts them in order, and none in the gripper."""
        placed = all(self.is_on_peg(disc, self.goal_peg, self.n_discs - 1 - disc) for disc in range(self.n_discs))
        return placed and not self.scene.gripper_touches_discs()
