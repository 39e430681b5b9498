"""Least squares, batch, total and recursive; and which parameters the data do not tell."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.options import Method
from lwa4d_sim.interfaces import Array

INTERVAL = 1.959963984540054  # standard errors on each side of a 95 % interval (normal distribution)
RANK = 1e-7  # least singular value of scaled columns that is told from rounding, over the largest (assumed)
FEWEST = 4  # assumed: equations for each parameter
DARK = 1e-4  # share of a parameter that may lie in what the data do not tell and still count as rounding (assumed)


@dataclass(frozen=True)
class Estimate:
    """The answer of a fit of W windows, n rows each, to r parameters.

    Attributes:
        x: parameters (r,); NaN where the data do not tell.
        nearest: of all parameters that fit as well (r,) the nearest to the prior: x where the data tell.
        gain: dependence of ``nearest`` on b, (r, W, n).
        residual: (W, n) [N m].
        weights: of the joints' rows (n,).
        lost: mask (r,) of parameters that the data do not tell.
        condition: of the columns, each scaled to length 1.
    """

    x: Array
    nearest: Array
    gain: Array
    residual: Array
    weights: Array
    lost: NDArray[np.bool_]
    condition: float


def fit(
    Y: Array, b: Array, prior: Array, usual: Array, method: Method = "weighted", noise: Array | None = None
) -> Estimate:
    """Fit Y x = b.

    Args:
        Y: regressor (W, n, r).
        b: torque (W, n) [N m].
        prior: parameters (r,) to stay with where the data do not tell.
        usual: rms of columns (r,) that are well excited; of one beside which that is rounding the data tell nothing.
        method: ordinary (thesis, eq. 4.29); weighted by each joint's residual variance; or total, weighted as well,
            which knows that the regressor is noisy too.
        noise: what ``total`` needs: the mean of E^T E of the errors E of [Y b] (W n, r + 1), weighted like them.

    Raises:
        IdentificationError: fewer equations than parameters.
    """
    n, r = Y.shape[1:]
    rows = int(Y.any(axis=-1).sum())
    if rows < FEWEST * r:
        raise IdentificationError(f"{rows} equations are too few for {r} parameters; at least {FEWEST * r} are needed")
    rest = b - Y @ prior
    Y = np.where(np.sqrt((Y**2).mean(axis=(0, 1))) > RANK * usual, Y, 0.0)
    weights: Array = np.ones(n)
    gain, lost, condition = _inverse(Y, weights)
    if method != "ordinary":
        weights = _weights(rest - Y @ np.einsum("rwn,wn->r", gain, rest), b)
        gain, lost, condition = _inverse(Y, weights)
    x = prior + np.einsum("rwn,wn->r", gain, rest)
    if method == "total":
        told = ~lost
        x[told] = _total(Y[..., told], b - Y[..., lost] @ x[lost], weights, noise, told)
    return Estimate(np.where(lost, np.nan, x), x, gain, rest - Y @ (x - prior), weights, lost, condition)


def _inverse(Y: Array, weights: Array) -> tuple[Array, NDArray[np.bool_], float]:
    """Pseudo-inverse (Y^T W Y)^+ Y^T W as (r, W, n), the parameters it leaves open (r,), and the condition number."""
    root = np.sqrt(weights)
    A = (Y * root[:, None]).reshape(-1, Y.shape[-1])
    length = np.linalg.norm(A, axis=0)
    scale = np.where(length > 0, length, 1.0)
    U, s, Vt = np.linalg.svd(A / scale, full_matrices=False)
    seen = s > RANK * s[0]
    dark = Vt[~seen]
    lost = (length == 0) | (np.abs(dark).max(axis=0, initial=0.0) > DARK)
    gain = (Vt[seen].T / s[seen]) @ U[:, seen].T / scale[:, None]
    condition = float(s[0] / s[-1]) if s[-1] > 0 else np.inf
    return gain.reshape(-1, *Y.shape[:2]) * root, lost, condition


def _weights(residual: Array, b: Array) -> Array:
    """Inverse residual variance of each joint's rows, at most that of rounding."""
    variance = (residual**2).mean(axis=0)
    least = 1e-24 * max(float((b**2).max()), 1e-12)
    return np.asarray(1.0 / np.maximum(variance, least))


def _total(Y: Array, b: Array, weights: Array, noise: Array | None, told: NDArray[np.bool_]) -> Array:
    """Total least squares with errors of known size: normal equations less what the errors add to them.

    Raises:
        IdentificationError: the errors are not known, or as large as what they are errors of.
    """
    if noise is None:
        raise IdentificationError("total least squares needs to know how noisy the regressor is")
    root = np.sqrt(weights)
    A = np.concatenate([Y, b[..., None]], axis=-1) * root[:, None]
    A = A.reshape(-1, A.shape[-1])
    both = np.append(told, True)
    G = A.T @ A - noise[np.ix_(both, both)]
    scale = np.linalg.norm(A, axis=0)[:-1]
    G, right = G[:-1, :-1] / np.outer(scale, scale), G[:-1, -1] / scale
    if np.linalg.eigvalsh(G)[0] <= 0:
        raise IdentificationError("the positions are too noisy for total least squares: nothing is left of the motion")
    return np.asarray(np.linalg.solve(G, right) / scale)


def recursive(Y: Array, b: Array, weights: Array, forgetting: float = 1.0) -> Iterator[Array]:
    """Recursive least squares (Ljung 1999, section 11.2): the estimate (r,) after each window.

    Args:
        Y: as for `fit`.
        b: likewise.
        weights: of the joints' rows (n,).
        forgetting: weight of a row at the next one; 1 forgets nothing and ends where the batch does.
    """
    r = Y.shape[-1]
    scale = np.sqrt((Y**2).mean(axis=(0, 1)))
    scale[scale == 0] = 1.0
    x, P = np.zeros(r), 1e8 * np.eye(r)  # no prior to speak of, in units of the columns
    P /= float(weights.min())
    for rows, values in zip(Y / scale, b, strict=True):
        S = np.diag(forgetting / weights) + rows @ P @ rows.T
        K = np.linalg.solve(S, rows @ P).T
        x = x + K @ (values - rows @ x)
        P = (P - K @ rows @ P) / forgetting
        P = 0.5 * (P + P.T)
        yield x / scale
