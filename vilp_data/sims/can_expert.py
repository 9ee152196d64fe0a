"""A scripted expert of Can that does not always do the same, and tries again when the can slips or falls over.

Drawn for each episode: how the fingers are turned, whether the hand comes from above or down a slope, how high and by which way the can
is carried, where in its compartment it is let go, and how fast all this goes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from vilp_data.sims.arm_motion import CLOSE, OPEN, ArmMotion, at_height, raised
from vilp_data.sims.can import CanEnv
from vilp_data.types import F32, F64

CAN_HALF_HEIGHT = 0.04
WALL_TOP = 0.90  # of both bins, world
CLEARANCE = 0.02  # between the walls and the bottom of a can that is carried over them
GRIP_ABOVE_MIDDLE = 0.015  # the palm, 40 mm above the grip site, then stays above the walls
RELEASE_HEIGHT = 0.012  # of the can's bottom, when it is let go
TRAVEL_HEIGHT = 0.95  # of an empty hand, world: the fingertips, 10 mm lower, clear the walls
APPROACH = 0.08  # m, where the last stretch to the can begins: above it, and on a slope as far to the side
HIGHEST = 0.10  # m, of the path, beyond what clears the walls
SPOT = (
    (-0.05, -0.02),
    (-0.07, -0.03),
)  # m along x and y, from the compartment's middle: its near part, for the arm's sake
TURN = np.pi / 6  # at most, of the fingers, from across the arm's reach
REACH = 0.73  # m from the arm's base: further out the hand leans outwards, for straight down it cannot be there
MOST_LEAN = 0.6  # its sine
HAND = 0.21  # m, from the grip site to where it turns
LEADS = (0.028, 0.055)  # m that the place steered for is ahead of the hand: its speed
SPACING = 0.01  # m, between the points of a way
PATIENCE = 20  # steps of one way, beyond one for each of its points
CLOSE_STEPS, OPEN_STEPS = 4, 4
ATTEMPTS = 4
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Style:
    """How an episode is done.

    turn      rad, of the direction that the fingers open along, from across the arm's reach
    approach  "above": straight down on the can; "left", "right": down a slope, between the fingers' two sides
    path      "straight": up, across, down; "arch": up to the walls, over in an arch
    height    m, of the path beyond what clears the walls
    spot      m along x and y, from the compartment's middle
    lead      m that the place steered for is ahead of the hand
    """

    turn: float
    approach: str
    path: str
    height: float
    spot: tuple[float, float]
    lead: float


class CanExpert:
    """Drives a freshly reset `CanEnv`: iterate `actions()`, and step the environment with each before asking for the next."""

    goes_on_after_success = False

    def __init__(self, env: CanEnv, *, seed: int = 0) -> None:
        self.env = env
        random = np.random.default_rng((seed, 1))  # not what the start was drawn from
        self.style = Style(
            turn=float(random.uniform(-TURN, TURN)),
            approach=str(random.choice(["above", "left", "right"])),
            path=str(random.choice(["straight", "arch"])),
            height=float(random.uniform(0, HIGHEST)),
            spot=(float(random.uniform(*SPOT[0])), float(random.uniform(*SPOT[1]))),
            lead=float(random.uniform(*LEADS)),
        )
        self._arm = ArmMotion(env.scene, np.array([0.0, 1.0, 0.0]))

    def tags(self) -> dict[str, str]:
        """The style, for an episode's log."""
        style = self.style
        return {
            "style_turn": f"{np.degrees(style.turn):.0f}",
            "style_approach": style.approach,
            "style_path": style.path,
            "style_height": f"{style.height:.3f}",
            "style_spot": f"{style.spot[0]:.3f},{style.spot[1]:.3f}",
            "style_lead": f"{style.lead:.3f}",
        }

    def actions(self) -> Iterator[F32]:
        """Actions float32 [7] until the can is where it belongs, or `ATTEMPTS` have not brought it there."""
        for _ in range(ATTEMPTS):
            if self.env.is_solved():
                return
            yield from self._grasp()
            yield from self._carry()

    def _grasp(self) -> Iterator[F32]:
        """To the can, wherever it stands or lies, and close the fingers around it."""
        arm, scene = self._arm, self.env.scene
        grip = raised(scene.can_position(), GRIP_ABOVE_MIDDLE if self._stands() else 0.0)
        self._turn_for(grip)
        free = np.cross(arm.fingers_along, UP)  # the way that the fingers do not bar
        before = grip + APPROACH * (free * {"above": 0, "left": -1, "right": 1}[self.style.approach] + UP)
        here = scene.grip_position()
        yield from self._follow(
            [here, at_height(here, max(here[2], before[2], TRAVEL_HEIGHT)), before], OPEN, tolerance=0.012
        )
        yield from self._follow([before, grip], OPEN, tolerance=0.005)
        yield from arm.stay(CLOSE, CLOSE_STEPS)

    def _carry(self) -> Iterator[F32]:
        """Over the walls into the compartment, let go, and rise; nothing where the can is not between the fingers."""
        arm, scene, style = self._arm, self.env.scene, self.style
        start = scene.grip_position()
        held_by = start - scene.can_position()
        up = at_height(start, WALL_TOP + CLEARANCE + CAN_HALF_HEIGHT + held_by[2])
        if style.path == "straight":
            up = raised(up, style.height)
        yield from self._follow([start, up], CLOSE, tolerance=0.02)
        if not self._holds():
            return
        goal = scene.compartment() + np.array([*style.spot, CAN_HALF_HEIGHT + RELEASE_HEIGHT + held_by[2]])
        over = at_height(goal, up[2])
        yield from self._follow(self._way(up, over), CLOSE, tolerance=0.02)
        if not self._holds():
            return
        yield from self._follow([over, goal], CLOSE, tolerance=0.01)
        yield from arm.stay(OPEN, OPEN_STEPS)
        yield from self._follow([goal, over], OPEN, tolerance=0.02)

    def _way(self, start: F64, end: F64) -> list[F64]:
        """From one place to another at the same height, in the style of this episode."""
        if self.style.path == "straight":
            return [start, end]
        share = np.linspace(0, 1, 20)
        return [raised(start + s * (end - start), float(self.style.height * np.sin(np.pi * s))) for s in share]

    def _follow(self, corners: list[F64], gripper: float, *, tolerance: float) -> Iterator[F32]:
        """After a place that runs ahead of the hand, by the style's lead, from corner to corner; ends within `tolerance` m of the last,
        or where it gets no further."""
        way = _dense(corners)
        for _ in range(len(way) + PATIENCE):
            here = self.env.scene.grip_position()
            while len(way) > 1 and np.linalg.norm(way[0] - here) < self.style.lead:
                way.pop(0)
            if len(way) == 1 and np.linalg.norm(way[0] - here) < tolerance:
                return
            self._turn_for(way[0])
            yield self._arm.action(_shortened(way[0] - here, self.style.lead), gripper)

    def _turn_for(self, place: F64) -> None:
        """Turn the hand as it is to be at a place: the fingers by the style, or across a can that lies; leaning where it must."""
        out = at_height(place - self.env.scene.robots[0].base_pos, 0.0)
        reach = float(np.linalg.norm(out))
        out = out / reach
        lean = np.arcsin(np.clip((reach - REACH) / HAND, 0.0, MOST_LEAN))
        turn = self.style.turn
        standing = np.cross(UP, out) * np.cos(turn) - out * np.sin(turn)
        along = standing if self._stands() else np.cross(self.env.scene.can_axis(), UP)
        self._arm.pointing = np.sin(lean) * out - np.cos(lean) * UP
        along = along - (along @ self._arm.pointing) * self._arm.pointing
        self._arm.fingers_along = along / np.linalg.norm(along)

    def _stands(self) -> bool:
        return bool(abs(self.env.scene.can_axis()[2]) > np.cos(np.pi / 4))

    def _holds(self) -> bool:
        """Whether the can is between the fingers."""
        gap = self.env.scene.grip_position() - self.env.scene.can_position()
        return bool(np.linalg.norm(gap) < CAN_HALF_HEIGHT)


def _dense(corners: list[F64]) -> list[F64]:
    """Points `SPACING` apart at most, from the first corner to the last."""
    way = [corners[0]]
    for start, end in pairwise(corners):
        count = max(int(np.ceil(np.linalg.norm(end - start) / SPACING)), 1)
        way += [start + (end - start) * (n + 1) / count for n in range(count)]
    return way


def _shortened(error: F64, longest: float) -> F64:
    """`error`, no longer than that."""
    return np.asarray(error * min(1.0, longest / max(float(np.linalg.norm(error)), 1e-9)), np.float64)
