"""The arm itself: N MuJoCo simulations stepped together under held torques, brakes and outside forces."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np
from mujoco.batch import Batch

from lwa4d_sim.errors import ModelError
from lwa4d_sim.interfaces import STRICT, Array, NonNegative, Positive, to_ns

# Inertia [kg m^2] of a joint whose own brake is closed (assumed: 1e5 times the arm's). The joint moves 1e-8 rad in
# 10 ms under the arm's weight, which is taken back; the others feel it as one with its link to one part in 1e5.
BRAKED_INERTIA = 1e6

# A joint this fast is no arm any more (assumed: about a thousand times the fastest joint of the LWA4D).
SPEED_LIMIT = 1000.0  # [rad/s]

_Vector = tuple[float, float, float]
# What is recorded of each step: as state components, for the batch looks up fields by name more slowly.
_Q, _DQ = int(mujoco.mjtState.mjSTATE_QPOS), int(mujoco.mjtState.mjSTATE_QVEL)


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """A force and torque on one body for a while, in world axes; a push is a short one.

    Attributes:
        at: start [s]; start and end are rounded up to plant steps.
        duration: length [s]; without it to the end of the run.
        force: [N], at the tool point or, with ``body``, at that body's centre of mass.
        torque: [N m].
        body: name of the body in the model; default the tool.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    at: NonNegative
    duration: Positive | None = None
    force: _Vector = (0.0, 0.0, 0.0)
    torque: _Vector = (0.0, 0.0, 0.0)
    body: str | None = None


class Plant:
    """N arms of one structure.

    Args:
        models: one compiled model for all arms, or one per arm.
        q0: start positions (N, n) [rad]; the arms start at rest.
        disturbances: outside forces, the same for all arms.
        threads: threads of the batch (0: all CPUs).
    """

    def __init__(
        self,
        models: mujoco.MjModel | Sequence[mujoco.MjModel],
        q0: Array,
        disturbances: Sequence[Disturbance] = (),
        threads: int = 1,
    ) -> None:
        model = models if isinstance(models, mujoco.MjModel) else models[0]
        _quiet()
        self._batch = Batch(model, len(q0), threads)
        if not isinstance(models, mujoco.MjModel):
            self._batch.set_models(models)
        self.timestep = to_ns(float(model.opt.timestep))
        self.q, self.dq = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl, self._wrench = self._batch.bind("ctrl"), self._batch.bind("xfrc_applied")
        self._warnings = self._batch.warning[:, :, 1]
        self._disturbances = [_Window.of(disturbance, model, self.timestep) for disturbance in disturbances]
        self._edges = sorted({edge for window in self._disturbances for edge in (window.first, window.last)})
        self._step = 0
        self._records: dict[int, tuple[Array, Array, dict[int, Array]]] = {}
        self._given_up: Any = None
        self._held: tuple[Any, Array] | None = None
        self._armature = np.array(model.dof_armature)
        self.running = np.ones(len(q0), bool)
        self._all_running = True
        self.q[:] = q0
        self.dq[:] = 0.0

    def advance(self, tau: Array | None, steps: int) -> tuple[Array, Array]:
        """Step all arms.

        Args:
            tau: torque (N, 1, n), held, or (N, steps, n), one per plant step [N m]. None closes all brakes; a NaN in a
                row closes that arm's: an ideal brake, the arm stands still at once (assumed).
            steps: number of plant steps.

        Returns:
            q and dq (N, steps, n) after each step. The arrays are reused by the next call.
        """
        edges = [edge - self._step for edge in self._edges if self._step < edge < self._step + steps]
        if self._disturbances:
            self._apply_wrenches()
        if not edges:
            out = self._span(tau, steps)
            self._step += steps
            return out
        pieces = []
        for start, end in zip([0, *edges], [*edges, steps], strict=True):
            part = tau[:, start:end] if tau is not None and tau.shape[1] > 1 else tau
            pieces.append([a.copy() for a in self._span(part, end - start)])
            self._step += end - start
            self._apply_wrenches()
        return np.concatenate([p[0] for p in pieces], axis=1), np.concatenate([p[1] for p in pieces], axis=1)

    def hold(self, joints: Any) -> None:
        """Close the brakes of the joints in a mask (n,), of all arms, and open all others; the rest goes on moving.

        An ideal brake: the joint stands still at once (assumed). For plants built from one model.
        """
        # The other joints must feel a held one through its link, which setting it back alone would not do: each step
        # computes their acceleration. So the joint gets an inertia that nothing can move.
        self._batch.expand("dof_armature")[:] = np.where(joints, BRAKED_INERTIA, self._armature)
        held = np.flatnonzero(joints)
        self.dq[:, held] = 0.0
        self._held = (held, self.q[:, held].copy()) if held.size else None

    def give_up(self, arms: Any) -> None:
        """Count the arms of a mask (N,) as lost, whatever their state."""
        self._given_up = arms if self._given_up is None else self._given_up | arms

    def diverged(self) -> Any:
        """Mask (N,) of arms found to have left all bounds since the last call, or None; they stand still from then."""
        # What the engine warns of is not finite, and what is not finite is not below the limit. One sum of squares is
        # the cheapest look at all speeds; this runs at every tick.
        if self._given_up is None and np.vdot(self.dq, self.dq) < SPEED_LIMIT**2:
            return None
        lost = ~(np.abs(self.dq).max(axis=1) < SPEED_LIMIT) | self._warnings.any(axis=1)
        if self._given_up is not None:
            lost |= self._given_up
        lost &= self.running
        if not lost.any():
            return None
        self.running &= ~lost
        self._all_running = bool(self.running.all())
        self.q[lost], self.dq[lost] = 0.0, 0.0
        return lost

    def _span(self, tau: Array | None, steps: int) -> tuple[Array, Array]:
        """Steps without a change of wrench."""
        q, dq, out = self._buffers(steps)
        if tau is None:
            self._brake(np.flatnonzero(self.running), 0, q, dq)
            return q, dq
        # a sum is the cheapest look for a NaN among few numbers
        if not self._all_running or math.isnan(np.add.reduce(tau, axis=None)):
            self._mixed(np.broadcast_to(tau, (len(tau), steps, tau.shape[2])), q, dq)
        elif tau.shape[1] == 1:
            self._ctrl[:] = tau[:, 0]
            if steps == 1:
                self._batch.step()
                q[:, 0], dq[:, 0] = self.q, self.dq
            else:
                self._batch.rollout(steps, record=(_Q, _DQ), out=out)
        else:
            self._batch.rollout(steps, tau, record=(_Q, _DQ), out=out)
        if self._held is not None:
            joints, where = self._held
            q[:, :, joints], dq[:, :, joints] = where[:, None], 0.0
            self.q[:, joints], self.dq[:, joints] = where, 0.0
        return q, dq

    def _mixed(self, tau: Array, q: Array, dq: Array) -> None:
        """Some arms braked or lost: runs of equal state, arm by arm groups."""
        steps = tau.shape[1]
        braked: Any = np.isnan(tau).any(axis=2)
        start = 0
        changes = np.flatnonzero((braked[:, 1:] != braked[:, :-1]).any(axis=0)) + 1
        for end in [*changes.tolist(), steps]:
            held = braked[:, start] & self.running
            free = ~braked[:, start] & self.running
            if held.any():
                self._brake(np.flatnonzero(held), start, q[:, :end], dq[:, :end])
            if free.any():
                ids = np.flatnonzero(free)
                out = self._batch.rollout(end - start, tau[ids, start:end], record=(_Q, _DQ), ids=ids)
                q[ids, start:end], dq[ids, start:end] = out[_Q], out[_DQ]
            lost = ~self.running
            q[lost, start:end], dq[lost, start:end] = self.q[lost][:, None], 0.0
            start = end

    def _brake(self, ids: Any, start: int, q: Array, dq: Array) -> None:
        self.dq[ids] = 0.0
        q[ids, start:] = self.q[ids][:, None]
        dq[ids, start:] = 0.0

    def _buffers(self, steps: int) -> tuple[Array, Array, dict[int, Array]]:
        """Arrays for q and dq, and the same as the batch wants them."""
        if steps not in self._records:
            n_sims, n = self.q.shape
            q, dq = np.zeros((n_sims, steps, n)), np.zeros((n_sims, steps, n))
            self._records[steps] = q, dq, {_Q: q, _DQ: dq}
        return self._records[steps]

    def _apply_wrenches(self) -> None:
        self._wrench[:] = 0.0
        for window in self._disturbances:
            if window.first <= self._step < window.last:
                self._wrench[:, window.body] += window.wrench


@dataclass(frozen=True, slots=True)
class _Window:
    """A disturbance on the plant's grid: steps first <= k < last."""

    first: int
    last: int
    body: int
    wrench: Array

    @staticmethod
    def of(disturbance: Disturbance, model: mujoco.MjModel, timestep: int) -> "_Window":
        name = disturbance.body or "tool"
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body < 0:
            names = [model.body(i).name for i in range(1, model.nbody)]
            raise ModelError(f"disturbance: no body '{name}' in the model; its bodies are {', '.join(names)}")
        first = -(-to_ns(disturbance.at) // timestep)
        last = np.iinfo(np.int64).max
        if disturbance.duration is not None:
            last = -(-to_ns(disturbance.at + disturbance.duration) // timestep)
        return _Window(int(first), int(last), body, np.array([*disturbance.force, *disturbance.torque]))


def _quiet() -> None:
    """Keep MuJoCo's warnings out of the terminal and of a log file in the user's folder; `diverged` reports them."""
    config = mujoco.MjLogConfig.get()
    config.logto_console = False
    config.logto_file = False
    config.set()
