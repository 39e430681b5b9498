"""What a motion must not exceed, and how much room it leaves: positions, speeds, torques, distances."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.arm import ARMS
from lwa4d_sim.dynamics import NominalModel
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.excitation.clearance import Clearance
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of, joint_facts, torque_limits

LOOKED_FOR = 0.3  # [m] beyond the clearance (assumed); what stays further away is only said to do so
CHUNK = 200  # states evaluated together; each takes an MjData of its own (about 0.1 MB for seven joints)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bounds on a motion of n joints, margins already taken off.

    Attributes:
        joints: names.
        slide: True where a joint slides, so that its units are m, m/s and N, (n,).
        lower, upper: positions (n,) [rad], infinite where there is no end stop.
        speed: largest speeds (n,) [rad/s].
        torque: largest torques (n,) [N m], infinite where the model has no limit.
        clearance: least distance between links that are no neighbours, and to what stands around the arm [m].
    """

    joints: tuple[str, ...]
    slide: NDArray[np.bool_]
    lower: Array
    upper: Array
    speed: Array
    torque: Array
    clearance: float


@dataclass(frozen=True)
class Room:
    """How near a motion comes to one limit.

    Attributes:
        what: position, speed, torque or distance.
        where: the joint, or the two bodies.
        unit: of the numbers.
        limit: the bound, margins taken off.
        reached: the value nearest to it; None where nothing came within reach of the check.
        left: the room between the two, negative where the limit is broken.
    """

    what: str
    where: str
    unit: str
    limit: float
    reached: float | None
    left: float


def known_speeds(arm: str, given: float | Sequence[float] | None, joints: int) -> Array:
    """Largest joint speeds (n,) [rad/s]: those given, or the table's for a shipped arm.

    Raises:
        IdentificationError: an MJCF file states no speeds, so they must be given; or their number does not fit.
    """
    if given is None:
        if arm not in ARMS:
            raise IdentificationError(f"speed limits of {arm!r} are not known, a model file has none; give them")
        return ARMS[arm].velocity_max
    values = np.atleast_1d(np.asarray(given, float))
    if len(values) not in (1, joints) or not (values > 0.0).all() or not np.isfinite(values).all():
        raise IdentificationError(f"speed limits (={given}): must be one number above 0 [rad/s], or {joints} of them")
    return np.array(np.broadcast_to(values, joints))


def limits_of(
    model: Any, speed: Array, *, position_margin: float, speed_share: float, torque_share: float, clearance: float
) -> Limits:
    """The limits of a compiled arm, with margins.

    Args:
        model: compiled arm.
        speed: largest joint speeds (n,) [rad/s].
        position_margin: kept from each end stop [rad].
        speed_share: of the speeds that may be used.
        torque_share: of the model's torque limits that may be used.
        clearance: see `Limits` [m].
    """
    facts = joint_facts(model)
    ends = [(-np.inf, np.inf) if stops is None else stops for _, stops, _ in facts]
    return Limits(
        joints=tuple(name for name, _, _ in facts),
        slide=chain_of(model).slide,
        lower=np.array([low for low, _ in ends]) + position_margin,
        upper=np.array([high for _, high in ends]) - position_margin,
        speed=speed_share * speed,
        torque=torque_share * torque_limits(model),
        clearance=clearance,
    )


def predicted_torque(model: Any, q: Array, dq: Array, ddq: Array) -> Array:
    """Torque (T, n) [N m] that the model needs for a motion (T, n), by MuJoCo: M ddq + h - passive + Coulomb."""
    tau = np.empty_like(q)
    terms = NominalModel(model, CHUNK)
    rows = np.arange(len(q))
    for start in range(0, len(q), CHUNK):
        some = rows[start : start + CHUNK]
        full = np.pad(some, (0, CHUNK - len(some)), mode="edge")
        now = terms.at(q[full], dq[full])
        all_of_it = (now.M @ ddq[full][..., None])[..., 0] + now.h - now.passive
        tau[some] = all_of_it[: len(some)]
    return np.asarray(tau + np.sign(dq) * model.dof_frictionloss)


def room(limits: Limits, clearance: Clearance, tau: Array, q: Array, dq: Array) -> list[Room]:
    """How near a sampled motion comes to each limit that there is.

    Args:
        limits: the bounds.
        clearance: of the arm.
        tau: torque (T, n) [N m].
        q: position (T, n) [rad].
        dq: speed (T, n) [rad/s].

    Returns:
        One for each joint and kind of limit, then one for the nearest pair of bodies.
    """
    found: list[Room] = []
    for j, joint in enumerate(limits.joints):
        low, high = q[:, j].min() - limits.lower[j], limits.upper[j] - q[:, j].max()
        bound, value = (limits.lower[j], q[:, j].min()) if low < high else (limits.upper[j], q[:, j].max())
        unit = "m" if limits.slide[j] else "rad"
        found.append(Room("position", joint, unit, float(bound), float(value), float(min(low, high))))
    for what, values, bounds, turn, shift in (
        ("speed", dq, limits.speed, "rad/s", "m/s"),
        ("torque", tau, limits.torque, "N m", "N"),
    ):
        for j, (most, limit) in enumerate(zip(np.abs(values).max(axis=0), bounds, strict=True)):
            unit = shift if limits.slide[j] else turn
            found.append(Room(what, limits.joints[j], unit, float(limit), float(most), float(limit - most)))
    found = [one for one in found if np.isfinite(one.limit)]
    if len(clearance.pairs):
        least, pair = clearance.nearest(q, limits.clearance + LOOKED_FOR)
        reached = None if pair is None else least
        found.append(Room("distance", pair or "any two", "m", limits.clearance, reached, least - limits.clearance))
    return found
