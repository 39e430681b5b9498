"""What linear regression cannot see, such as a delay or the shape of friction: fitted to the motion by mujoco.sysid.

The model runs freely under the recorded torques, piece by piece, and its parameters are turned until it stays with the
recorded positions. Where each piece starts is not known exactly, and to first order it is fitted too.

A regression that does not know of a delay hides most of it in the inertia, of which it finds a little too much or too
little. So inertia can go along as well: then the whole delay is found, and not what the regression left of it.
"""

import io
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.adjustable import REACH, What, adjustable
from lwa4d_sim.identification.shooting import cut
from lwa4d_sim.identification.slack import Inertia, Slack
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import load_model
from lwa4d_sim.mjcf_checks import name_of
from lwa4d_sim.recordings.recording import Recording

STEP = 0.001  # [s] of the model's own run, in RK4 (as the plant's default); a coarser file would show as a delay
MOST = 16  # pieces; those of a longer recording are thinned out, for seven joints take minutes (measured)
_ROUNDS, _ITERATIONS = 5, 4  # of what goes along, and of the parameters in each (measured: three and two are usual)
_STEP = 1e-6  # of finite differences, in SI units: half-way between rounding and curvature (derived: sqrt of 1e-12)
_START = (1e-4, 0.02)  # [rad], [rad/s]; how far the spline's guess of a start usually is off (assumed)
_SHARE = 1e-2  # of usual amounts, by which differences are taken: 1e-6 rad and more
_USUAL = 0.01  # share of the torque that is usually wrong by wrong inertia (assumed)
_SETTLED = 0.2  # standard errors by which a parameter may still move (assumed)
_GRADIENT = 0.05 * _SETTLED  # likewise, of the fit itself (assumed; below it rounding hides what is gained)
_DAMP = 10.0  # factor on the fit's damping (Marquardt 1963)
_AWAY = 1e3  # [rad]; a model that ran away is as wrong as that
_DARK = 1e-10  # least eigenvalue of J^T J that is told from errors of differences, which are 1e-6 of J
_STILL = 1e-9  # [rad]; least size of errors that is worth fitting: about what RK4 errs in steps of 1 ms


@dataclass(frozen=True, kw_only=True)
class Refined:
    """Parameters (p,) of a model that follows a recording best.

    Attributes:
        names: such as delay, joint2.quadratic, link4.scale.
        units: likewise.
        start: values before.
        estimate: values after; NaN where the motion does not tell.
        std_error: the larger of two: for residuals that are independent, and for residuals that depend on each other
            within a piece; inf where the motion does not tell.
        before: rms of the position error (n,) [rad], with what goes along fitted.
        after: likewise.
        pieces: number of pieces.
        remarks: one sentence each.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    start: Array
    estimate: Array
    std_error: Array
    before: Array
    after: Array
    pieces: int
    remarks: tuple[str, ...]


def refine(
    model_path: Path,
    recording: Recording,
    *,
    what: Sequence[What] = ("delay", "friction", "offset", "inertia"),
    segment: float = 0.5,
    threads: int = 1,
    advance: Callable[[], None] = lambda: None,
) -> Refined:
    """Fit a model's parameters to a recorded motion.

    Args:
        model_path: MJCF of the arm as identified.
        recording: of the motion.
        what: delay = of all torques, beyond what the recording says; delays = one for each joint; friction = viscous
            + quadratic |dq| + cubic dq^2, times dq, and coulomb; offset = torque where none is recorded, with the sign
            of friction; mass = a factor on mass and inertia of each link, as a check; inertia = that of links and
            rotors, to first order, which is fitted along and not told. What is not named is taken as exact.
        segment: length of a piece [s].
        threads: that run the model.
        advance: called after each iteration; there are at most 25, usually half as many.

    Raises:
        IdentificationError: mujoco.sysid is not installed; the recording is too short, or of another arm; the model
            cannot follow it at all.
        ModelError: the model cannot be loaded.
    """
    with _sysid() as sysid:
        return _Fit(sysid, model_path, recording, what, segment, threads).run(advance)


@contextmanager
def _sysid() -> Iterator[Any]:
    """The library, while it and the engine are kept from writing anywhere."""
    import mujoco

    try:
        from mujoco import sysid

        sysid.optimize  # noqa: B018  # the package hides what it lacks until it is used
    except (ImportError, AttributeError) as error:
        raise IdentificationError(
            "fitting delay and friction needs mujoco.sysid; install it with: pip install 'lwa4d_sim[sysid]'"
        ) from error
    log, handler = logging.getLogger("absl"), logging.NullHandler()
    loud, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logto_console = quiet.logto_file = False
    quiet.set()
    log.disabled = True
    logging.root.addHandler(handler)  # finding no handler, absl would set up Python's logging for the whole process
    try:
        yield sysid
    finally:
        logging.root.removeHandler(handler)
        log.disabled = False
        loud.set()


class _Fit:
    """A model, a recording cut into pieces, and what is known so far."""

    def __init__(
        self, sysid: Any, path: Path, recording: Recording, what: Sequence[What], segment: float, threads: int
    ) -> None:
        import mujoco
        from mujoco.rollout import Rollout

        model = load_model(str(path), timestep=STEP, integrator="RK4")
        if model.njnt != recording.n:
            raise IdentificationError(f"{recording.source}: has {recording.n} joints, the arm has {model.njnt}")
        self._sysid, self._source = sysid, recording.source
        self._spec = mujoco.MjSpec.from_file(str(path))
        self._spec.option.timestep, self._spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
        self._spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._joints = [name_of(model, "JOINT", j) for j in range(model.njnt)]
        self._params, self._units = adjustable(sysid, self._spec, what)
        self._pieces = cut(recording, segment, float(model.opt.timestep), REACH, MOST)
        self._state = self._pieces.state
        self._model, self._free = model, "inertia" in what
        self._inertia: Inertia | None = None
        self._amount = _SHARE * np.repeat(_START, recording.n)
        self._usual = _SHARE * _USUAL * float(np.sqrt((self._pieces.torque(np.zeros(recording.n)) ** 2).mean()))
        self._less = np.zeros(11 * recording.n)
        self._extra = np.zeros((len(self._state), self._pieces.steps, recording.n))
        self._least = np.maximum(recording.position_step / np.sqrt(12.0), _STILL)
        self._rollout = Rollout(nthread=threads if threads > 1 else 0)
        self._data = [mujoco.MjData(model) for _ in range(max(threads, 1))]

    def run(self, advance: Callable[[], None]) -> Refined:
        """Linearise about what nobody asks for, fit, take over what was explained; until nothing moves."""
        x = start = self._params.as_vector()
        error = self._error(x)
        if np.abs(error).max() >= _AWAY:
            raise IdentificationError(f"{self._source}: the model runs away from this motion; give one that is nearer")
        self._slack = self._linearise(x, self._rms(error))
        before = self._rms(self._slack.left(error))
        for _ in range(_ROUNDS):
            last, (x, J) = x, self._optimise(advance)
            error = self._error(x)
            std_error = self._std_error(self._slack.left(error), J)
            after = self._rms(self._slack.left(error))
            settled = bool((np.abs(x - last) <= _SETTLED * std_error).all())
            if settled:
                break
            starts, inertia = self._slack.explained(error)
            self._state = self._state + starts * self._amount / _SHARE
            if self._inertia is not None:
                self._less = self._less + self._inertia.back @ inertia * self._usual / _SHARE
            self._slack = self._linearise(x, after)
        return Refined(
            names=tuple(self._params.keys()),
            units=self._units,
            start=start,
            estimate=np.where(np.isfinite(std_error), x, np.nan),
            std_error=std_error,
            before=before,
            after=after,
            pieces=len(self._state),
            remarks=tuple(self._remarks(x, std_error, settled)),
        )

    def _optimise(self, advance: Callable[[], None]) -> tuple[Array, Array]:
        """The parameters (p,) and the residual's derivative there (S m n, p)."""
        self._params, result = self._sysid.optimize(
            self._params,
            self._residual,
            verbose=False,
            output=io.StringIO(),  # what it prints says no more than its result
            max_iters=_ITERATIONS,
            eps=_STEP,
            x_scale="jac",
            xtol=1e-9,
            gtol=_GRADIENT,
            mu_factor=_DAMP,
            iter_callback=lambda _: advance(),
        )
        return np.asarray(result.x).ravel(), np.asarray(result.jac)

    def _residual(self, x: Array, _: Any) -> tuple[list[Array], None, None]:
        """Weighted residuals (S m n, F) of F columns of parameters (p, F), as the library wants them."""
        columns = [self._slack.left(self._error(column)) / self._slack.sigma for column in x.T]
        return [np.stack([column.ravel() for column in columns], axis=-1)], None, None

    def _path(self, x: Array, starts: Array | float = 0.0, torque: Array | float = 0.0) -> Array:
        """Position and speed at the steps (S, N + 1, 2 n), with a change of the starts and of the torques."""
        self._params.update_from_vector(x)
        model = self._sysid.apply_param_modifiers(self._params, self._spec)
        tau = self._pieces.torque(self._of_joints("delay")) - self._of_joints("offset") + self._extra + torque
        state = self._state + starts
        path, _ = self._rollout.rollout(model, self._data, np.insert(state, 0, 0.0, axis=1), tau)  # time comes first
        return np.concatenate([state[:, None], path[..., 1:]], axis=1)

    def _error(self, x: Array, starts: Array | float = 0.0, torque: Array | float = 0.0) -> Array:
        """Measured less predicted positions (S, m, n) [rad]; 0 where nothing is measured."""
        pieces = self._pieces
        error = np.where(pieces.there, pieces.q - pieces.sampled(self._path(x, starts, torque)), 0.0)
        return np.asarray(np.clip(np.nan_to_num(error, nan=_AWAY), -_AWAY, _AWAY))

    def _of_joints(self, kind: str) -> Array:
        """Values (n,) of a kind of parameter, one for all joints or one for each; 0 where it is not asked for."""
        names = [kind if kind in self._params else f"{joint}.{kind}" for joint in self._joints]
        return np.array([self._params[name].value[0] if name in self._params else 0.0 for name in names])

    def _linearise(self, x: Array, sigma: Array) -> Slack:
        """What nobody asks for, with residuals weighted by their size sigma (n,) [rad]."""
        others: Array = np.zeros((0, *self._extra.shape))
        if self._free:
            self._inertia = Inertia.along(self._model, self._path(x), self._pieces.step)
            self._extra = self._inertia.Y @ self._less
            others = np.moveaxis(self._inertia.base, -1, 0)
        here = self._error(x)
        starts = [here - self._error(x, self._amount * one) for one in np.eye(self._state.shape[1])]
        shared = [here - self._error(x, torque=self._usual * one) for one in others]
        shared_change = np.stack(shared, axis=-1) if shared else np.zeros((*here.shape, 0))
        return Slack.of(np.stack(starts, axis=-1) / _SHARE, shared_change / _SHARE, np.maximum(sigma, self._least))

    def _rms(self, error: Array) -> Array:
        """Of each joint (n,) [rad]."""
        there = self._pieces.there
        return np.asarray(np.sqrt((error**2 * there).sum(axis=(0, 1)) / np.maximum(there.sum(axis=(0, 1)), 1)))

    def _std_error(self, left: Array, J: Array) -> Array:
        """Standard errors (p,) from what is left of the errors (S, m, n) and its weighted derivative (S m n, p)."""
        from scipy.special import stdtrit

        there, sigma = self._pieces.there, self._slack.sigma
        pieces, p = len(left), J.shape[1]
        count, free = left.size - p, int(there.sum()) - self._slack.rank - p
        if free <= 0:
            raise IdentificationError(f"{free + p} samples beyond the starts are too few for {p} parameters")
        length = np.linalg.norm(J, axis=0)
        J = J / np.where(length > 0, length, 1.0)
        size = np.maximum(self._rms(left), self._least) / sigma  # what was rounded is not known better than that
        with np.errstate(divide="ignore", invalid="ignore"):  # of what the motion does not tell
            # the library takes no more from residuals than their sum of squares, and counts absent samples too
            _, width = self._sysid.calculate_intervals([(size * there).ravel()], J, lambda_zero_thresh=_DARK)
            independent = width / stdtrit(count, 0.975) * np.sqrt(count / free)
            # with g = J^T r of each piece: (J^T J)^-1 (sum of g g^T) (J^T J)^-1 (Liang, Zeger 1986)
            g = np.einsum("sa,sap->sp", (left / sigma).reshape(pieces, -1), J.reshape(pieces, -1, p))
            spread = np.linalg.norm(g @ np.linalg.pinv(J.T @ J, rcond=_DARK, hermitian=True), axis=0)
            dependent = spread * np.sqrt(pieces / max(pieces - p, 1))
            std_error = np.maximum(independent, dependent) / length
        low, high = self._params.get_bounds()
        return np.where(std_error < high - low, std_error, np.inf)  # a wider one tells nothing

    def _remarks(self, x: Array, std_error: Array, settled: bool) -> Iterator[str]:
        names = np.array(self._params.keys())
        lost = names[~np.isfinite(std_error)]
        if len(lost):
            yield f"the motion does not tell {', '.join(lost)}"
        low, high = self._params.get_bounds()
        for name in names[(x <= low) & (low != 0.0) | (x >= high)]:
            yield f"{name} is at its bound; the model is wrong in another way"
        if not settled:
            yield f"the fit had not come to rest after {_ROUNDS} rounds"
