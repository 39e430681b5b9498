"""Weighted least squares for the errors of an arm's frames, with intervals, and poses that do not fit the others."""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.calibration.error_model import ErrorModel
from lwa4d_sim.calibration.identifiable import explain, rows, split
from lwa4d_sim.calibration.measured import Instrument, Measured
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.interfaces import Array, IntArray
from lwa4d_sim.rotations import rotation_vector

_FAR = 0.1  # of the arm's length, and [rad]: beyond, errors are not small, or frames and units are mixed up (assumed)
_OUTLIER = 0.01  # chance that a fit without outliers warns of one (assumed)
_CONFIDENCE = 0.95


@dataclass(frozen=True)
class Fit:
    """What the poses say about the coordinates ``kept``.

    Attributes:
        kept: indices of the fitted coordinates (k,).
        xi: errors of all coordinates (p,) [m, rad]; zero where not fitted.
        std_error: of the fitted ones (k,).
        half: half-width of their 95 % intervals (k,), Student's t.
        ratio: residuals in units of the instrument's stated noise; near 1 where the model explains all.
        outliers: indices of poses that do not fit the others.
    """

    kept: IntArray
    xi: Array
    std_error: Array
    half: Array
    ratio: float
    outliers: IntArray


def residual(model: ErrorModel, xi: Array, data: Measured) -> tuple[Array, Array]:
    """Measured minus predicted: shifts (K, 3) [m] and rotation vectors (K, 3) [rad], base axes; NaN without turns."""
    x, R, _ = model.predict(data.q, xi)
    turns = np.full_like(x, np.nan) if data.R is None else rotation_vector(data.R @ R.swapaxes(-1, -2))
    return data.x - x, turns


def fit(model: ErrorModel, data: Measured, kept: IntArray, instrument: Instrument) -> Fit:
    """Fit the coordinates ``kept`` to the poses.

    The problem is nearly linear, so a Levenberg-Marquardt search from the nominal arm ends in the one minimum. Its
    derivative takes the turn from prediction to measurement for small; the minimum does not depend on that.

    Raises:
        IdentificationError: the poses are too few or too alike, and for which coordinates; or they are far from the
            nominal arm's.
    """
    from scipy.optimize import least_squares
    from scipy.special import stdtrit

    check_near(model, data)
    check_poses(model, data, kept)
    weights = instrument.weights
    d = len(weights)
    scale = model.scale[kept]

    def full(z: Array) -> Array:
        xi = np.zeros(len(model.names))
        xi[kept] = z * scale
        return xi

    def error(z: Array) -> Array:
        return (-np.hstack(residual(model, full(z), data))[:, :d] * weights).ravel()

    def slope(z: Array) -> Array:
        J = model.predict(data.q, full(z)).J[:, :d, kept] * weights[:, None]
        return J.reshape(-1, len(kept)) * scale

    found = least_squares(error, np.zeros(len(kept)), slope, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    J, e = slope(found.x), error(found.x)
    freedom = len(e) - len(kept)
    variance = float(e @ e) / freedom
    Q, R = np.linalg.qr(J)
    inverse = np.linalg.inv(R)
    std_error = np.sqrt(variance) * np.linalg.norm(inverse, axis=1) * scale
    half = float(stdtrit(freedom, 0.5 + _CONFIDENCE / 2)) * std_error
    xi = full(found.x)
    check_known(model, kept, half, data)
    strange = outliers(Q.reshape(-1, d, len(kept)), e.reshape(-1, d))
    return Fit(kept, xi, std_error, half, float(np.sqrt(variance)), strange)


def check_near(model: ErrorModel, data: Measured) -> None:
    """Refuse poses that the nominal arm is far from.

    Raises:
        IdentificationError: see above.
    """
    shifts, turns = residual(model, np.zeros(len(model.names)), data)
    far, turned = float(np.median(np.linalg.norm(shifts, axis=1))), float(np.median(np.linalg.norm(turns, axis=1)))
    if far > _FAR * model.length or turned > _FAR * np.pi:
        by = f"{far:.3g} m" + ("" if np.isnan(turned) else f" and {turned:.3g} rad")
        raise IdentificationError(
            f"{data.source}: half of the poses are {by} or more off the nominal arm's; at most "
            f"{_FAR * model.length:.3g} m and {_FAR * np.pi:.3g} rad can be calibrated. Poses must be in the frame of "
            "the arm's base, and the tool's frame must be the one measured"
        )


def check_poses(model: ErrorModel, data: Measured, kept: IntArray) -> None:
    """Refuse poses that are too few or too alike.

    Raises:
        IdentificationError: which coordinates they cannot tell, and why.
    """
    d = 3 if data.R is None else 6
    needed = len(kept) // d + 1
    if len(data.q) < needed:
        raise IdentificationError(
            f"{data.source}: {len(data.q)} poses give {d * len(data.q)} numbers for {len(kept)} coordinates; at least "
            f"{needed} poses are needed, and three times as many are advisable"
        )
    seen = split(
        rows(model, model.predict(data.q, np.zeros(len(model.names))).J, data.R is not None), kept, model.scale
    )
    if len(seen.lost):
        told = "; ".join(explain(model, seen))
        raise IdentificationError(
            f"{data.source}: the poses are too alike to tell {len(seen.lost)} of {len(kept)} coordinates: {told}. "
            "Measure poses in which every joint moves through much of its range"
        )


def check_known(model: ErrorModel, kept: IntArray, half: Array, data: Measured) -> None:
    """Refuse estimates that are known too badly to be small errors.

    Raises:
        IdentificationError: which coordinates.
    """
    lost = half > _FAR * model.scale[kept]
    if lost.any():
        names = ", ".join(
            f"{model.names[j]} (± {h:.2g} {model.units[j]})" for j, h in zip(kept[lost], half[lost], strict=True)
        )
        raise IdentificationError(
            f"{data.source}: the poses tell too little about {names}; measure poses in which every joint moves through "
            "much of its range, or fit the zeros only with --joints-only"
        )


def outliers(Q: Array, e: Array) -> IntArray:
    """Poses whose residuals are too large for noise: the mean-shift test, each pose against all others.

    With H = Q Qᵀ the residuals of pose k, left out of the fit, have the sum of squares s = e_k' (1 - H_kk)^-1 e_k, and
    s / d over what remains follows F(d, m - k - d) (Cook and Weisberg 1982, "Residuals and influence in regression",
    section 2.2.2), with Bonferroni's bound for K poses.

    Args:
        Q: orthonormal basis of the weighted derivatives (K, d, k).
        e: weighted residuals (K, d).
    """
    from scipy.special import fdtri

    K, d, k = Q.shape
    rest = K * d - k - d
    total = float((e**2).sum())
    if rest < 1 or total == 0.0:
        return np.zeros(0, dtype=np.int64)
    left = np.eye(d) - Q @ Q.swapaxes(-1, -2)
    judged = np.linalg.eigvalsh(left)[:, 0] > 1e-9  # the others decide a coordinate alone and always fit
    own = np.zeros(K)
    own[judged] = (e[judged] * np.linalg.solve(left[judged], e[judged][..., None])[..., 0]).sum(axis=1)
    ratio = (own / d) / (np.maximum(total - own, 1e-300) / rest)
    return np.flatnonzero(ratio > fdtri(d, rest, 1.0 - _OUTLIER / K))
