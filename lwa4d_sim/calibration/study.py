"""What the command does: from an arm and measured or simulated poses to corrections, and how well they serve."""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.calibration.error_model import ErrorModel
from lwa4d_sim.calibration.fit import Fit, fit, residual
from lwa4d_sim.calibration.identifiable import Split, random_poses, structure
from lwa4d_sim.calibration.measured import Instrument, Measured, measure
from lwa4d_sim.calibration.poses import informative_poses
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.interfaces import Array, IntArray

_HELD_OUT = 5  # every fifth pose is kept from the fit, to judge it


@dataclass(frozen=True)
class Study:
    """Everything that a calibration found.

    Attributes:
        model: the arm's coordinates.
        split: which of them poses can tell apart.
        instrument: what measured.
        data, unseen: poses of the fit and poses held out.
        fit: the estimate.
        truth: what exact measurements of the same poses would give (p,), where the true arm is known.
    """

    model: ErrorModel
    split: Split
    instrument: Instrument
    data: Measured
    unseen: Measured
    fit: Fit
    truth: Array | None

    def rms(self, data: Measured, xi: Array) -> tuple[float, float]:
        """Root mean square distance [m] and angle [rad] (NaN without) between ``data`` and the arm with ``xi``."""
        shifts, turns = residual(self.model, xi, data)
        return float(np.sqrt((shifts**2).sum(axis=1).mean())), float(np.sqrt((turns**2).sum(axis=1).mean()))


def calibrate(model: ErrorModel, data: Measured, instrument: Instrument, joints_only: bool) -> Study:
    """Fit measured poses; every fifth one is held out.

    Raises:
        IdentificationError: see `fit`.
    """
    found = question(model, instrument, joints_only)
    index = np.arange(len(data.q))
    held = index % _HELD_OUT == _HELD_OUT - 1
    used, unseen = data.take(index[~held]), data.take(index[held])
    return Study(model, found, instrument, used, unseen, fit(model, used, found.kept, instrument), None)


def simulate(
    model: ErrorModel, instrument: Instrument, count: int, error: float, seed: int, joints_only: bool
) -> Study:
    """Draw an arm that is off, measure it in poses that tell most, fit, and compare with what was drawn.

    Args:
        model: the nominal arm.
        instrument: its noise is added.
        count: poses for the fit; a quarter more, drawn at random, are held out.
        error: standard deviation of each coordinate [m and rad].
        seed: of everything drawn.
        joints_only: only the joints' zeros are off, and only these are fitted.

    Raises:
        IdentificationError: too few poses.
    """
    rng = np.random.default_rng(seed)
    found = question(model, instrument, joints_only)
    xi = np.zeros(len(model.names))
    wrong: IntArray = model.offsets if joints_only else np.arange(len(xi))
    xi[wrong] = error * rng.normal(size=len(wrong))
    q = informative_poses(model, found.kept, instrument, count, rng)
    data = measure(model, xi, q, instrument, rng)
    unseen = measure(model, xi, random_poses(model, max(count // 4, 10), rng), instrument, rng)
    truth = fit(model, measure(model, xi, q, instrument), found.kept, instrument).xi
    return Study(model, found, instrument, data, unseen, fit(model, data, found.kept, instrument), truth)


def question(model: ErrorModel, instrument: Instrument, joints_only: bool) -> Split:
    """What the instrument could tell of this arm, in any poses.

    Raises:
        IdentificationError: nothing.
    """
    found = structure(model, instrument.angle is not None, model.offsets if joints_only else None)
    if len(found.kept) == 0:
        raise IdentificationError("positions of this tool do not show the zero of any joint; measure angles as well")
    return found
