"""What a scenario can ask of a motion: waypoints, a Fourier series, or samples in a file.

Each class holds the parameters of one kind of motion and builds the running trajectory from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import MinLen

from lwa4d_sim.errors import KinematicsError, TrajectoryError
from lwa4d_sim.fourier import fourier_series, led
from lwa4d_sim.interfaces import STRICT, Array, NonNegative, Positive
from lwa4d_sim.motion_files import read_samples
from lwa4d_sim.motions import POSE_JOINTS, JointMotion, Kinematics, RedundantKinematics, TaskMotion, Turn
from lwa4d_sim.polynomials import PiecewisePolynomial, boundary_polynomial
from lwa4d_sim.rotations import from_rpy

Row = Annotated[tuple[float, ...], MinLen(1)]
Rows = Annotated[tuple[Row, ...], MinLen(1)]

ORDERS = {"linear": 1, "cubic": 2, "quintic": 3, "septic": 4}  # derivatives, position included, met at both ends


@dataclass(frozen=True, kw_only=True)
class Waypoints:
    """Where to go, one waypoint after the other.

    Attributes:
        space: what a point is: ``task`` for tool points, ``joint`` for joint angles.
        points: x, y, z in the base frame [m], or one angle per joint [rad].
        orientations: roll, pitch, yaw of the tool frame about the fixed axes of the base [rad], one triple for each
            task point or one triple for all; needed by (and only by) an arm that can choose its orientation.
        arm_angle: angle of the elbow about the line from shoulder to wrist at every task point, 7-DOF only [rad].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    space: Literal["task", "joint"]
    points: Rows
    orientations: Row | Rows | None = None
    arm_angle: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Boundary:
    """Derivatives at every knot (the start and each waypoint) in the space the profile runs in.

    The more are given, the higher the degree: velocity gives cubics, acceleration too gives quintics, jerk too septics.

    Attributes:
        velocity: [m/s] or [rad/s], one row per knot.
        acceleration: [m/s^2] or [rad/s^2], one row per knot.
        jerk: [m/s^3] or [rad/s^3], one row per knot.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    velocity: Rows
    acceleration: Rows | None = None
    jerk: Rows | None = None


@dataclass(frozen=True, kw_only=True)
class WaypointMotion:
    """From the start at rest through waypoints, segment by segment.

    Attributes:
        waypoints: where to go.
        segment_time: time of each segment, or one time for all [s].
        profile: ``step`` jumps to a waypoint at the start of its segment; ``linear`` goes there at constant speed; the
            polynomials go from rest to rest: ``cubic`` with zero velocity, ``quintic`` with zero acceleration as well,
            ``septic`` with zero jerk as well.
        follow: the space in which the profile runs, so ``task`` makes the tool go straight.
        elbow: branch of the inverse kinematics for task points.
        boundary: derivatives at the knots instead of rest; they then fix the degree of the polynomials. (The tool's
            orientation still goes from rest to rest, with the same degree.)
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["waypoints"] = "waypoints"
    waypoints: Waypoints
    segment_time: Positive | tuple[Positive, ...]
    profile: Literal["step", "linear", "cubic", "quintic", "septic"] = "quintic"
    follow: Literal["joint", "task"] = "joint"
    elbow: Literal["up", "down"] = "up"
    boundary: Boundary | None = None

    def build(self, kinematics: Kinematics, q0: Array, base: Path | None = None) -> JointMotion | TaskMotion:
        """The running trajectory.

        Args:
            kinematics: the arm.
            q0: joint angles at the start (n,) [rad].
            base: not used; other kinds of motion read files relative to it.

        Raises:
            TrajectoryError: numbers of rows, columns or segments do not fit the arm or each other.
            KinematicsError: (as one of its subclasses) a task waypoint cannot be reached; the message says which.
        """
        joints = len(q0)
        x, R = self._targets(joints)
        q = self._postures(kinematics, q0, x, R)
        if self.follow == "joint":
            law = self._law(q, leads=True)
            return JointMotion(kinematics, law.knots, law)
        pose = kinematics.fk(q)
        x = pose.x if x is None else np.concatenate([pose.x[:1], x])
        progress = self._law(np.arange(len(q), dtype=float)[:, None])
        turn = arm_angle = None
        if joints >= POSE_JOINTS:
            turn = Turn.through(pose.R if R is None else np.concatenate([pose.R[:1], R]), progress)
        if isinstance(kinematics, RedundantKinematics):
            arm_angle = self._law(np.unwrap(kinematics.arm_angle_of(q))[:, None])
        return TaskMotion(kinematics, self._law(x, leads=True), turn, self._law(q), arm_angle, self.elbow)

    def _targets(self, joints: int) -> tuple[Array | None, Array | None]:
        """Tool points (S, 3) and orientations (S, 3, 3) of the waypoints, where they are given as such."""
        w = self.waypoints
        if w.space == "joint":
            if w.orientations is not None or w.arm_angle != 0.0:
                raise TrajectoryError("waypoints.orientations and arm_angle belong to task points; space is 'joint'")
            return None, None
        x = _rows("waypoints.points", w.points, 3, "x, y, z")
        if joints < POSE_JOINTS:
            if w.orientations is not None or w.arm_angle != 0.0:
                raise TrajectoryError(
                    f"waypoints.orientations and arm_angle need an arm with at least {POSE_JOINTS} joints; this one "
                    f"has {joints}, which can only place its tool point"
                )
            return x, None
        if w.orientations is None:
            raise TrajectoryError(
                f"waypoints.orientations is missing: an arm with {joints} joints needs roll, pitch, yaw [rad] for its "
                "task points, one triple for each or one for all"
            )
        one_for_all = np.ndim(w.orientations[0]) == 0
        triples = (w.orientations,) if one_for_all else w.orientations
        rpy = _rows("waypoints.orientations", triples, 3, "roll, pitch, yaw")
        if len(rpy) not in (1, len(x)):
            raise TrajectoryError(
                f"waypoints.orientations has {len(rpy)} rows; valid: 1, or {len(x)} as many as points"
            )
        return x, from_rpy(np.broadcast_to(rpy, x.shape))

    def _postures(self, kinematics: Kinematics, q0: Array, x: Array | None, R: Array | None) -> Array:
        """Joint angles at the start and at each waypoint, (S + 1, n), each task point solved near the one before."""
        q = [np.asarray(q0, dtype=float)]
        if x is None:
            return np.concatenate([q, _rows("waypoints.points", self.waypoints.points, len(q0), "one angle per joint")])
        for i, point in enumerate(x):
            options: dict[str, Any] = {"elbow": self.elbow, "arm_angle": self.waypoints.arm_angle, "near": q[-1]}
            try:
                q.append(kinematics.ik(point, None if R is None else R[i], **options))
            except KinematicsError as error:
                where = ", ".join(f"{c:g}" for c in point)
                raise type(error)(f"waypoint {i + 1} ({where}): {error}") from error
        return np.array(q)

    def _law(self, knots: Array, *, leads: bool = False) -> PiecewisePolynomial:
        """The profile through the values (S + 1, m) at the knots; boundary derivatives hold for the one that leads."""
        segments = len(knots) - 1
        T = np.atleast_1d(np.asarray(self.segment_time, dtype=float))
        if len(T) not in (1, segments):
            raise TrajectoryError(
                f"segment_time has {len(T)} entries; valid: one for all, or one for each of the {segments} segments"
            )
        T = np.broadcast_to(T, segments)
        rates = self._boundary_rates()
        if self.profile == "step":
            return PiecewisePolynomial(T, knots[None, 1:])
        values = np.zeros((1 + len(rates) if rates else ORDERS[self.profile], *knots.shape))
        values[0] = knots
        for k, (name, rows) in enumerate(rates if leads else (), start=1):
            values[k] = _rows(f"boundary.{name}", rows, knots.shape[1], f"{self.follow} space", len(knots))
        return PiecewisePolynomial(T, boundary_polynomial(T[:, None], values[:, :-1], values[:, 1:]))

    def _boundary_rates(self) -> list[tuple[str, Rows]]:
        """The given boundary derivatives in order, with their names."""
        b = self.boundary
        if b is None:
            return []
        if self.profile in ("step", "linear"):
            raise TrajectoryError(
                f"boundary derivatives need a polynomial profile (cubic, quintic or septic), not {self.profile!r}"
            )
        if b.jerk is not None and b.acceleration is None:
            raise TrajectoryError("boundary.jerk needs boundary.acceleration as well")
        rows = {"velocity": b.velocity, "acceleration": b.acceleration, "jerk": b.jerk}
        return [(name, values) for name, values in rows.items() if values is not None]


@dataclass(frozen=True, kw_only=True)
class FourierMotion:
    """Sum of sines that excites the arm for identification (thesis, eq. 5.4).

    theta_i(t) = offset_i + sum over k = 1..N of a_ik / (k omega) sin(k omega t) - b_ik / (k omega) cos(k omega t)

    Without leads it starts neither at the arm's start posture nor at rest, and afterwards rests where it ended.

    Attributes:
        a: joint speed amplitudes of the sines' derivatives, one row of N per joint [rad/s].
        b: joint speed amplitudes of the cosines' derivatives, one row of N per joint [rad/s].
        offset: theta_i0, one per joint [rad]; zero when absent.
        omega: base frequency [rad/s]. The thesis's "omega = 1 [Hz]" can be read as 1 rad/s or as 2 pi rad/s.
        duration: length of the series [s]; the motion lasts lead_in + duration + lead_out.
        lead_in: time of a quintic before it, from rest at the arm's start [s].
        lead_out: time in which the arm brakes after it [s]; it comes to rest near the series' end.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["fourier"] = "fourier"
    a: Rows
    b: Rows
    offset: Row | None = None
    omega: Positive = 1.0
    duration: Positive
    lead_in: NonNegative = 0.0
    lead_out: NonNegative = 0.0

    def build(self, kinematics: Kinematics, q0: Array, base: Path | None = None) -> JointMotion:
        """The running trajectory; arguments as `WaypointMotion.build`.

        Raises:
            TrajectoryError: numbers of rows or columns do not fit the arm or each other.
        """
        joints, N = len(q0), len(self.a[0])
        a = _rows("a", self.a, N, "as many as the first row", joints)
        b = _rows("b", self.b, N, "as many as a", joints)
        offset = _rows("offset", [self.offset or np.zeros(joints)], joints, "one angle per joint")
        series = fourier_series(a, b, offset[0], self.omega)
        knots, curve = led(series, np.asarray(q0, dtype=float), self.lead_in, self.duration, self.lead_out)
        return JointMotion(kinematics, knots, curve)


THESIS_EXCITATION = FourierMotion(  # joints 2 and 4 of the planar arm; thesis, section 5.1.3
    a=((0.156, -0.478, 0.078, -0.388, -0.070), (0.064, -0.335, 0.451, 0.292, 1.046)),
    b=((0.088, 0.253, -0.207, 0.549, 0.150), (-0.125, 0.292, -0.369, 0.557, 0.964)),
    duration=20.0,  # assumed, three periods: the thesis does not say
)


@dataclass(frozen=True, kw_only=True)
class SampledMotion:
    """Joint motion from a file of samples, joined by cubic splines; its time counts from the first sample.

    Joint speeds in the file are met exactly (piecewise cubics), accelerations too (piecewise quintics).

    Attributes:
        file: CSV with header ``t,q1,...,qn``, optionally followed by ``dq1,...,dqn`` and then ``ddq1,...,ddqn``; or
            .npy with the same columns; or .npz with arrays ``t``, ``q``, optionally ``dq`` and ``ddq``. Units s, rad. A
            relative path starts at the scenario's folder.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["sampled"] = "sampled"
    file: str

    def build(self, kinematics: Kinematics, q0: Array, base: Path | None = None) -> JointMotion:
        """The running trajectory; arguments as `WaypointMotion.build`.

        Raises:
            TrajectoryError: the file is missing or a line of it is not valid; the message says which.
        """
        t, values = read_samples((base or Path()) / self.file, len(q0))
        if len(values) == 1:
            from scipy.interpolate import CubicSpline  # costs 0.2 s

            values = np.stack([values[0], CubicSpline(t, values[0])(t, 1)])
        T = np.diff(t)
        curve = PiecewisePolynomial(T, boundary_polynomial(T[:, None], values[:, :-1], values[:, 1:]))
        return JointMotion(kinematics, curve.knots[-1:], curve)


def _rows(name: str, rows: Sequence[Any], width: int, meaning: str, count: int | None = None) -> Array:
    """The rows as an array (count, width), or an error that names the row that does not fit."""
    if count is not None and len(rows) != count:
        raise TrajectoryError(f"{name} has {len(rows)} rows; it must have {count}")
    for i, row in enumerate(rows):
        if np.shape(row) != (width,):
            raise TrajectoryError(f"{name}, row {i + 1} (={row}): must hold {width} numbers ({meaning})")
    return np.array(rows, dtype=float)
