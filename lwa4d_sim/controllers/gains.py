"""Gains as the scenario writes them (one number or one per axis) and as the control laws use them (rows)."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from annotated_types import MinLen

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array, NonNegative

Gain = NonNegative | Annotated[tuple[NonNegative, ...], MinLen(1)]


def gain_rows(gains: Sequence[Gain], size: int, name: str) -> Array:
    """One row of ``size`` gains per simulation, (N, size); (1, size) when all simulations share them.

    Raises:
        ScenarioError: a list of gains has another length than ``size``.
    """
    shared = all(gain == gains[0] for gain in gains)
    rows = [_row(gain, size, name) for gain in (gains[:1] if shared else gains)]
    return np.stack(rows)


def _row(gain: Gain, size: int, name: str) -> Array:
    values = np.atleast_1d(np.asarray(gain, float))
    if len(values) not in (1, size):
        raise ScenarioError(
            f"has {len(values)} values; give one number or one for each of {size} axes", key=f"controller.{name}"
        )
    return np.broadcast_to(values, (size,)).copy()
