"""Operating points: where the arm is, how it moves, and what it is asked for."""

from dataclasses import dataclass
from typing import Any

from lwa4d_sim.interfaces import Array, IntArray


@dataclass(frozen=True, slots=True)
class Points:
    """Operating points: instants of the motion [s] (P,), with q, dq, ddq (P, n) and the references there."""

    t: Array
    q: Array
    dq: Array
    ddq: Array
    ref: Any

    def part(self, rows: slice | IntArray) -> "Points":
        """Some of the points."""
        ref = type(self.ref)(*(None if field is None else field[rows] for field in self.ref))
        return Points(self.t[rows], self.q[rows], self.dq[rows], self.ddq[rows], ref)
