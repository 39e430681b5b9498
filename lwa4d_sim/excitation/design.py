"""Motions that tell the most: finite Fourier series, D-optimal within the limits of the arm.

Of all series that keep the limits, the one is sought whose information about the base parameters has the largest
determinant, so that the joint confidence region has the smallest volume (Swevers et al. 1997, "Optimal robot excitation
and identification", there with the same series).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lwa4d_sim.chain import SerialKinematics
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.excitation.clearance import Clearance
from lwa4d_sim.excitation.information import Information
from lwa4d_sim.excitation.limits import Limits, Room, limits_of, predicted_torque, room
from lwa4d_sim.excitation.search import Search
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of
from lwa4d_sim.trajectories import FourierMotion

DECIMALS = 4  # of the coefficients found; limits are checked with the rounded ones
CHECK = 0.001  # [s] between the samples at which limits are checked
SAMPLES = 8  # control periods in a period of the highest harmonic, at least (assumed; two are the theoretical least)
BLIND = 1e7  # condition number of a motion from which some parameter cannot be told (assumed; rounding gives 1e8)
ATTEMPTS = 3  # searches, each with tighter limits, until the limits hold between its samples too (measured: one does)


_RANGES: tuple[tuple[str, float, float], ...] = (  # assumed: what a slip of the pen oversteps
    ("harmonics", 1, 20),
    ("period", 0.1, 1000.0),
    ("periods", 1, 1000),
    ("lead_in", 0.1, 1000.0),
    ("lead_out", 0.1, 1000.0),
    ("control_period", 1e-5, 1.0),
    ("position_margin", 0.0, 1.0),
    ("speed_share", 0.01, 1.0),
    ("torque_share", 0.01, 1.0),
    ("clearance", 0.0, 1.0),
    ("seed", 0, 2**63 - 1),
    ("iterations", 1, 10_000),
)


@dataclass(frozen=True, kw_only=True)
class ExcitationWish:
    """What the motion shall be like.

    Attributes:
        harmonics: of the series.
        period: of the series [s]; omega = 2 pi / period.
        periods: how often it is repeated.
        lead_in: time from rest at the start to the series [s].
        lead_out: time to come to rest after it [s].
        control_period: time between two samples, that of the bus [s].
        position_margin: kept from each end stop [rad].
        speed_share: of the speed limits that may be used.
        torque_share: of the torque limits that may be used, by the nominal model's prediction.
        clearance: least distance between links that are no neighbours, and to what stands around the arm [m].
        seed: of the random motions that the search starts from; another seed finds another motion.
        iterations: of the search.
    """

    harmonics: int = 5
    period: float = 10.0
    periods: int = 2
    lead_in: float = 5.0
    lead_out: float = 2.0
    control_period: float = 0.01
    position_margin: float = 0.05
    speed_share: float = 0.95
    torque_share: float = 0.8
    clearance: float = 0.02
    seed: int = 0
    iterations: int = 300

    def __post_init__(self) -> None:
        """Refuse what makes no motion.

        Raises:
            IdentificationError: says which value must be what.
        """
        for name, low, high in _RANGES:
            value = getattr(self, name)
            if not low <= value <= high:
                raise IdentificationError(f"{name} (={value:g}): must be from {low:g} to {high:g}")
        least = SAMPLES * self.harmonics * self.control_period
        if self.period < least:
            raise IdentificationError(
                f"period (={self.period:g} s): must be at least {least:g} s for {self.harmonics} harmonics that are "
                f"sampled every {self.control_period:g} s"
            )


@dataclass(frozen=True, kw_only=True)
class Merit:
    """How good one motion is.

    Attributes:
        log_det: natural logarithm of the determinant of the information, see `Information`.
        condition: condition number of the base columns, each scaled to length 1.
        room: how near the motion comes to each limit.
    """

    log_det: float
    condition: float
    room: tuple[Room, ...]


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """A motion found.

    Attributes:
        motion: with rounded coefficients.
        start: posture it starts from and at which it is at rest (n,) [rad].
        parameters: number of base parameters that it excites.
        before: merit of the random motion that the search started from.
        after: merit of the motion found.
        remarks: what is not limited or not looked at, one sentence each.
    """

    motion: FourierMotion
    start: Array
    parameters: int
    before: Merit
    after: Merit
    remarks: tuple[str, ...]

    @property
    def gain(self) -> float:
        """Factor by which standard errors shrink from before to after, in the geometric mean over the parameters."""
        return float(np.exp((self.after.log_det - self.before.log_det) / (2 * self.parameters)))


def optimise(
    model: Any, start: Array, speed: Array, wish: ExcitationWish, progress: Callable[[], None] = lambda: None
) -> Excitation:
    """The best motion found from one random start.

    Args:
        model: compiled nominal arm.
        start: safe posture that the motion starts from (n,) [rad].
        speed: largest joint speeds (n,) [rad/s].
        wish: what the motion shall be like.
        progress: called after each iteration.

    Raises:
        IdentificationError: the start does not keep the limits, or no motion was found that does.
    """
    limits = limits_of(
        model,
        speed,
        position_margin=wish.position_margin,
        speed_share=wish.speed_share,
        torque_share=wish.torque_share,
        clearance=wish.clearance,
    )
    design = _Design(model, np.asarray(start, float), limits, wish)
    return design.run(progress)


class _Design:
    """One design: the search on coarse samples, and what is checked and reported on fine ones."""

    def __init__(self, model: Any, start: Array, limits: Limits, wish: ExcitationWish) -> None:
        self._model, self._start, self._limits, self._wish = model, start, limits, wish
        self._omega = 2.0 * np.pi / wish.period
        self._clearance = Clearance(model)
        self._chain = chain_of(model)
        finite = np.isfinite(limits.torque)
        usual = np.median(limits.torque[finite]) if finite.any() else 1.0
        self._information = Information(model, np.where(finite, limits.torque, usual), limits.speed)
        self._check_start()

    def _check_start(self) -> None:
        still = np.zeros((1, len(self._start)))
        for one in self._rooms(self._start[None], still, still):
            if one.left < 0.0:
                raise IdentificationError(
                    f"the start {np.round(self._start, 4).tolist()} rad is not safe: {one.what} of {one.where} is "
                    f"{one.reached:.4g} where {one.limit:.4g} is the limit with its margin; choose another initial.q"
                )

    def _remarks(self, done: bool) -> tuple[str, ...]:
        limits = self._limits
        endless = [name for name, top in zip(limits.joints, limits.upper, strict=True) if not np.isfinite(top)]
        free = [name for name, most in zip(limits.joints, limits.torque, strict=True) if not np.isfinite(most)]
        remarks = [
            "" if done else "the search was cut off before its end; more iterations, or another seed, may find better",
            f"no end stops limit {', '.join(endless)}" if endless else "",
            f"no torque limits {', '.join(free)}" if free else "",
            "" if len(self._clearance.pairs) else "no two geoms of the model could meet; no distance is looked at",
            *(
                f"{pair} overlap in all postures, so their distance is not looked at"
                for pair in self._clearance.left_out
            ),
        ]
        return tuple(filter(None, remarks))

    def _rooms(self, q: Array, dq: Array, ddq: Array) -> list[Room]:
        return room(self._limits, self._clearance, predicted_torque(self._model, q, dq, ddq), q, dq)

    def run(self, progress: Callable[[], None]) -> Excitation:
        wish = self._wish
        search = Search(self._information, self._clearance, self._limits, self._start, wish, self._omega)
        x = first = search.random_start(np.random.default_rng(wish.seed))
        before = self._merit(self._motion(first))
        tightened, left = 0.0, wish.iterations
        for _ in range(ATTEMPTS):
            x, used, done = search.improve(x, left, tightened, progress)
            left = max(wish.iterations // 5, left - used)
            motion = self._motion(x)
            after = self._merit(motion)
            if after.condition > BLIND:
                raise IdentificationError(
                    f"harmonics (={wish.harmonics}): no motion found that tells all {len(self._information.base)} base "
                    f"parameters apart (condition number {after.condition:.2g}); give more"
                )
            broken = [-one.left / abs(one.limit or 1.0) for one in after.room if one.left < 0.0]
            if not broken:
                return Excitation(
                    motion=motion,
                    start=self._start,
                    parameters=len(self._information.base),
                    before=before,
                    after=after,
                    remarks=self._remarks(done),
                )
            tightened += 1.5 * max(broken) + 0.005
        worst = min(after.room, key=lambda one: one.left / abs(one.limit or 1.0))
        raise IdentificationError(
            f"no motion found that keeps all limits: {worst.what} of {worst.where} reaches {worst.reached:.4g} where "
            f"{worst.limit:.4g} is the limit; try another seed, a longer period, or fewer harmonics"
        )

    def _motion(self, x: Array) -> FourierMotion:
        """The motion with coefficients (n, 2 N + 1): offset, a, b; rounded."""
        N = self._wish.harmonics
        rounded = np.round(x, DECIMALS) + 0.0  # no negative zeros
        rows = [tuple(map(tuple, rounded[:, columns].tolist())) for columns in (slice(1, N + 1), slice(N + 1, None))]
        return FourierMotion(
            a=rows[0],
            b=rows[1],
            offset=tuple(rounded[:, 0].tolist()),
            omega=self._omega,
            duration=self._wish.periods * self._wish.period,
            lead_in=self._wish.lead_in,
            lead_out=self._wish.lead_out,
        )

    def _merit(self, motion: FourierMotion) -> Merit:
        wish = self._wish
        running = motion.build(SerialKinematics(self._chain), self._start)
        # one period is like the next
        parts = (0.0, wish.lead_in + wish.period), (wish.lead_in + motion.duration, running.duration)
        checked = running.joint(np.concatenate([np.arange(first, last, CHECK) for first, last in parts]))
        series = running.joint(wish.lead_in + np.arange(0.0, wish.period, wish.control_period))
        Y = self._information.columns(*series)
        return Merit(
            log_det=self._information.of(Y),
            condition=self._information.condition(Y),
            room=tuple(self._rooms(*checked)),
        )
