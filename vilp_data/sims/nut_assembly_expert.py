"""A scripted expert of Nut-Assembly that does not always do the same, and tries again when the nut slips or comes to rest on the peg.

Drawn for each episode: how the hand comes to the handle, which way it turns to get there and where along the handle it closes; which way
the handle points when the nut goes over the peg; whether it gets there straight or in a bow, how high and how fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from vilp_data.sims.arm_motion import CLOSE, OPEN, ArmMotion, at_height, raised
from vilp_data.sims.nut_assembly import NutAssemblyEnv
from vilp_data.types import F32, F64

APPROACHES = ("above", "slanted")
PATHS = {"straight": 0.0, "left": 0.10, "right": -0.10}
"""How far the middle of the way to the peg is off the straight one, m."""
HEADINGS = {"robot": math.pi, "left": math.pi / 2, "right": -math.pi / 2}
"""Where the handle points when the nut goes over the peg, rad in the world: beyond the peg the arm does not reach it."""

ATTEMPTS = 4
PATIENCE = 40  # steps of one leg
CLOSE_STEPS, OPEN_STEPS = 4, 5
ABOVE = 0.08  # m over the handle, where the hand waits before it goes down
BESIDE = 0.05  # m further out along the handle, where a slanted approach waits
LET_GO_HEIGHT = 0.90  # of the nut's centre: its hole is around the peg by then
HELD_WITHIN = 0.02  # m between the fingers and the place on the handle that they closed on
WRIST_MARGIN = 0.25  # rad that are kept from the last joint's ends
DETOUR = math.pi / 2  # rad that the hand may turn further than it must
TURN = (
    0.9  # rad that the hand is told to turn at once: less than the quarter turn from which on it would go the other way
)


@dataclass(frozen=True)
class Turns:
    """The hand's angles about the vertical when it grasps and when it lets go, rad, counted on beyond a full turn; and the heading."""

    heading: str
    grasp: float
    let_go: float


@dataclass(frozen=True)
class Style:
    """How an episode is done.

    approach  one of `APPROACHES`
    grip      m from the handle's middle outwards to where the fingers close
    turns     of the first attempt; its heading is every attempt's, where the arm can
    path      one of `PATHS`, seen from above on the way to the peg
    height    m at which the nut travels, in the world
    pace      m that a step may aim ahead
    """

    approach: str
    grip: float
    turns: Turns
    path: str
    height: float
    pace: float


class NutAssemblyExpert:
    """Drives a freshly reset `NutAssemblyEnv`: iterate `actions()`, and step the environment with each before asking for the next.

    The nut is around the peg when the fingers let go; what the success rule waits for is that it falls.
    """

    goes_on_after_success = False

    def __init__(self, env: NutAssemblyEnv, *, seed: int = 0) -> None:
        self.env, self.scene = env, env.scene
        self._arm = ArmMotion(env.scene, env.scene.grip_rotation()[:, 0])
        self._angle = _angle(env.scene.grip_rotation()[:, 0])
        self._wrist = self._wrist_range()
        random = np.random.default_rng((seed, 1))  # not what the start was drawn from
        self._turn = "left" if (turns := self._drawn_turns(random)).grasp > self._angle else "right"
        self.style = Style(
            approach=str(random.choice(APPROACHES)),
            grip=float(random.uniform(0.002, 0.012)),
            turns=turns,
            path=str(random.choice(list(PATHS))),
            height=float(random.uniform(0.98, 1.03)),
            pace=float(random.uniform(0.04, 0.055)),
        )

    def tags(self) -> dict[str, str]:
        """The style, for an episode's log."""
        style = self.style
        return {
            "style_approach": style.approach,
            "style_grip": f"{style.grip:.4f}",
            "style_turn": self._turn,
            "style_heading": style.turns.heading,
            "style_path": style.path,
            "style_height": f"{style.height:.3f}",
            "style_pace": f"{style.pace:.3f}",
        }

    def actions(self) -> Iterator[F32]:
        """Actions float32 [7] until the nut is around the peg, or `ATTEMPTS` have not brought it there."""
        turns = self.style.turns
        for _ in range(ATTEMPTS):
            yield from self._grasp(turns)
            if self._is_held():
                yield from self._carry(turns)
            yield from self._let_go()
            if self.env.is_solved():
                return
            turns = min(self._possible_turns(), key=self._reluctance, default=turns)

    # --- one attempt ---

    def _grasp(self, turns: Turns) -> Iterator[F32]:
        """Come to the handle, wherever it is, and close the fingers around it."""
        aside = BESIDE if self.style.approach == "slanted" else 0.0
        yield from self._go(lambda: self._to_grip(aside, ABOVE), OPEN, turns.grasp, 0.03, turned=0.3)
        yield from self._go(self._to_grip, OPEN, turns.grasp, 0.005)
        yield from self._arm.stay(CLOSE, CLOSE_STEPS)

    def _carry(self, turns: Turns) -> Iterator[F32]:
        """Lift the nut, bring it above the peg and lower it; the fingers stay closed."""
        start, peg = self.scene.nut_position(), np.array([*self.scene.peg_xy, self.style.height])
        yield from self._go(self._to_nut(at_height(start, self.style.height)), CLOSE, turns.grasp, 0.05)
        along = (peg - start)[:2]
        bow = PATHS[self.style.path] * np.array([-along[1], along[0], 0.0]) / np.linalg.norm(along)
        if bow.any():
            middle = at_height((start + peg) / 2 + bow, self.style.height)
            yield from self._go(self._to_nut(middle), CLOSE, turns.let_go, 0.06, turned=math.inf)
        yield from self._go(self._to_nut(peg), CLOSE, turns.let_go, 0.003)
        yield from self._go(self._to_nut(at_height(peg, LET_GO_HEIGHT)), CLOSE, turns.let_go, 0.012, turned=0.3)

    def _let_go(self) -> Iterator[F32]:
        """Open, draw the fingers off the handle's end (a nut that hangs on one of them stays around the peg), and rise."""
        yield from self._arm.stay(OPEN, OPEN_STEPS)
        off = self.scene.grip_position() + BESIDE * self.scene.nut_rotation()[:, 0]
        yield from self._go(self._to_hand(off), OPEN, self._angle, 0.02)
        yield from self._go(self._to_hand(raised(self.scene.grip_position(), ABOVE)), OPEN, self._angle, 0.03)

    def _go(
        self, error: Callable[[], F64], gripper: float, angle: float, tolerance: float, *, turned: float = 0.1
    ) -> Iterator[F32]:
        """Until `error` is less than `tolerance` m and the hand within `turned` rad of `angle`; its turns are counted on the way."""
        for _ in range(PATIENCE):
            fingers = self.scene.grip_rotation()[:, 0]
            self._angle += _wrapped(_angle(fingers) - self._angle)
            offset, turn = error(), angle - self._angle
            if np.linalg.norm(offset) < tolerance and abs(turn) < turned:
                return
            ahead = self._angle + float(np.clip(turn, -TURN, TURN))
            self._arm.fingers_along = np.array([math.cos(ahead), math.sin(ahead), 0.0])
            yield self._arm.action(
                offset * min(1.0, self.style.pace / max(float(np.linalg.norm(offset)), 1e-9)), gripper
            )

    # --- where things are ---

    def _to_grip(self, further: float = 0.0, above: float = 0.0) -> F64:
        """From the fingers to the place on the handle where they close, or one so many m further out and above."""
        place = self.scene.handle_position() + (self.style.grip + further) * self.scene.nut_rotation()[:, 0]
        return raised(place, above) - self.scene.grip_position()

    def _to_hand(self, place: F64) -> Callable[[], F64]:
        return lambda: place - self.scene.grip_position()

    def _to_nut(self, place: F64) -> Callable[[], F64]:
        return lambda: place - self.scene.nut_position()

    def _is_held(self) -> bool:
        """Whether the place on the handle that the fingers closed on is still between them."""
        return bool(np.linalg.norm(self._to_grip()) < HELD_WITHIN)

    # --- which way to turn ---

    def _possible_turns(self) -> list[Turns]:
        """All that the wrist allows, for the nut as it lies: the fingers are alike, so either half turn grasps it."""
        handle, place = _angle(self.scene.nut_rotation()[:, 0]), self.scene.handle_position()
        peg = np.array([*self.scene.peg_xy, 0.0])
        found = []
        for heading, wanted in HEADINGS.items():
            turn = _wrapped(wanted - handle)
            for half_turns in range(-3, 4):
                grasp = handle + (half_turns + 0.5) * math.pi
                if self._is_reached(grasp, place) and self._is_reached(grasp + turn, peg):
                    found.append(Turns(heading, grasp, grasp + turn))
        return found

    def _drawn_turns(self, random: np.random.Generator) -> Turns:
        """A heading, and how to get there, of those that do not turn the hand much more than the least that is possible."""
        possible = self._possible_turns()
        least = min(self._turning(turns) for turns in possible)
        easy = [turns for turns in possible if self._turning(turns) < least + DETOUR]
        heading = random.choice(sorted({turns.heading for turns in easy}))
        alike = [turns for turns in easy if turns.heading == heading]
        return alike[int(random.integers(len(alike)))]

    def _turning(self, turns: Turns) -> float:
        return abs(turns.grasp - self._angle) + abs(turns.let_go - turns.grasp)

    def _reluctance(self, turns: Turns) -> tuple[bool, float]:
        return turns.heading != self.style.turns.heading, abs(turns.grasp - self._angle)

    def _is_reached(self, angle: float, place: F64) -> bool:
        low, high = self._wrist
        return low < angle - self._azimuth(place) < high

    def _azimuth(self, place: F64) -> float:
        return _angle(place - self.scene.robots[0].base_pos)

    def _wrist_range(self) -> tuple[float, float]:
        """The hand's angles that the last joint allows, less the azimuth of where it is: that joint turns it about the vertical, against
        the first one's sense."""
        robot, model = self.scene.robots[0], self.scene.model_and_data[0]
        joint = robot._ref_joint_indexes[-1]
        now = float(self.scene.sim.data.qpos[robot._ref_joint_pos_indexes[-1]])
        low, high = model.jnt_range[joint]
        middle = self._angle - self._azimuth(self.scene.grip_position()) + now
        return middle - high + WRIST_MARGIN, middle - low - WRIST_MARGIN


def _angle(direction: F64) -> float:
    """Of a direction's shadow on the table, rad from the world's x, in (-pi, pi]."""
    return math.atan2(direction[1], direction[0])


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)
