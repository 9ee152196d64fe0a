"""Ways over a table that keep clear of what stands on it: the cheapest over a grid of square cells (Dijkstra)."""

from __future__ import annotations

import heapq
import math

import numpy as np

from vilp_data.types import F64

CELL = 20.0  # px
SHY = 4.0  # px nearer than clear that make a cell cost twice as much; further on the cost rises with the square

Cell = tuple[int, int]
NEIGHBOURS = {(row, column): math.hypot(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column}


def cell_centres(width: float, height: float) -> F64:
    """float64 [rows,columns,2], px: x, y of every cell that lies on the table."""
    rows, columns = np.indices((int(height // CELL), int(width // CELL)))
    return np.asarray((np.stack([columns, rows], axis=-1) + 0.5) * CELL, np.float64)


def clear_cost(centres: F64, things: F64, clear: float) -> F64:
    """What crossing each cell costs, float64 [rows,columns]: 1 at `clear` px from all of the points `things` [n,2], more the nearer. Ways
    near or through things are taken where there is no other, or where others are very long."""
    offset = centres[:, :, None] - things
    near = np.hypot(offset[..., 0], offset[..., 1]).min(axis=2)
    return np.asarray(1 + (np.maximum(clear - near, 0) / SHY) ** 2, np.float64)


class Ways:
    """The cheapest ways from `start` to everywhere, over cells at `centres` [rows,columns,2] that cost `cost` [rows,columns]."""

    def __init__(self, start: F64, centres: F64, cost: F64) -> None:
        self._centres, self._shape = centres, (cost.shape[0], cost.shape[1])
        self._first = self._cell(start)
        self._paid = {self._first: 0.0}
        self._before: dict[Cell, Cell] = {}
        costs = cost.tolist()
        queue = [(0.0, self._first)]
        while queue:
            paid, cell = heapq.heappop(queue)
            if paid > self._paid[cell]:
                continue
            for (down, right), length in NEIGHBOURS.items():
                row, column = there = (cell[0] + down, cell[1] + right)
                if not (0 <= row < self._shape[0] and 0 <= column < self._shape[1]):
                    continue
                total = paid + length * costs[row][column]
                if total < self._paid.get(there, math.inf):
                    self._paid[there], self._before[there] = total, cell
                    heapq.heappush(queue, (total, there))

    def cost_to(self, goal: F64) -> float:
        """In cells that cost 1; without the one that `goal` lies in, which may be at the edge of a thing by intention."""
        last = self._cell(goal)
        return self._paid[self._before.get(last, last)]

    def to(self, goal: F64) -> list[F64]:
        """Points [2] that follow on the start, each in a cell beside the last one's, and `goal` itself at the end."""
        cell, way = self._cell(goal), [goal]
        while self._before.get(cell, self._first) != self._first:
            cell = self._before[cell]
            way.append(self._centres[cell])
        return way[::-1]

    def _cell(self, point: F64) -> Cell:
        """Of a point, or the nearest one for a point beside the grid."""
        row, column = int(point[1] // CELL), int(point[0] // CELL)
        return min(max(row, 0), self._shape[0] - 1), min(max(column, 0), self._shape[1] - 1)
