"""A recording fitted: estimate, what it is worth, the possible arm nearest to it, and what torque it predicts."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.consistent import consistent
from lwa4d_sim.identification.equations import Equations
from lwa4d_sim.identification.estimate import INTERVAL, Estimate, fit, recursive
from lwa4d_sim.identification.noise import Influence, influence
from lwa4d_sim.identification.problem import Problem
from lwa4d_sim.interfaces import Array
from lwa4d_sim.recordings.recording import Recording

FEWEST_SLIDING = 0.2  # assumed: share of a joint's rows below which those in which it turns or sticks are used as well
SURE = 1e3  # assumed: how much better than by all data together a known unknown of a link is known
PASSES = 2  # of the fit: the first says how slowly a joint may slide
GAIN_PASSES, SETTLED = 20, 1e-6  # likewise where drive gains are fitted, which are not linear (three are usual)


@dataclass(frozen=True)
class Fit:
    """One recording fitted.

    Attributes:
        equations: of the recording.
        used: rows (W, n) that were fitted.
        estimate: of the parameters.
        torque_noise: standard deviation of each torque sample (n,) [N m], as the residuals have it.
        influence: of the samples' noise on the estimate.
        covariance: of the estimate (r, r).
    """

    equations: Equations
    used: NDArray[np.bool_]
    estimate: Estimate
    torque_noise: Array
    influence: Influence
    covariance: Array

    @property
    def std_error(self) -> Array:
        """Standard errors (r,), NaN where the data do not tell."""
        return np.where(self.estimate.lost, np.nan, np.sqrt(np.diag(self.covariance)))


def fit_recording(problem: Problem, recording: Recording, like: "Fit | None" = None) -> Fit:
    """Estimate the parameters from a recording.

    Args:
        problem: what is asked.
        recording: the data.
        like: a fit of the same motion, from which the influence of noise and the size of friction are taken.

    Raises:
        IdentificationError: the recording is too short or tells nothing at all.
    """
    coulomb = problem.coulomb(problem.nominal if like is None else problem.all_unknowns(like.estimate.nearest))
    prior = problem.value(problem.nominal)
    gains = "gain" in problem.unknowns.kinds
    x = problem.nominal if like is None else problem.all_unknowns(like.estimate.nearest)
    for _ in range((GAIN_PASSES if gains else PASSES) if like is None else 1):
        made = problem.equations(recording, coulomb)
        if gains:
            made = without_noise(problem, made, x)
        used = _used(problem, made)
        Y, b = problem.columns(made) * used[..., None], problem.torque(made) * used
        noise = None if problem.options.method != "total" else regressor_noise(problem, recording, made, used, coulomb)
        estimate = fit(Y, b, prior, problem.usual, problem.options.method, noise)
        before, x = x, problem.all_unknowns(estimate.nearest)
        coulomb = problem.coulomb(x)
        if gains and np.abs(x - before)[problem.unknowns.columns("gain")].max() < SETTLED:
            break
    if gains:
        _check_gains(problem, made, used)
    if estimate.lost.all():
        raise IdentificationError(f"{recording.source}: the joints do not move enough to tell any parameter")
    spread = influence(made, used, x, estimate.gain) if like is None else like.influence
    torque_noise = spread.torque_noise(estimate.residual, made.noise, int((~estimate.lost).sum()))
    torque_noise = np.maximum(torque_noise, recording.torque_step / np.sqrt(12.0))
    return Fit(made, used, estimate, torque_noise, spread, spread.covariance(made.noise, torque_noise))


def refitted(problem: Problem, recording: Recording, like: Fit) -> Array:
    """Parameters (r,) from a recording that was changed a little after ``like`` was made of it."""
    x = problem.all_unknowns(like.estimate.nearest)
    made = problem.equations(recording, problem.coulomb(x))
    if "gain" in problem.unknowns.kinds:
        made = without_noise(problem, made, x)
    used = _used(problem, made)
    Y, b = problem.columns(made) * used[..., None], problem.torque(made) * used
    return fit(Y, b, problem.value(problem.nominal), problem.usual).x


def without_noise(problem: Problem, made: Equations, x: Array) -> Equations:
    """The equations with gains' columns from the torque that ``x`` (P,) predicts.

    A column made of the measured torque is as noisy as that: least squares would take it for the cause of everything.
    """
    u, joints = problem.unknowns, np.arange(problem.unknowns.n)
    columns, Y = problem.unknowns.columns("gain"), made.Y.copy()
    Y[:, joints, columns] = 0.0
    Y[:, joints, columns] = -(Y @ x) / (1.0 + np.maximum(x[u.columns("gain")], -0.9))
    return replace(made, Y=Y)


def _used(problem: Problem, made: Equations) -> NDArray[np.bool_]:
    """Rows to be fitted: where Coulomb friction is a constant, unless that leaves next to nothing."""
    names = problem.unknowns.names
    with_friction = np.array(
        [names[k] not in problem.fixed or problem.fixed[names[k]] > 0 for k in problem.unknowns.columns("coulomb")]
    )
    used = made.sliding | ~with_friction
    return np.asarray(used | (used.mean(axis=0) < FEWEST_SLIDING))


def _check_gains(problem: Problem, made: Equations, used: NDArray[np.bool_]) -> None:
    """Refuse gains that the known unknowns do not fix: with all gains and parameters zero every torque is explained.

    Noise hides that, so torques are looked at that have none: those of the nominal arm on the same motion.
    """
    given = np.array([problem.fixed.get(name, 0.0) for name in problem.unknowns.names])
    everything = np.where([name in problem.fixed for name in problem.unknowns.names], given, problem.nominal)
    exact = problem.columns(without_noise(problem, made, everything)) * used[..., None]
    prior = problem.value(problem.nominal)
    lost = fit(exact, exact @ prior, prior, problem.usual).lost
    names = zip(problem.parameters.names, lost, strict=True)
    unknown = [name for name, gone in names if gone and name.endswith(".gain")]
    if unknown:
        example = unknown[0].replace("gain", "viscous")
        raise IdentificationError(
            f"cannot tell {', '.join(unknown)} from the size of everything else; give what is known of a part that "
            f"those joints move, such as identify.known={{{example}: 4.0}}",
            "identify.joints",
        )


def regressor_noise(
    problem: Problem, recording: Recording, made: Equations, used: NDArray[np.bool_], coulomb: Array, draws: int = 8
) -> Array:
    """Mean of E^T E (r + 1, r + 1) of the errors E that noise of the samples makes in the weighted [Y b]."""
    rng = np.random.default_rng(0)
    prior = problem.value(problem.nominal)
    Y, b = problem.columns(made) * used[..., None], problem.torque(made) * used
    first = fit(Y, b, prior, problem.usual)
    root = np.sqrt(first.weights)[:, None]
    total = np.zeros((len(problem.parameters.names) + 1,) * 2)
    step = np.maximum(made.noise, 1e-12)
    for _ in range(draws):
        moved = replace(recording, q=recording.q + step * rng.normal(size=recording.q.shape))
        there = problem.equations(moved, coulomb)
        if "gain" in problem.unknowns.kinds:  # their columns are predictions, and have no noise of the samples
            there.Y[..., problem.unknowns.columns("gain")] = made.Y[..., problem.unknowns.columns("gain")]
        E = np.concatenate([problem.columns(there) - problem.columns(made), (there.b - made.b)[..., None]], axis=-1)
        E = (E * root * used[..., None]).reshape(-1, len(total))
        total += E.T @ E / draws
    return total


def possible(problem: Problem, found: Fit) -> Array:
    """Unknowns (P,) of the physically possible arm that fits best; what the data do not tell is nominal."""
    u, made = problem.unknowns, found.equations
    inertial = np.arange(len(u.names)) < 10 * u.n
    fixed = np.array([name in problem.fixed for name in u.names])
    given = np.array([problem.fixed.get(name, 0.0) for name in u.names])
    free = inertial | ~fixed
    prior = np.where(free, problem.nominal, given)
    root = np.sqrt(found.estimate.weights) * found.used
    rows = np.concatenate([made.Y * free, (made.b - made.Y @ np.where(free, 0.0, given))[..., None]], axis=-1)
    rows = (rows * root[..., None]).reshape(-1, len(free) + 1)
    # what is known of the links is measured, too, and much better than all else: the nominal arm need not agree with it
    known = np.flatnonzero(inertial & fixed)
    sure = SURE * max(float(np.linalg.norm(rows[:, :-1], axis=0).max()), 1.0)
    pins = sure * np.concatenate([np.eye(len(free))[known], given[known, None]], axis=1)
    R = np.asarray(np.linalg.qr(np.concatenate([rows, pins]), mode="r"))
    signed = np.concatenate([np.full(u.n, kind in ("offset", "gain")) for kind in u.kinds])
    joint = slice(10 * u.n, None)
    lower = np.where(free[joint], np.where(signed, -np.inf, 0.0), prior[joint])
    upper = np.where(free[joint], np.inf, prior[joint])
    return consistent(R[:, :-1], R[:, -1], prior, n_links=u.n, spread=problem.usual_joints, lower=lower, upper=upper)


def nrmse(problem: Problem, made: Equations, torque: Array) -> Array:
    """Root mean square of the torque that ``torque`` (W, n) does not predict, over the torque's own deviation, (n,)."""
    scale = made.b.std(axis=0)
    scale = np.where(scale > 0, scale, np.inf)
    return np.asarray(np.sqrt(((made.b - torque) ** 2).mean(axis=0)) / scale)


def predicted(problem: Problem, made: Equations, x: Array) -> Array:
    """Torque (W, n) of parameters ``x`` (r,) and the fixed unknowns."""
    return np.asarray(problem.columns(made) @ x + made.b - problem.torque(made))


def convergence(problem: Problem, found: Fit) -> tuple[Array, Array]:
    """Instants (W,) [s] and the recursive estimate (W, r) at each, as in the thesis's Figure 5.2c."""
    estimate, prior = found.estimate, problem.value(problem.nominal)
    Y = problem.columns(found.equations) * found.used[..., None]
    b = problem.torque(found.equations) * found.used - Y @ prior
    values = prior + np.array(list(recursive(Y, b, estimate.weights)))
    values[:, estimate.lost] = np.nan
    return found.equations.t, values


def covers(estimate: Array, std_error: Array, truth: Array) -> NDArray[np.bool_]:
    """Whether the 95 % intervals hold the truth."""
    return np.asarray(np.abs(estimate - truth) <= INTERVAL * std_error)
