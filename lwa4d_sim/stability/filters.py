"""Velocity estimators as linear discrete systems of one joint: from the samples q and v to the estimates of q and dq.

Each is the difference equation of the block of the same kind in `estimators`, written as matrices.
"""

from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np

from lwa4d_sim.estimators import (
    BackwardDifferenceVelocity,
    FilteredDerivative,
    KalmanVelocity,
    TrueVelocity,
    TustinVelocity,
    kalman_gain,
)
from lwa4d_sim.interfaces import Array
from lwa4d_sim.observers import ObserverVelocity


class Filter(NamedTuple):
    """z' = A z + B y, s = C z + D y with y = (q, v) and s = (q, dq) of one joint.

    Attributes:
        A, B, C, D: (m, m), (m, 2), (2, m), (2, 2).
        time_constant: T [s] of the drive's filter s / (1 + T s)^2 on the continuous position, whose output is v; 0
            where v is the true speed.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    time_constant: float = 0.0


def _direct(time_constant: float = 0.0) -> Filter:
    """The samples themselves."""
    return Filter(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), np.eye(2), time_constant)


@singledispatch
def filter_of(velocity: Any, period: float) -> Filter:
    """The linear system of a velocity estimator read every ``period`` [s].

    Raises:
        TypeError: there is none for this kind.
    """
    raise TypeError(f"no linear model of {type(velocity).__name__}")


@filter_of.register
def _true(velocity: TrueVelocity, period: float) -> Filter:
    return _direct()


@filter_of.register
def _observer(velocity: ObserverVelocity, period: float) -> Filter:
    return _direct()  # not used: `Assist` has the observer, which needs the arm


@filter_of.register
def _filtered(velocity: FilteredDerivative, period: float) -> Filter:
    T = velocity.time_constant
    if velocity.runs_on == "continuous":
        return _direct(T)
    decay = float(np.exp(-period / T))
    carry = period / T * decay
    A = np.array([[decay, 0.0, 1.0 - decay], [carry, decay, 1.0 - decay - carry], [0.0, 0.0, 0.0]])  # y1, y2, held
    B = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    C = np.vstack([np.zeros(3), (A[0] - A[1]) / T])  # read just before the new step shows
    return Filter(A, B, C, np.array([[1.0, 0.0], [0.0, 0.0]]))


@filter_of.register
def _difference(velocity: BackwardDifferenceVelocity, period: float) -> Filter:
    return Filter(
        np.zeros((1, 1)),
        np.array([[1.0, 0.0]]),
        np.array([[0.0], [-1.0 / period]]),
        np.array([[1.0, 0.0], [1.0 / period, 0.0]]),
    )


@filter_of.register
def _tustin(velocity: TustinVelocity, period: float) -> Filter:
    c = 2.0 * velocity.time_constant / period
    b, a = 2.0 / period / (1.0 + c) ** 2, (1.0 - c) / (1.0 + c)
    row = np.array([0.0, -b, -2.0 * a, -(a**2)])  # q_1, q_2, dq_1, dq_2
    A = np.array([[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], row, [0.0, 0.0, 1.0, 0.0]])
    B = np.array([[1.0, 0.0], [0.0, 0.0], [b, 0.0], [0.0, 0.0]])
    return Filter(A, B, np.vstack([np.zeros(4), row]), np.array([[1.0, 0.0], [b, 0.0]]))


@filter_of.register
def _kalman(velocity: KalmanVelocity, period: float) -> Filter:
    gain = kalman_gain(period, velocity.acceleration, velocity.position)[:, None]
    predict = np.array([[1.0, period], [0.0, 1.0]])
    A = predict - gain @ predict[:1]
    B = np.hstack([gain, np.zeros((2, 1))])
    return Filter(A, B, A, B)
