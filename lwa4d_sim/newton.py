"""Numeric inverse of a forward map: damped least squares with restarts, many targets at once."""

from collections.abc import Callable

import numpy as np

from lwa4d_sim.interfaces import Array, Pose

RESIDUAL = 1e-9  # [m and entries of R] a solution is at least this good
RESTARTS, ITERATIONS = 12, 60  # assumed: a target within reach needs a few starts of about 15 iterations
STEP_MAX = 0.5  # [rad or m] assumed: the longest step of a joint, over which a sine is still nearly straight


def solve(
    forward: Callable[[Array], tuple[Pose, Array]],
    start: Array,
    x: Array,
    R: Array | None,
    *,
    limits: tuple[Array, Array],
    search: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Joint angles for K targets.

    Args:
        forward: q (K, n) to the pose and the Jacobian (K, 6, n).
        start: first guess (K, n).
        x: target points [m], (K, 3).
        R: target orientations (K, 3, 3), or None when only the point matters.
        limits: lower and upper joint limits, each (n,), infinite where there is none.
        search: finite range in which further guesses are drawn, each (n,); the draw is the same in every call.

    Returns:
        q (K, n) within the limits, and the error that is left (K,): the target is reached where it is below RESIDUAL.
    """
    rng = np.random.default_rng(0)
    q, error = _descend(forward, start, x, R, limits)
    for _ in range(RESTARTS):
        failed = ~(error < RESIDUAL)
        if not failed.any():
            break
        guess = rng.uniform(*search, (int(failed.sum()), q.shape[-1]))
        q[failed], error[failed] = _descend(forward, guess, x[failed], None if R is None else R[failed], limits)
    return q, error


def _descend(
    forward: Callable[[Array], tuple[Pose, Array]], q: Array, x: Array, R: Array | None, limits: tuple[Array, Array]
) -> tuple[Array, Array]:
    lower, upper = limits
    rows = 3 if R is None else 6
    q = np.clip(q, lower, upper)
    for _ in range(ITERATIONS):
        pose, J = forward(q)
        e = x - pose.x
        error = np.abs(e).max(-1)
        if R is not None:
            e = np.concatenate([e, 0.5 * np.cross(pose.R, R, axis=-2).sum(-1)], -1)  # sine of the angle, times the axis
            error = np.maximum(error, np.abs(R - pose.R).max((-2, -1)))  # as the sine is also zero half a turn away
        if (error < 1e-3 * RESIDUAL).all():
            break
        J = J[..., :rows, :]
        pull = (e[..., None, :] @ J)[..., 0, :]
        stuck = ((q <= lower) & (pull < 0.0)) | ((q >= upper) & (pull > 0.0))
        J = np.where(stuck[..., None, :], 0.0, J)  # a joint at its stop leaves the work to the others
        damping = 1e-2 * (e * e).sum(-1) + 1e-15  # vanishes with the error, so the end is quadratic like Newton's
        A = J @ J.swapaxes(-1, -2) + damping[:, None, None] * np.eye(rows)
        step = (J.swapaxes(-1, -2) @ np.linalg.solve(A, e[..., None]))[..., 0]
        step *= np.minimum(1.0, STEP_MAX / np.maximum(np.abs(step).max(-1, keepdims=True), STEP_MAX))
        q = np.clip(q + step, lower, upper)
    return q, error
