"""What an experiment left behind: joint positions and torques, each with the instants they belong to."""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.interfaces import Array


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Samples of n joints, K rows.

    Attributes:
        joints: names, in the order of the chain.
        t: instant at which each position was sampled (K, n) [s]; columns differ where joints are sampled one after the
            other.
        q: joint positions (K, n) [rad]; NaN where a sample is missing.
        since: instant from which each torque acted (K, n) [s], until the next one of that joint.
        tau: joint torques, link side (K, n) [N m]; NaN where none is known.
        position_step: resolution of q (n,) [rad]; 0 where it has none to speak of.
        torque_step: resolution of tau (n,) [N m]; 0 likewise, or where the arm really applied the stated value.
        end: instant at which the last torque ended [s].
        source: where it comes from, for errors and the report.
        shook: whether the loop was seen to vibrate, faster than identification follows.
        remarks: what a reader of the result should know, one sentence each.
    """

    joints: tuple[str, ...]
    t: Array
    q: Array
    since: Array
    tau: Array
    position_step: Array
    torque_step: Array
    end: float
    source: str
    shook: bool = False
    remarks: tuple[str, ...] = ()

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def period(self) -> float:
        """Time between two samples [s], the median."""
        return float(np.median(np.diff(self.t[:, 0])))
