"""What a controller believes: M, h, g and the tool's motion of a nominal arm, for many arms at once.

`NominalModel` asks MuJoCo, on a Batch of its own, so a controller never touches the plant's model. `ClosedForm3` is the
thesis's symbolic 3-DOF model with its errata corrected, a second road to the same numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch

from lwa4d_sim.chain import bias_from_jacobian, jacobian_from_axes
from lwa4d_sim.errors import ModelError
from lwa4d_sim.interfaces import Array, Pose
from lwa4d_sim.joint_friction import JointFriction

_VELOCITY_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)


class NominalModel:
    """MuJoCo's rigid-body terms at any joint state: an `ArmModel` and, after `at`, its own `RigidBodyTerms`.

    Args:
        models: one model for all arms, or one per arm, all of the same structure.
        n_sims: number of arms N.
        threads: threads of the batch (0: all CPUs).
    """

    def __init__(self, models: mujoco.MjModel | Sequence[mujoco.MjModel], n_sims: int = 1, threads: int = 1) -> None:
        first = models if isinstance(models, mujoco.MjModel) else models[0]
        self._batch = Batch(first, n_sims, threads)
        if not isinstance(models, mujoco.MjModel):
            self._batch.set_models(models)
        n = first.nv
        self._friction = JointFriction([models] if isinstance(models, mujoco.MjModel) else models)
        self._slide = np.asarray(first.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)
        self._site = tool_site(first)
        self._q, self._dq = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._h = self._batch.bind("qfrc_bias")
        self._bound: dict[str, Array] = {}
        # MuJoCo stores M as sparse rows of the lower triangle; for a serial chain that is the whole triangle
        row, column = np.indices((n, n))
        low, high = np.minimum(row, column), np.maximum(row, column)
        self._dense = np.asarray(first.M_rowadr)[high] + low

    def at(self, q: Array, dq: Array | None = None) -> "NominalModel":
        """Evaluate at ``q`` and ``dq`` (N, n) [rad, rad/s]; without ``dq`` at rest, where ``h`` is gravity."""
        self._q[:] = q
        self._dq[:] = 0.0 if dq is None else dq
        self._batch.forward(stage=_VELOCITY_STAGE)
        self._jacobian: Array | None = None
        return self

    def friction(self, dq: Array) -> Array:
        """Friction torque (N, n) [N m] at joint speed ``dq`` (N, n); see `JointFriction`."""
        return self._friction(dq)

    def _field(self, name: str) -> Array:
        """A bound MjData field; the first use binds it and evaluates once more to fill it."""
        if name not in self._bound:
            self._bound[name] = self._batch.bind(name)
            self._batch.forward(stage=_VELOCITY_STAGE)
        return self._bound[name]

    @property
    def M(self) -> Array:
        """Inertia matrix (N, n, n) [kg m^2], rotor inertia included."""
        # take, not an index: its layout, and with it every product's last bit, is the same for any N
        M: Array = self._field("M").take(self._dense, axis=1)
        return M

    @property
    def h(self) -> Array:
        """Bias torque (N, n) [N m]: C dq + g."""
        h: Array = self._h.copy()
        return h

    @property
    def passive(self) -> Array:
        """Torque of springs and dampers in the joints (N, n) [N m]."""
        passive: Array = self._field("qfrc_passive").copy()
        return passive

    @property
    def pose(self) -> Pose:
        """Tool pose: (N, 3) [m] and (N, 3, 3)."""
        if self._site < 0:
            R = self._field("xmat")[:, -1].reshape(-1, 3, 3)
            return Pose(self._field("xpos")[:, -1].copy(), R.copy())
        R = self._field("site_xmat")[:, self._site].reshape(-1, 3, 3)
        return Pose(self._field("site_xpos")[:, self._site].copy(), R.copy())

    @property
    def J(self) -> Array:
        """Tool Jacobian (N, 6, n), linear rows first."""
        if self._jacobian is None:
            axes, anchors = self._field("xaxis"), self._field("xanchor")
            self._jacobian = jacobian_from_axes(axes, anchors, self.pose.x, self._slide)
        return self._jacobian

    def dJ_dq(self, dq: Array) -> Array:
        """Bias acceleration of the tool (N, 6) at joint speed ``dq`` (N, n)."""
        return bias_from_jacobian(self.J, dq)


def tool_site(model: mujoco.MjModel) -> int:
    """Index of the tool site (`tcp`, else `attachment_site`), or -1 when the last body's frame is the tool."""
    for name in ("tcp", "attachment_site"):
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
        if site >= 0:
            return int(site)
    return -1


class Dynamics:
    """M(q), h(q, dq) and g(q) of one arm for arrays of states with any leading axes."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model

    def _at(self, q: Array, dq: Array | None) -> tuple[NominalModel, tuple[int, ...]]:
        q = np.asarray(q, float)
        flat = q.reshape(-1, self._model.nv)
        rates = None if dq is None else np.broadcast_to(np.asarray(dq, float), q.shape).reshape(flat.shape)
        return NominalModel(self._model, len(flat)).at(flat, rates), q.shape

    def M(self, q: Array) -> Array:
        """Inertia matrix (..., n, n) [kg m^2] at ``q`` (..., n)."""
        terms, shape = self._at(q, None)
        return terms.M.reshape(*shape, shape[-1])

    def h(self, q: Array, dq: Array) -> Array:
        """Bias torque C dq + g (..., n) [N m]."""
        terms, shape = self._at(q, dq)
        return terms.h.reshape(shape)

    def g(self, q: Array) -> Array:
        """Gravity torque (..., n) [N m]."""
        terms, shape = self._at(q, None)
        return terms.h.reshape(shape)


@dataclass(frozen=True, slots=True)
class _Terms3:
    """Terms of the closed form at one state, (N, ...)."""

    M: Array
    h: Array
    pose: Pose
    J: Array
    _rates: tuple[Array, Array, Array, Array]

    def dJ_dq(self, dq: Array) -> Array:
        """Second derivative of the closed-form tool point at zero joint acceleration; angular rows from the axes."""
        r, height, q1, slopes = self._rates  # slopes: dr/dq2, dr/dq4
        dq1, dq2, dq4 = dq[:, 0], dq[:, 1], dq[:, 2]
        c1, s1 = np.cos(q1), np.sin(q1)
        dr = slopes[:, 0] * dq2 + slopes[:, 1] * dq4
        # with phi2 = q2 and phi3 = q2 + q4: r = L2 c2 + L3 c24 and z = L1 - L2 s2 - L3 s24
        forearm = height[:, 1], height[:, 0]  # L3 c24, L2 c2
        w3 = dq2 + dq4
        ddr = -forearm[1] * dq2**2 - forearm[0] * w3**2
        ddz = -slopes[:, 2] * dq2**2 - slopes[:, 1] * w3**2
        linear = [
            ddr * c1 - 2.0 * dr * s1 * dq1 - r * c1 * dq1**2,
            ddr * s1 + 2.0 * dr * c1 * dq1 - r * s1 * dq1**2,
            ddz,
        ]
        # pitch axes turn with joint 1: d/dt (-s1, c1, 0) w3
        angular = [-c1 * dq1 * w3, -s1 * dq1 * w3, np.zeros_like(q1)]
        return np.stack([*linear, *angular], axis=-1)


class ClosedForm3:
    """The thesis's 3-DOF model in closed form (section 5.3.2), errata 3, 4 and 5 corrected.

    Reads mass, centre of mass and inertia from a compiled 3-DOF model, so payload and mass scale of the nominal model
    carry over as long as each link's mass lies on its axis.

    Args:
        model: compiled `lwa4d_3dof` or `lwa4d_3dof_printed`, possibly edited.

    Raises:
        ModelError: not such an arm, or gravity or a link's mass lies off its axis.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        if model.nv != 3:
            raise ModelError(f"the closed form describes the 3-DOF arm; this model has {model.nv} joints")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        bodies = np.asarray(model.jnt_bodyid)
        # at q = 0 the links lie along base x (link 1 along z) and the pitch axes along base y
        R = data.ximat[bodies].reshape(-1, 3, 3)
        inertia = np.einsum("bij,bj,bkj->bik", R, model.body_inertia[bodies], R)
        com = data.xipos[bodies] - data.xanchor
        self._g = -float(model.opt.gravity[2])
        self._m2, self._m3 = model.body_mass[bodies[1:]]
        self._lc2, self._lc3 = com[1:, 0]
        self._L1 = float(data.xanchor[1, 2])
        self._L2 = float(data.xanchor[2, 0] - data.xanchor[1, 0])
        self._L3 = float(data.site_xpos[tool_site(model), 0] - data.xanchor[2, 0])
        self._axial = inertia[:, 0, 0]  # Ixx, along the link
        self._vertical = inertia[:, 2, 2]  # Iyy of the thesis
        self._pitch = inertia[:, 1, 1]  # Izz of the thesis
        self._armature = np.asarray(model.dof_armature)
        self._friction = JointFriction([model])
        self._check(model)

    def friction(self, dq: Array) -> Array:
        """Friction torque (N, 3) [N m] at joint speed ``dq`` (N, 3); see `JointFriction`."""
        return self._friction(dq)

    def _check(self, model: mujoco.MjModel) -> None:
        """Compare with MuJoCo at a few states without any symmetry."""
        q = np.array([[0.3, -1.1, 0.9], [2.1, 0.4, -1.7], [-1.3, -2.3, 2.2]])
        here, there = self.at(q, q[::-1]), NominalModel(model, len(q)).at(q, q[::-1])
        for a, b in ((here.M, there.M), (here.h, there.h), (here.J, there.J)):
            if not np.allclose(a, b, atol=1e-8):
                raise ModelError(
                    "the closed form describes lwa4d_3dof and what keeps its shape: gravity along z and every link's "
                    "mass on the link's axis; use dynamics: mujoco"
                )

    def at(self, q: Array, dq: Array | None = None) -> _Terms3:
        """Terms at ``q`` and ``dq`` (N, 3); without ``dq`` at rest."""
        dq = np.zeros_like(q) if dq is None else dq
        q1, q2, q4 = q[:, 0], q[:, 1], q[:, 2]
        dq1, dq2, dq4 = dq[:, 0], dq[:, 1], dq[:, 2]
        c2, s2, c4, s4 = np.cos(q2), np.sin(q2), np.cos(q4), np.sin(q4)
        c24, s24 = np.cos(q2 + q4), np.sin(q2 + q4)
        m2, m3, lc2, lc3, l2 = self._m2, self._m3, self._lc2, self._lc3, self._L2
        Ix2, Ix3 = self._axial[1:]
        Iy2, Iy3 = self._vertical[1:]
        Iz2, Iz3 = self._pitch[1:]
        reach = l2 * c2 + lc3 * c24  # horizontal distance of link 3's centre of mass

        M = np.zeros((len(q), 3, 3))
        M[:, 0, 0] = (
            self._vertical[0] + Ix2 * s2**2 + (Iy2 + m2 * lc2**2) * c2**2 + Ix3 * s24**2 + Iy3 * c24**2 + m3 * reach**2
        )
        M[:, 1, 1] = m2 * lc2**2 + Iz2 + Iz3 + m3 * (l2**2 + lc3**2 + 2.0 * l2 * lc3 * c4)
        M[:, 1, 2] = M[:, 2, 1] = m3 * (lc3**2 + l2 * lc3 * c4) + Iz3
        M[:, 2, 2] = m3 * lc3**2 + Iz3
        M += np.diag(self._armature)

        # Christoffel terms; half the slopes of M11
        tilt3 = s24 * c24 * (Ix3 - Iy3)
        b2 = s2 * c2 * (Ix2 - Iy2 - m2 * lc2**2) + tilt3 - m3 * reach * (l2 * s2 + lc3 * s24)
        b4 = tilt3 - m3 * reach * lc3 * s24
        k = m3 * l2 * lc3 * s4
        g2 = -self._g * (m3 * reach + m2 * lc2 * c2)  # erratum 3: both terms pull the same way
        g4 = -self._g * m3 * lc3 * c24
        h = np.stack(
            [
                2.0 * (b2 * dq2 + b4 * dq4) * dq1,
                -b2 * dq1**2 - k * dq4 * dq2 - k * (dq2 + dq4) * dq4 + g2,
                -b4 * dq1**2 + k * dq2**2 + g4,  # erratum 4: c31 = -c13
            ],
            axis=-1,
        )
        return self._tool(q1, c2, s2, c24, s24, M, h)

    def _tool(self, q1: Array, c2: Array, s2: Array, c24: Array, s24: Array, M: Array, h: Array) -> _Terms3:
        c1, s1 = np.cos(q1), np.sin(q1)
        zero, one = np.zeros_like(q1), np.ones_like(q1)
        r = self._L2 * c2 + self._L3 * c24
        up2, up3 = -self._L2 * s2, -self._L3 * s24  # dr/dq2 = up2 + up3, and z = L1 + up2 + up3
        dr2, dr4 = up2 + up3, up3
        x = np.stack([r * c1, r * s1, self._L1 + up2 + up3], axis=-1)
        J = np.stack(
            [
                np.stack([-r * s1, dr2 * c1, dr4 * c1], axis=-1),
                np.stack([r * c1, dr2 * s1, dr4 * s1], axis=-1),
                np.stack([zero, -r, -self._L3 * c24], axis=-1),
                np.stack([zero, -s1, -s1], axis=-1),
                np.stack([zero, c1, c1], axis=-1),
                np.stack([one, zero, zero], axis=-1),
            ],
            axis=-2,
        )
        R = np.stack(  # the tool's z lies along the forearm
            [
                np.stack([-c1 * s24, -s1, c1 * c24], axis=-1),
                np.stack([-s1 * s24, c1, s1 * c24], axis=-1),
                np.stack([-c24, zero, -s24], axis=-1),
            ],
            axis=-2,
        )
        extents = np.stack([self._L2 * c2, self._L3 * c24], axis=-1)
        slopes = np.stack([dr2, dr4, up2], axis=-1)
        return _Terms3(M, h, Pose(x, R), J, (r, extents, q1, slopes))
