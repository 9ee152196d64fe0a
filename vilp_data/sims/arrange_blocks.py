"""Arrange-Blocks: three squares on a table are to stand in one row, moved by a round pusher (the paper's simulated task).

World coordinates are px of 800x480, x to the right and y down, as the picture shows them. Motion is quasi-static: what is not
pushed stands still.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
import pymunk
from gymnasium.spaces import Box, Dict

from vilp_data.errors import UsageError, nearest
from vilp_data.sims.arrange_blocks_picture import COLOURS, Colour, draw_table
from vilp_data.sims.arrange_blocks_table import (
    BLOCK_SIDE,
    IMAGE_SHAPE,
    PUSHER_RADIUS,
    WALL,
    WORLD,
    draw_start,
    in_a_row,
    row_share,
)
from vilp_data.types import F32, F64, U8

CONTROL_HZ, PHYSICS_HZ = 10, 100
STIFFNESS, DAMPING = 100.0, 20.0  # of the pusher's pull towards its target, 1/s^2 and 1/s: Push-T's
FRICTION = 1.0  # of block against pusher and block: a push slightly off the centre then turns a block less

Observation = dict[str, U8 | F32]


class ArrangeBlocksEnv(gymnasium.Env):  # type: ignore[misc]  # gymnasium is an optional extra that the type check leaves out
    """Push three squares until they stand in one row.

    Observation  "top" (with cameras): uint8 [96,160,3] RGB, top row first; "low_dim": float32 [2], the pusher's position, px of 800x480
    Action       float32 [2], where the pusher is to go, px of 800x480; in force for 0.1 s
    Reward       share of the two differences in y that are within tolerance: 0, 0.5 or 1; an episode ends at 1
    Info         "state": float64 [11], px and radians in [0, 2 pi), in the order of `state_names`;
                 "is_success": bool; "hold_action": float32 [2], the target that keeps the pusher where it is

    `colour` is of the blocks: gray ones are the task, purple ones the paper's off-target demonstrations.
    `reset(options={"state": s})` puts the bodies exactly at `s`, at rest; without it `seed` draws a start without overlaps that
    is not solved yet. The pusher's velocity is not part of the state: a demonstration begins at rest, so its first state and its
    actions give all that follows, but a state from its middle gives no more than the picture.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array"],
        "render_fps": CONTROL_HZ,
        "state_names": (
            "pusher_x", "pusher_y", *(f"block{number}_{axis}" for number in (1, 2, 3) for axis in ("x", "y", "angle")),
        ),
        "state_periods": (math.inf, math.inf, *(3 * (math.inf, math.inf, 2 * math.pi))),
        "controlled_state": (0, 1),
        "replay_tolerance": 1e-3,
    }  # fmt: skip

    def __init__(self, render_mode: str | None = None, *, cameras: bool = True, colour: str = "gray") -> None:
        if colour not in COLOURS:
            raise UsageError(f"no blocks are {colour!r}", where="colour", remedy=nearest(colour, COLOURS))
        self.render_mode, self.cameras, self.colour = render_mode, cameras, cast(Colour, colour)
        self.action_space = Box(np.zeros(2, np.float32), np.array(WORLD, np.float32))
        spaces = {"low_dim": Box(-np.inf, np.inf, (2,), np.float32)}
        if cameras:
            spaces["top"] = Box(0, 255, IMAGE_SHAPE, np.uint8)
        self.observation_space = Dict(spaces)
        self._build()

    @property
    def blocks(self) -> F64:
        """Centres and angles of the blocks, float64 [3,3]: x, y in px, angle in radians, not wrapped."""
        return np.array([(*body.position, body.angle) for body in self._blocks])

    @property
    def pusher(self) -> F64:
        """Its position, float64 [2]."""
        return np.array(self._pusher.position)

    def tags(self) -> dict[str, str]:
        """What sets an episode of this environment apart from one of another task or variant."""
        return {"goal": "row", "object": f"{self.colour}_blocks"}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin at `options["state"]` (float64 [11]), else at random. Raises UsageError for a state of another shape."""
        super().reset(seed=seed)
        self._build()
        given = (options or {}).get("state")
        self._place(draw_start(self.np_random) if given is None else np.asarray(given, np.float64))
        return self._observe(), self._info()

    def step(self, action: F32) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Pull the pusher towards `action` for 0.1 s. Never truncates: how long an episode may last is the caller's to say."""
        target = pymunk.Vec2d(*np.clip(np.asarray(action, np.float64), 0.0, WORLD).tolist())
        dt = 1 / PHYSICS_HZ
        for _ in range(PHYSICS_HZ // CONTROL_HZ):
            pull = STIFFNESS * (target - self._pusher.position) - DAMPING * self._pusher.velocity
            self._pusher.velocity += pull * dt
            self._space.step(dt)
        info = self._info()
        return self._observe(), row_share(self.blocks[:, 1]), info["is_success"], False, info

    def render(self) -> U8 | None:
        """A larger picture, uint8 [480,800,3]; None without a render mode."""
        if self.render_mode is None:
            return None
        return draw_table(self.blocks, self.pusher, self.colour, width=round(WORLD[0]))

    def _build(self) -> None:
        """A new space: bodies at rest, no contacts remembered."""
        self._space = pymunk.Space()
        self._space.damping = 0.0  # quasi-static: a velocity lasts one step, unless something pushes
        width, height = WORLD
        corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
        for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
            self._space.add(pymunk.Segment(self._space.static_body, start, end, WALL))
        self._pusher = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        disc = pymunk.Circle(self._pusher, PUSHER_RADIUS)
        disc.friction = FRICTION
        self._space.add(self._pusher, disc)
        self._blocks = [self._add_block() for _ in range(3)]

    def _add_block(self) -> pymunk.Body:
        size = (BLOCK_SIDE, BLOCK_SIDE)
        body = pymunk.Body(1.0, pymunk.moment_for_box(1.0, size))
        shape = pymunk.Poly.create_box(body, size)
        shape.friction = FRICTION
        self._space.add(body, shape)
        return body

    def _place(self, state: F64) -> None:
        if state.shape != (11,):
            remedy = "give float64 [11]: " + ", ".join(self.metadata["state_names"])
            raise UsageError("not a state of Arrange-Blocks", found=f"shape {state.shape}", remedy=remedy)
        self._pusher.position = (float(state[0]), float(state[1]))
        for body, (x, y, angle) in zip(self._blocks, state[2:].reshape(3, 3).tolist(), strict=True):
            body.position, body.angle = (x, y), angle
        for body in (self._pusher, *self._blocks):
            self._space.reindex_shapes_for_body(body)

    def _observe(self) -> Observation:
        low_dim = self.pusher.astype(np.float32)
        if not self.cameras:
            return {"low_dim": low_dim}
        return {
            "low_dim": low_dim,
            "top": draw_table(self.blocks, self.pusher, self.colour, width=IMAGE_SHAPE[1]),
        }

    def _info(self) -> dict[str, Any]:
        blocks = self.blocks
        blocks[:, 2] %= 2 * math.pi
        return {
            "state": np.concatenate([self.pusher, blocks.ravel()]),
            "is_success": in_a_row(blocks[:, 1]),
            "hold_action": self.pusher.astype(np.float32),
        }
