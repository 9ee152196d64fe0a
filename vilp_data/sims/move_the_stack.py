"""Move-the-Stack with one arm in robosuite: a simulated stand-in for the paper's real task."""

from __future__ import annotations

import numpy as np

from vilp_data.errors import UsageError
from vilp_data.sims.arm_env import ArmEnv
from vilp_data.sims.arm_scene import TABLE_HEIGHT
from vilp_data.sims.move_the_stack_scene import (
    BOARD_SIZE,
    CUP_COLOURS,
    CUP_RADII,
    CUP_SIDES,
    NEST_STEP,
    StackScene,
)
from vilp_data.types import F64

PLACES = np.array([(-0.12, -0.17), (0.10, 0.17)])  # x, y of the stack and of the board, least and most
APART = 0.15  # centres of stack and board: there is room for open fingers between them
HANDS = np.array([(-0.14, -0.17, 0.93, np.pi / 2 - 0.6), (0.10, 0.17, 1.03, np.pi / 2 + 0.6)])  # x, y, z, turn
HEIGHT_ERROR = 0.003  # of each cup above what it stands on
NESTED_RADIUS = 0.004  # a cup has 2 mm of play in another
UPRIGHT = np.cos(np.radians(5))


class MoveTheStackEnv(ArmEnv[StackScene]):
    """Carry `n_cups` nested cups as one onto the black board. Views: front, side.

    It is solved once all cups are still nested and upright, the lowest stands with its whole foot on the board, and the gripper has let
    go. The seed of `reset` draws where stack and board are and how they are turned, and where the hand begins.
    """

    def __init__(
        self,
        n_cups: int = 3,
        *,
        robot: str = "Panda",
        height: int = 96,
        width: int = 128,
        cameras: bool = True,
    ) -> None:
        if not 2 <= n_cups <= len(CUP_COLOURS):
            raise UsageError("a stack has 2 or 3 cups", where="n_cups", found=n_cups)
        self.n_cups = n_cups
        scene = StackScene(robot, n_cups, image_size=(height, width) if cameras else None)
        super().__init__(scene, height=height, width=width, cameras=cameras)

    def draw_episode(self, rng: np.random.Generator) -> None:
        while True:
            stack, board = rng.uniform(PLACES[0], PLACES[1], (2, 2))
            if np.hypot(*(stack - board)) > APART:
                break
        self.scene.stack_pose = np.array([*stack, rng.uniform(0, 2 * np.pi / CUP_SIDES)])  # flat sides repeat
        self.scene.board_pose = np.array([*board, rng.uniform(0, np.pi / 2)])
        self.scene.hand_pose = rng.uniform(*HANDS)

    def tags(self) -> dict[str, str]:
        x, y, turn = self.scene.board_pose
        return {"goal": "board", "object": "cups", "n_cups": str(self.n_cups), "board": f"{x:.4f},{y:.4f},{turn:.4f}"}

    def is_stacked(self) -> bool:
        """Whether all cups are upright, each in the one below it."""
        feet = np.array([self.scene.cup_position(cup) for cup in range(self.n_cups)])
        steps = np.diff(feet, axis=0) - [0, 0, NEST_STEP]
        nested = np.hypot(steps[:, 0], steps[:, 1]) < NESTED_RADIUS
        return bool(nested.all() and (np.abs(steps[:, 2]) < HEIGHT_ERROR).all() and self._upright())

    def stands_on_board(self) -> bool:
        """Whether the lowest cup's whole foot is on the board."""
        x, y, turn = self.scene.board_pose
        foot = self.scene.cup_position(0) - [x, y, TABLE_HEIGHT + BOARD_SIZE[2]]
        across = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) @ foot[:2]
        return bool(
            (np.abs(across) + CUP_RADII[0] < np.array(BOARD_SIZE[:2]) / 2).all() and abs(foot[2]) < HEIGHT_ERROR
        )

    def is_solved(self) -> bool:
        return self.stands_on_board() and self.is_stacked() and not self.scene.gripper_touches_cups()

    def _upright(self) -> bool:
        axes: list[F64] = [self.scene.cup_rotation(cup)[:, 2] for cup in range(self.n_cups)]
        return all(axis[2] > UPRIGHT for axis in axes)
