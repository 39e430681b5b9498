"""Which poses to measure: of many within the joint limits those that together tell most."""

import numpy as np

from lwa4d_sim.calibration.error_model import ErrorModel
from lwa4d_sim.calibration.identifiable import random_poses
from lwa4d_sim.calibration.measured import Instrument
from lwa4d_sim.interfaces import Array, IntArray

_CANDIDATES = 10  # drawn for each pose wanted (assumed; more hardly raises the determinant)
_FEWEST, _MOST = 200, 2000  # candidates, so that small plans have a choice and large ones take seconds
_PRIOR = 1e-6  # information that each coordinate has before the first pose: makes the determinant positive


def informative_poses(
    model: ErrorModel, kept: IntArray, instrument: Instrument, count: int, rng: np.random.Generator
) -> Array:
    """Readings (count, n) [rad or m], chosen one by one so that the determinant of the information grows most.

    The greedy form of D-optimal design (Fedorov 1972, "Theory of optimal experiments"); for arms Borm and Menq 1991,
    "Determination of optimal measurement configurations for robot calibration based on observability measure". Since
    log det(M + J'J) = log det M + log det(1 + J M^-1 J'), a candidate costs one small determinant. No pose is taken
    twice, so poses spread where a second visit would tell as much.
    """
    q = random_poses(model, int(np.clip(_CANDIDATES * count, max(_FEWEST, count), max(_MOST, count))), rng)
    weights = instrument.weights
    J = model.predict(q, np.zeros(len(model.names))).J[:, : len(weights), kept] * weights[:, None] * model.scale[kept]
    J = J / np.abs(J).max()
    covariance = np.eye(len(kept)) / _PRIOR
    left = np.ones(len(q), bool)
    chosen = []
    for _ in range(count):
        S = np.eye(len(weights)) + J @ covariance @ J.swapaxes(-1, -2)
        gain = np.where(left, np.linalg.slogdet(S)[1], -np.inf)
        best = int(np.argmax(gain))
        chosen.append(best)
        left[best] = False
        C = covariance @ J[best].T
        covariance = covariance - C @ np.linalg.solve(S[best], C.T)
        covariance = (covariance + covariance.T) / 2.0
    return np.asarray(q[chosen])
