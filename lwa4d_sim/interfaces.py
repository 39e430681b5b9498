"""The nouns of the project: signals that travel between blocks, and what a block must offer.

Arrays have a leading axis of N simulations stepped together; a single run is N = 1. Shapes are given as
``(N, n)`` with n joints. Units are SI on the link side; simulated time is integer nanoseconds.
"""

from typing import Annotated, Any, NamedTuple, NewType, Protocol

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]  # float64 throughout; numpy types many results this wide
IntArray = NDArray[np.int64]
Ns = NewType("Ns", int)  # simulated time [ns]

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]

NS_PER_S = 1_000_000_000

# How the scenario reader treats every parameter class: unknown keys, NaN and infinity are errors.
STRICT: Any = {"extra": "forbid", "allow_inf_nan": False}


def bare_key(name: str) -> str:
    """The key of a parameter class's field: a word that Python keeps for itself, such as `from`, ends in `_` there."""
    return name.rstrip("_")


# For classes that have such a field.
STRICT_BARE: Any = {**STRICT, "alias_generator": bare_key}


def to_ns(seconds: float) -> Ns:
    """Seconds to the nearest nanosecond, the only place where time is rounded."""
    return Ns(round(seconds * NS_PER_S))


class Pose(NamedTuple):
    """Where the tool is: ``x`` (..., 3) [m] and ``R`` (..., 3, 3), tool axes as columns, both in the base frame."""

    x: Array
    R: Array


class JointState(NamedTuple):
    """What the controller believes about the joints now: ``q`` [rad] and ``dq`` [rad/s], both (N, n)."""

    q: Array
    dq: Array


class JointReference(NamedTuple):
    """Desired joint motion: ``q`` [rad], ``dq`` [rad/s], ``ddq`` [rad/s^2], each (..., n)."""

    q: Array
    dq: Array
    ddq: Array


class TaskReference(NamedTuple):
    """Desired tool motion in the base frame.

    Attributes:
        x, dx, ddx: tool point [m, m/s, m/s^2], each (..., 3).
        R: tool orientation (..., 3, 3), or None when only the point is asked.
        w, dw: angular velocity and acceleration [rad/s, rad/s^2], (..., 3), or None with ``R``.
        posture: joint angles [rad], (..., n), that a redundant arm keeps in the null space, or None.
    """

    x: Array
    dx: Array
    ddx: Array
    R: Array | None = None
    w: Array | None = None
    dw: Array | None = None
    posture: Array | None = None


class Measurement(NamedTuple):
    """What the drives latched: ``q`` (N, n) [rad] and, when a drive estimates it, ``dq`` (N, n) [rad/s].

    ``stamp`` [ns], (N, n), (N, 1) or (1, 1), is the instant each joint was sampled; joints may differ in age. A joint
    that has never been heard of has stamp -1.
    """

    stamp: IntArray
    q: Array
    dq: Array | None


class Arrived(NamedTuple):
    """The newest data at an instant, joint by joint.

    Attributes:
        stamp: when each joint's datum was made [ns], (N, n), or (N, 1) or (1, 1) where joints or all are alike; -1
            where none has arrived.
        since: when it arrived [ns], shaped likewise.
        values: the data, each (N, n).
    """

    stamp: IntArray
    since: IntArray
    values: tuple[Array, ...]


class Trajectory(Protocol):
    """A desired motion of one simulation, defined for every time (it rests after ``duration``)."""

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        ...

    @property
    def knots(self) -> Array:
        """End time of each segment [s], (segments,)."""
        ...

    def joint(self, t: Array) -> JointReference:
        """Joint motion at the times ``t`` (K,) [s]; each field (K, n)."""
        ...

    def task(self, t: Array) -> TaskReference:
        """Tool motion at the times ``t`` (K,) [s]; each field has leading axis K."""
        ...

    def tool_point(self, t: Array) -> Array:
        """Tool point alone (K, 3) [m] at the times ``t`` (K,) [s]; the cheap part of `task`."""
        ...


class RigidBodyTerms(Protocol):
    """Terms of M ddq + h = tau at one joint state, for N arms."""

    @property
    def M(self) -> Array:
        """Inertia matrix (N, n, n) [kg m^2]."""
        ...

    @property
    def h(self) -> Array:
        """Coriolis, centrifugal and gravity torque (N, n) [N m]; at dq = 0 it is the gravity torque."""
        ...

    @property
    def pose(self) -> Pose:
        """Tool pose, (N, 3) and (N, 3, 3)."""
        ...

    @property
    def J(self) -> Array:
        """Tool Jacobian (N, 6, n), linear rows first."""
        ...

    def dJ_dq(self, dq: Array) -> Array:
        """Bias acceleration dJ dq of the tool (N, 6) at joint speed ``dq`` (N, n)."""
        ...


class ArmModel(Protocol):
    """What a controller believes about the arm."""

    def at(self, q: Array, dq: Array | None = None) -> RigidBodyTerms:
        """Terms at ``q`` and ``dq`` (N, n); without ``dq`` at rest. Valid until the next call."""
        ...

    def friction(self, dq: Array) -> Array:
        """Friction torque (N, n) [N m] at joint speed ``dq`` (N, n), with the sign of the speed."""
        ...


class Controller(Protocol):
    """A control law. ``ref`` is a JointReference or a TaskReference, as the controller's ``space`` says."""

    def torque(self, state: JointState, ref: Any, model: ArmModel) -> Array:
        """Joint torque (N, n) [N m] before saturation."""
        ...


class Estimator(Protocol):
    """Turns the newest measurement into the state the controller uses."""

    def update(self, meas: Measurement, now: Ns) -> JointState:
        """Called once per controller tick, at ``now``."""
        ...


class Channel(Protocol):
    """One direction of the link."""

    def send(self, stamp: Ns, values: tuple[Array, ...]) -> None:
        """Put in data made at ``stamp``, arrays (N, n)."""
        ...

    def newest(self, now: Ns) -> Arrived | None:
        """The newest data that has arrived by ``now``; None before the first."""
        ...

    def changes(self, after: Ns, before: Ns) -> list[Ns]:
        """Instants strictly between ``after`` and ``before`` at which something arrives, in order."""
        ...
