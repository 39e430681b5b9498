"""How far an arm stays from itself and from what stands around it, by MuJoCo's distance between the model's geoms."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from lwa4d_sim.interfaces import Array, IntArray
from lwa4d_sim.mjcf_checks import name_of

SAME_POINT = 1e-6  # [m] (assumed): joints nearer than this turn about one point
POSTURES = 50  # random ones in which a pair must overlap to be taken for drawn so (assumed)
_NO_DISTANCE = (int(mujoco.mjtGeom.mjGEOM_HFIELD), int(mujoco.mjtGeom.mjGEOM_SDF))  # mj_geomDistance knows none


class Near(NamedTuple):
    """Pairs of geoms found near each other, K of them.

    Attributes:
        sample: at which of the postures, (K,).
        pair: which pair, an index into `Clearance.pairs`, (K,).
        distance: between the two, negative where they overlap, (K,) [m].
        slope: its derivative with respect to the joints (K, n) [m/rad].
    """

    sample: IntArray
    pair: IntArray
    distance: Array
    slope: Array


class Clearance:
    """Distances between links that are no neighbours, and between them and what does not move.

    Looked at are the geoms that may collide; all geoms where the model has none that may. Links joined by a joint touch
    there by design, and so do the two links on either side of joints that turn about one point, as in a wrist; joint
    limits, not distances, keep those apart. Pairs that overlap in every one of some random postures do so by the way
    they are drawn; they are left out and named.

    Args:
        model: compiled arm.

    Attributes:
        pairs: geom numbers (P, 2).
        left_out: pairs of bodies that overlap always.
    """

    def __init__(self, model: Any) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        bodies = np.asarray(model.geom_bodyid)
        number = {int(body): j + 1 for j, body in enumerate(model.jnt_bodyid)}
        self._link = np.array([number.get(int(model.body_weldid[body]), 0) for body in bodies], dtype=np.int64)
        solid = (np.asarray(model.geom_contype) | np.asarray(model.geom_conaffinity)) != 0
        usable = (solid if solid.any() else np.ones_like(solid)) & ~np.isin(model.geom_type, _NO_DISTANCE)
        i, j = np.triu_indices(model.ngeom, 1)
        low, high = np.minimum(self._link[i], self._link[j]), np.maximum(self._link[i], self._link[j])
        mujoco.mj_kinematics(model, self._data)
        same = np.linalg.norm(np.diff(self._data.xanchor, axis=0), axis=1) < SAME_POINT  # of joint k + 1 and k + 2
        wrist = (high - low == 2) & np.append(same, [False, False])[low]
        apart = (high - low > 1) & ~wrist
        self.pairs = np.stack([i, j], axis=1)[usable[i] & usable[j] & apart]
        ends: Array = np.where(np.asarray(model.jnt_limited, bool)[:, None], model.jnt_range, [-np.pi, np.pi])
        drawn = np.random.default_rng(0).uniform(ends[:, 0], ends[:, 1], (POSTURES, model.njnt))
        found = self.near(drawn, 0.0)
        always = np.bincount(found.pair, minlength=len(self.pairs)) == POSTURES
        self.left_out = sorted({self.name(int(k)) for k in np.flatnonzero(always)})
        self.pairs = self.pairs[~always]

    def name(self, pair: int) -> str:
        """The two bodies of a pair, as in "link2 - link4"; the floor and other fixed things are "world"."""
        first, second = (name_of(self._model, "BODY", int(self._model.geom_bodyid[g])) for g in self.pairs[pair])
        return f"{first} - {second}"

    def near(self, q: Array, reach: float) -> Near:
        """All pairs nearer to each other than ``reach`` [m] at the postures ``q`` (T, n)."""
        model, data = self._model, self._data
        found: list[tuple[int, int, float]] = []
        points: list[Array] = []
        axes: dict[int, tuple[Array, Array]] = {}
        ends = np.empty(6)
        pairs = self.pairs.tolist()
        for k, posture in enumerate(q):
            data.qpos[:] = posture
            mujoco.mj_kinematics(model, data)
            for p, (first, second) in enumerate(pairs):
                distance = mujoco.mj_geomDistance(model, data, first, second, reach, ends)
                if distance < reach:
                    found.append((k, p, distance))
                    points.append(ends.reshape(2, 3).copy())
                    if k not in axes:
                        axes[k] = data.xaxis.copy(), data.xanchor.copy()
        n = model.njnt
        if not found:
            none = np.empty(0, dtype=np.int64)
            return Near(none, none, np.empty(0), np.empty((0, n)))
        sample, pair = (np.array([one[i] for one in found], dtype=np.int64) for i in (0, 1))
        distance = np.array([one[2] for one in found])
        return Near(sample, pair, distance, self._slopes(pair, distance, np.array(points), [axes[k] for k in sample]))

    def nearest(self, q: Array, reach: float) -> tuple[float, str | None]:
        """Least distance [m] over the postures ``q`` (T, n) and whose it is; ``reach`` and None where none is less."""
        model, data = self._model, self._data
        least, pair = reach, None
        ends = np.empty(6)
        pairs = self.pairs.tolist()
        for posture in q:
            data.qpos[:] = posture
            mujoco.mj_kinematics(model, data)
            for p, (first, second) in enumerate(pairs):
                distance = mujoco.mj_geomDistance(model, data, first, second, max(least, 0.0), ends)
                if distance < least:
                    least, pair = distance, p
        return float(least), None if pair is None else self.name(pair)

    def _slopes(self, pair: IntArray, distance: Array, points: Array, axes: list[tuple[Array, Array]]) -> Array:
        """Derivatives (K, n) of distances (K,) between points (K, 2, 3) [m]: the normal times the points' Jacobians."""
        n = self._model.njnt
        axis, anchor = (np.array([one[i] for one in axes]) for i in (0, 1))  # (K, n, 3)
        slide = np.asarray(self._model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)[:, None]
        normal = np.diff(points, axis=1)[:, 0] / np.where(distance == 0.0, 1.0, distance)[:, None]
        slope = np.zeros((len(distance), n))
        for side, sign in ((0, -1.0), (1, 1.0)):
            velocity = np.where(slide, axis, np.cross(axis, points[:, side, None] - anchor))  # (K, n, 3)
            moves = np.arange(n) < self._link[self.pairs[pair, side]][:, None]
            slope += sign * moves * np.einsum("kni,ki->kn", velocity, normal)
        return slope
