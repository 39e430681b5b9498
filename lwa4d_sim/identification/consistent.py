"""The least-squares parameters that real bodies can have: every pseudo-inertia positive definite, no friction negative.

A convex problem (Wensing, Kim, Slotine 2018, "Linear matrix inequalities for physically-consistent inertial parameter
identification"), drawn to a nominal model where the data say nothing, by the metric of Lee, Wensing and Park 2020,
"Geometric robot dynamic identification: a convex programming approach", to second order about that model:
|dJ|^2 = tr(J0^-1 dJ J0^-1 dJ). It does not depend on where a link has its frame, nor on units.
"""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.inertia import from_pseudo_inertia, pseudo_inertia
from lwa4d_sim.interfaces import Array

#: Weight of the nominal model: as data that know each parameter to 100 times its nominal size (or spread). It moves a
#: combination that the data know to a standard error of s (in nominal sizes) by at most WEIGHT s |dx| standard errors,
#: |dx| being how far the estimate is from the nominal model: below 1e-3 for s <= 1 and |dx| <= 10 (derived).
WEIGHT = 1e-4
#: A link's pseudo-inertia is at least this part of the nominal one and its trace, in the nominal metric, at most REACH
#: times; a joint's parameter is within REACH spreads (assumed: no arm is that far from its data sheet, and double
#: precision still tells a body 1e8 times longer than thick from an impossible one).
FLOOR, REACH = 1e-4, 1e4
_THIN = 1e-6  # a nominal link whose least second moment is less than this part of the greatest is thickened (assumed)
_PASSES, _SETTLED = 4, 1e-6  # of the solver, and the relative gain in the cost's root that ends them (assumed)
_LARGEST = 1e100  # numbers beyond have no unit that would make sense, and their squares no double (assumed)

# Entries of a symmetric 4 x 4 matrix as a vector, upper triangle by columns, with the Frobenius norm (Clarabel's order)
_ROW, _COLUMN = np.array([0, 0, 1, 0, 1, 2, 0, 1, 2, 3]), np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])
_ROOT = np.where(_ROW == _COLUMN, 1.0, np.sqrt(2.0))
_ONE = np.where(_ROW == _COLUMN, 1.0, 0.0)


def margin(pi: Array) -> Array:
    """How far inertial parameters (..., 10) are from impossible: least over greatest second moment, (...) [-].

    About the centre of mass, along the principal axes; 1 for a ball, 0 for a flat plate or a thin rod, negative where
    no body has these parameters, -inf without a mass.
    """
    m = pi[..., 0]
    positive = m > 0
    c = pi[..., 1:4] / np.where(positive, m, 1.0)[..., None]
    about_com = pseudo_inertia(pi)[..., :3, :3] - pi[..., 1:4, None] * c[..., None, :]
    moments = np.linalg.eigvalsh(about_com)
    greatest = np.maximum(np.abs(moments).max(-1), np.finfo(float).tiny)
    return np.where(positive, moments[..., 0] / greatest, -np.inf)


def is_consistent(pi: Array) -> bool:
    """Whether some bodies of positive density have the inertial parameters (..., 10)."""
    return bool(np.isfinite(pi).all() and (margin(pi) > 0).all())


def consistent(
    R: Array,
    z: Array,
    prior: Array,
    *,
    n_links: int,
    spread: Array,
    lower: Array,
    upper: Array,
    weight: float = WEIGHT,
) -> Array:
    """The possible parameters x (P,) with the least |R x - z|^2 + weight |x - prior|^2, the last in the prior's metric.

    Where the unbounded minimum is possible it is returned as it is; elsewhere Clarabel solves the semidefinite program.
    Should it stop short, its answer is drawn towards the prior until it is possible: whatever the data, the result is
    consistent and fits them no worse than the prior does.

    Args:
        R: factor of the whitened least-squares problem (r, P); any rank.
        z: its right-hand side (r,).
        prior: nominal parameters (P,): ten inertial parameters a link, then those of the joints.
        n_links: number of links n; P >= 10 n.
        spread: how far a joint's parameter is usually from its prior (P - 10 n,), positive.
        lower: least value of each joint's parameter (P - 10 n,), or -inf.
        upper: greatest value, or inf; one that equals ``lower`` fixes the parameter.
        weight: of the prior; see `WEIGHT`.

    Raises:
        IdentificationError: a number is missing, infinite or absurdly large, or the prior is not possible itself.
    """
    space = _space(prior, n_links, spread, lower, upper)
    if R.shape != (len(z), len(prior)):
        raise IdentificationError(f"a factor of shape {R.shape} does not fit {len(z)} values, {len(prior)} parameters")
    for name, values in {"factor": R, "right-hand side": z}.items():
        if not (np.abs(values) <= _LARGEST).all():  # false for NaN too
            bad = float(values[~(np.abs(values) <= _LARGEST)][0])
            raise IdentificationError(f"the {name} of the least-squares problem holds {bad:g}; check the data's units")
    if not weight > 0:
        raise IdentificationError(f"the prior's weight is {weight:g}; it must be positive")

    # In the right singular vectors, scaled to p = (sigma^2 + weight)^1/2 V^T y, the cost is |p - best|^2 and a constant
    U, sigma, Vt = np.linalg.svd(R @ space.T)
    known = sigma > max(R.shape) * np.finfo(float).eps * sigma.max(initial=0.0)  # the rest is rounding
    sigma, c = sigma[known], U.T[: len(sigma)][known] @ (z - R @ space.origin)
    scale = np.full(len(Vt), np.sqrt(weight))
    scale[: len(sigma)] = np.hypot(sigma, scale[: len(sigma)])
    best = np.zeros(len(Vt))
    best[: len(sigma)] = sigma / scale[: len(sigma)] * c
    W = Vt.T / scale

    def cost(y: Array) -> float:
        return float(np.linalg.norm(scale * (Vt @ y) - best))

    free = W @ best
    if space.holds(free):
        return space.parameters(free)
    found = min(space.drawn(free), space.shortened(free), key=cost)
    size = 1.0  # of the step from ``free``, in standard errors; the solver's tolerances suit numbers near one
    for _ in range(_PASSES):
        y = _project(space, free, size * W)
        if np.isfinite(y).all():
            before, found = cost(found), min(found, space.drawn(y), key=cost)
            if size != 1.0 and cost(found) > (1.0 - _SETTLED) * before:
                break
        size = cost(found)
    return space.parameters(found)


@dataclass(frozen=True)
class _Space:
    """Coordinates y in which the prior is 0 and its metric the plain one: x = origin + T y.

    A link's ten are the entries of L^-1 dJ L^-T, J0 = L L^T; a joint's parameter is counted in its spread.

    Attributes:
        T: (P, free) parameters by coordinate.
        origin: (P,) the prior, flat links thickened.
        n: number of links.
        low, high: bounds of the joints' coordinates (free - 10 n,).
        bounds: (2, P - 10 n) of the parameters, against rounding.
    """

    T: Array
    origin: Array
    n: int
    low: Array
    high: Array
    bounds: Array

    def parameters(self, y: Array) -> Array:
        x = self.origin + self.T @ y
        x[10 * self.n :] = np.clip(x[10 * self.n :], *self.bounds)
        if not is_consistent(x[: 10 * self.n].reshape(-1, 10)):  # no data lead here: see FLOOR and REACH
            raise IdentificationError("the nominal model has a link too far from its frame for double precision")
        return x

    def _shares(self, y: Array) -> tuple[Array, Array]:
        """Greatest part of y (n,), (free - 10 n,) that each link and joint can go from the prior; inf for any."""
        links, joints = y[: 10 * self.n].reshape(-1, 10), y[10 * self.n :]
        least, trace = np.linalg.eigvalsh(_matrix(links))[:, 0], links @ _ONE
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(least < 0, (FLOOR - 1.0) / least, np.inf)
            share = np.minimum(share, np.where(trace > 0, 4.0 * (REACH - 1.0) / trace, np.inf))
            bound = np.where(joints < 0, self.low, self.high)
            return share, np.where(joints == 0, np.inf, bound / joints)

    def holds(self, y: Array) -> bool:
        """Whether y is possible."""
        return all((share >= 1).all() for share in self._shares(y))

    def drawn(self, y: Array) -> Array:
        """Every link and joint drawn towards its own prior as far as it must."""
        links, joints = (np.minimum(share, 1.0) for share in self._shares(y))
        return np.asarray(y * np.concatenate([np.repeat(links, 10), joints]))

    def shortened(self, y: Array) -> Array:
        """All of them drawn towards the prior by one factor, which makes no convex cost greater than the prior's."""
        return y * min(1.0, *(float(share.min(initial=1.0)) for share in self._shares(y)))


def _space(prior: Array, n: int, spread: Array, lower: Array, upper: Array) -> _Space:
    pi, joints = prior[: 10 * n].reshape(-1, 10).copy(), prior[10 * n :]
    if not np.isfinite(prior).all():
        bad = int(np.argmin(np.isfinite(prior)))
        raise IdentificationError(f"parameter {bad + 1} of the nominal model is {prior[bad]:g}; it must be finite")
    for k in range(n):
        pi[k] = _thickened(pi[k], k)
    for k, (value, low, high, size) in enumerate(zip(joints, lower, upper, spread, strict=True)):
        if not low <= value <= high:
            raise IdentificationError(
                f"joint parameter {k + 1} of the nominal model is {value:g}, outside its bounds {low:g} to {high:g}"
            )
        if not (size > 0 and np.isfinite(size)):
            raise IdentificationError(f"the spread of joint parameter {k + 1} is {size:g}; it must be positive")
    L = np.linalg.cholesky(pseudo_inertia(pi))
    T = np.zeros((len(prior), len(prior)))
    for k in range(n):
        block = slice(10 * k, 10 * k + 10)
        T[block, block] = from_pseudo_inertia(L[k] @ _matrix(np.eye(10)) @ L[k].T).T
    T[10 * n :, 10 * n :] = np.diag(spread)
    free = np.concatenate([np.ones(10 * n, bool), lower < upper])
    low, high = (np.clip((bound - joints) / spread, -REACH, REACH)[lower < upper] for bound in (lower, upper))
    return _Space(T[:, free], np.concatenate([pi.ravel(), joints]), n, low, high, np.stack([lower, upper]))


def _thickened(pi: Array, k: int) -> Array:
    """A nominal link (10,) that is flat or a thin rod, given a little thickness; any other as it is."""
    at = margin(pi)
    if not at > -1e-9 or not pi[4:].any():  # rounding makes a flat one a little less than possible
        raise IdentificationError(f"link {k + 1} of the nominal model has no mass or no extent, or no body is like it")
    if at >= _THIN:
        return pi
    J = pseudo_inertia(pi)
    moments = np.linalg.eigvalsh(J[:3, :3] - np.outer(pi[1:4], pi[1:4]) / pi[0])
    J[:3, :3] += _THIN * moments[-1] * np.eye(3)
    return from_pseudo_inertia(J)


def _matrix(y: Array) -> Array:
    """Symmetric matrices (..., 4, 4) of vectors (..., 10)."""
    Y = np.empty((*y.shape[:-1], 4, 4))
    Y[..., _ROW, _COLUMN] = Y[..., _COLUMN, _ROW] = y / _ROOT
    return Y


def _project(space: _Space, free: Array, W: Array) -> Array:
    """The possible y = free + W e with the least |e|, or as near as the solver comes."""
    import clarabel
    from scipy import sparse

    links = 10 * space.n
    ones = np.kron(np.eye(space.n), _ONE)
    trace = np.hstack([ones, np.zeros((space.n, len(free) - links))])
    joints = np.eye(len(free))[links:]
    lower, upper = np.isfinite(space.low), np.isfinite(space.high)
    # s = offset + slope y >= 0: sums of second moments and of masses, joints' bounds; then the matrices
    slope = np.vstack([-trace, joints[lower], -joints[upper], np.eye(len(free))[:links]])
    offset = np.concatenate(
        [
            np.full(space.n, 4.0 * (REACH - 1.0)),
            -space.low[lower],
            space.high[upper],
            np.tile((1.0 - 1.01 * FLOOR) * _ONE, space.n),  # a hundredth for the solver's tolerance
        ]
    )
    cones = [clarabel.NonnegativeConeT(len(slope) - links), *[clarabel.PSDTriangleConeT(4)] * space.n]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    size = len(free)
    solver = clarabel.DefaultSolver(
        sparse.eye_array(size, format="csc"),
        np.zeros(size),
        sparse.csc_array(-slope @ W),
        offset + slope @ free,
        cones,
        settings,
    )
    return np.asarray(free + W @ np.asarray(solver.solve().x))
