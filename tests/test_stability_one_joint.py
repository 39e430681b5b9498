"""One joint in closed form: the edges of stability by Jury and by D-decomposition, and the program's against them.

The formulas stand in docs/stability.md, section "One joint in closed form".
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import cont2discrete

from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.study import Study

T, T_F = 0.01, 0.013  # [s] period and filter; not alike, so that neither can stand for the other
MASS, REACH, OWN = 2.0, 0.3, 0.02  # [kg, m, kg m^2]
J = OWN + MASS * REACH**2  # about the joint
SLOPE = 9.81 * MASS * REACH  # dg/dq of the hanging arm [N m/rad]

MODEL = f"""
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body>
      <joint name="joint" axis="0 1 0"/>
      <inertial pos="{REACH} 0 0" mass="{MASS}" diaginertia="{OWN} {OWN} {OWN}"/>
      <geom size="0.01" mass="0"/>
      <site name="tcp" pos="{REACH} 0 0"/>
    </body>
  </worldbody>
  <actuator><motor joint="joint" ctrlrange="-1000 1000"/></actuator>
</mujoco>
"""

TEXT = """
name: one_joint
arm: {arm}
plant: {{timestep: 0.001}}
trajectory: {{waypoints: {{space: joint, points: [[{q}]]}}, segment_time: 1.0, profile: step}}
controller: {{kind: pd_gravity, kp: {kp!r}, kd: {kd!r}}}
loop: {{period: {T}, actuation: {actuation}, latency: {latency!r}, velocity: {velocity}}}
"""

VELOCITIES = {
    "true": "{kind: 'true'}",
    "backward_difference": "{kind: backward_difference}",
    "tustin": f"{{kind: tustin, time_constant: {T_F}}}",
    "held": f"{{kind: filtered_derivative, time_constant: {T_F}, runs_on: held}}",
    "continuous": f"{{kind: filtered_derivative, time_constant: {T_F}, runs_on: continuous}}",
    "kalman": "{kind: kalman, acceleration: 30, position: 0.001}",
}
POSES = {"level": 0.0, "hanging": np.pi / 2, "inverted": -np.pi / 2}  # gravity's slope: none, +, -


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("arm") / "one_joint.xml"
    file.write_text(MODEL)
    return file


def edge(
    arm: Path, kp: float, ratio: float, *, pose: str = "level", velocity: str, latency: float = 0.0, sync: bool = False
) -> float:
    """The program's largest kp with kd = ``ratio`` kp, searched from ``kp``."""
    scenario = Scenario.parse(
        TEXT.format(
            arm=arm,
            q=POSES[pose],
            kp=kp,
            kd=ratio * kp,
            T=T,
            latency=latency,
            velocity=VELOCITIES[velocity],
            actuation="next_sync" if sync else "immediate",
        )
    )
    study = Study(scenario, "default")
    loop = study.close(study.linear(study.waypoints()))
    margin: float = study.gain_margin(loop)[0]
    return kp * margin


# Jury ---------------------------------------------------------------------------------------------------------------


def damping_limit(m: float, late: float) -> float:
    """Largest kd T / J with the true speed, m = kp T / (2 kd), command late by ``late`` periods (0 to 1)."""
    nyquist = 1.0 - 2.0 * late - 2.0 * m * late * (1.0 - late)
    turning = late * (1.0 - m * late) * (1.0 + m * (1.0 - 2.0 * late))
    limits = [2.0 / nyquist] if nyquist > 0 else []
    if turning:
        limits.append((1.0 - m * (1.0 + 2.0 * late)) / turning)
    return min(limits)


@pytest.mark.parametrize("ratio", [0.5, 0.06, 0.02])
@pytest.mark.parametrize("late", [0.0, 0.05, 0.25, 0.4, 0.5, 0.75, 0.999, 1.0])
def test_true_speed(arm: Path, late: float, ratio: float) -> None:
    kd = damping_limit(T / (2.0 * ratio), late) * J / T
    found = ratio * edge(arm, 0.1 * kd / ratio, ratio, velocity="true", latency=late * T)
    assert found == pytest.approx(kd, rel=1e-6)


@pytest.mark.parametrize("late", [0.0, 0.3, 1.0])
def test_true_speed_needs_damping_for_half_a_period_and_the_latency(arm: Path, late: float) -> None:
    """No gain is small enough once kd / kp <= T / 2 + L: the least damping that the delay eats up."""
    least = T * (0.5 + late)
    for share, stable in ((0.999, False), (1.001, True)):
        found = edge(arm, 1e-4, share * least, velocity="true", latency=late * T)
        assert (found > 1e-4) == stable


def test_a_full_period_late_is_the_next_sync(arm: Path) -> None:
    late = edge(arm, 1.0, 0.05, velocity="true", latency=T)
    assert edge(arm, 1.0, 0.05, velocity="true", sync=True) == pytest.approx(late, rel=1e-9)
    m = T / 0.1
    assert 0.05 * late == pytest.approx((1 - 3 * m) / (1 - m) ** 2 * J / T, rel=1e-6)


@pytest.mark.parametrize("ratio", [0.5, 0.02, 0.007])
def test_backward_difference(arm: Path, ratio: float) -> None:
    c = T / ratio
    kd = 2.0 * J / T * (2.0 - c) / (2.0 + c)
    found = ratio * edge(arm, 0.1 * kd / ratio, ratio, velocity="backward_difference")
    assert found == pytest.approx(kd, rel=1e-6)


@pytest.mark.parametrize("pose", ["hanging", "inverted"])
def test_true_speed_under_gravity(arm: Path, pose: str) -> None:
    w = np.sqrt(complex({"hanging": SLOPE, "inverted": -SLOPE}[pose] / J))
    kd = float((J * w / np.tan(w * T / 2)).real)
    assert 0.05 * edge(arm, 5.0, 0.05, pose=pose, velocity="true") == pytest.approx(kd, rel=1e-6)


def test_a_hanging_joint_needs_less_damping(arm: Path) -> None:
    """kp - G < kd w / tan(w T / 2): gravity carries part of the stiffness."""
    w = np.sqrt(SLOPE / J)
    needed = float(np.tan(w * T / 2) / w)
    expected = SLOPE / (1 - 0.8)
    assert edge(arm, 1.0, 0.8 * needed, pose="hanging", velocity="true") == pytest.approx(expected, rel=1e-6)


# D-decomposition ----------------------------------------------------------------------------------------------------

Transfer = Callable[[complex], complex]


class Pulse(NamedTuple):
    """Exact pulse transfer functions from the held torque: to the angle, and to the speed that the drive sends."""

    q: Transfer
    v: Transfer


def closed_form(slope: float, filtered: bool) -> Pulse:
    """The formulas of the page; with the drive's filter only without gravity."""
    w = np.sqrt(complex(slope / J))
    c, s = np.cos(w * T), (np.sin(w * T) / w if slope else T)
    push = (1 - c) / slope if slope else T**2 / (2 * J)

    def q(z: complex) -> complex:
        return complex(push * (z + 1) / (z**2 - 2 * c * z + 1))

    def v(z: complex) -> complex:
        return complex(s / J * (z - 1) / (z**2 - 2 * c * z + 1))

    def filtered_v(z: complex) -> complex:
        assert not slope
        d = np.exp(-T / T_F)
        lag = (z - 1) * (T * d / (z - d) ** 2 + 2 * T_F / (z - d))
        return complex((T / (z - 1) - 2 * T_F + lag) / J)

    return Pulse(q, filtered_v if filtered else v)


def by_scipy(slope: float, filtered: bool) -> Pulse:
    """The same from state space: joint, and the filter's two lags."""
    A = np.zeros((4, 4))
    A[0, 1], A[1, 0] = 1.0, -slope / J
    A[2, 0], A[2, 2], A[3, 2], A[3, 3] = 1 / T_F, -1 / T_F, 1 / T_F, -1 / T_F
    B = np.array([[0.0], [1 / J], [0.0], [0.0]])
    C = np.array([[1.0, 0, 0, 0], [0, 0, 1 / T_F, -1 / T_F] if filtered else [0, 1.0, 0, 0]])
    F, G, *_ = cont2discrete((A, B, C, np.zeros((2, 1))), T, "zoh")

    def row(i: int) -> Transfer:
        return lambda z: complex((C[i] @ np.linalg.solve(z * np.eye(4) - F, G))[0])

    return Pulse(row(0), row(1))


@pytest.mark.parametrize(("slope", "filtered"), [(0.0, False), (0.0, True), (SLOPE, False), (-SLOPE, False)])
def test_pulse_transfer_functions(slope: float, filtered: bool) -> None:
    one, other = closed_form(slope, filtered), by_scipy(slope, filtered)
    rng = np.random.default_rng(1)
    for z in 1.1 * np.exp(1j * rng.uniform(0.1, np.pi, 20)):
        assert one.q(z) == pytest.approx(other.q(z), rel=1e-9)
        assert one.v(z) == pytest.approx(other.v(z), rel=1e-9)


def estimator(velocity: str, pulse: Pulse) -> Pulse:
    """From the held torque to what the law is given."""
    if velocity in ("true", "continuous"):
        return pulse
    d = np.exp(-T / T_F)

    def kalman(i: int) -> Transfer:
        index = T**2 * 30 / 0.001  # tracking index; gains of the steady state in closed form (Kalata 1984)
        r = (4 + index - np.sqrt(8 * index + index**2)) / 4
        alpha = 1 - r**2
        gain = np.array([alpha, (2 * (2 - alpha) - 4 * np.sqrt(1 - alpha)) / T])
        predict = np.array([[1.0, T], [0.0, 1.0]])
        correct = predict - np.outer(gain, predict[0])
        return lambda z: complex(np.linalg.solve(np.eye(2) - correct / z, gain.astype(complex))[i])

    slopes: dict[str, Transfer] = {
        "backward_difference": lambda z: (z - 1) / (T * z),
        "tustin": lambda z: 2 / T * (z - 1) * (z + 1) / (z + 1 + 2 * T_F / T * (z - 1)) ** 2,
        "held": lambda z: T * d / T_F**2 * (z - 1) / (z - d) ** 2,
        "kalman": kalman(1),
    }
    place: Transfer = kalman(0) if velocity == "kalman" else lambda z: 1.0
    return Pulse(lambda z: place(z) * pulse.q(z), lambda z: slopes[velocity](z) * pulse.q(z))


def least_crossing(given: Pulse, slope: float, ratio: float, late: int, above: float) -> float:
    """Least real kp above ``above`` on the curve kp(z) = (slope Q - z^late) / (Q + ratio V), z = e^(j angle)."""

    def kp(angle: float) -> complex:
        z = complex(np.exp(1j * angle))
        return (slope * given.q(z) - z**late) / (given.q(z) + ratio * given.v(z))

    angles = np.concatenate([np.geomspace(1e-3, 0.05, 200), np.linspace(0.05, np.pi, 2000)[1:]])
    values = np.array([kp(a) for a in angles])
    found = [values[-1].real]  # z = -1 is real in any case
    for k in np.flatnonzero(np.sign(values.imag[1:-1]) != np.sign(values.imag[:-2])):
        at = brentq(lambda a: kp(a).imag, angles[k], angles[k + 1], xtol=1e-15)
        if abs(kp(at).imag) < 1e-3 * abs(kp(at)):  # no pole
            found.append(kp(at).real)
    return float(min(x for x in found if x > above))


@pytest.mark.parametrize("pose", list(POSES))
@pytest.mark.parametrize("sync", [False, True], ids=["immediate", "next_sync"])
@pytest.mark.parametrize("velocity", list(VELOCITIES))
def test_every_estimator_by_d_decomposition(arm: Path, velocity: str, sync: bool, pose: str) -> None:
    slope = {"level": 0.0, "hanging": SLOPE, "inverted": -SLOPE}[pose]
    filtered = velocity == "continuous"
    pulse = by_scipy(slope, filtered) if filtered and slope else closed_form(slope, filtered)
    ratio, start = 0.25, 2.0
    expected = least_crossing(estimator(velocity, pulse), slope, ratio, int(sync), start)
    found = edge(arm, start, ratio, pose=pose, velocity=velocity, sync=sync)
    assert found == pytest.approx(expected, rel=1e-6)


def test_late_gravity_compensation_needs_some_gain(arm: Path) -> None:
    """Standing upright, a torque g(q) that comes half a period and the latency late drives the arm: see the page."""
    ratio, L = 0.25, T
    least = SLOPE * (0.5 * T + L) / (ratio - 0.5 * T - L)
    growth = {}
    for kp in (0.9 * least, 1.1 * least):
        text = TEXT.format(
            arm=arm, q=POSES["inverted"], kp=kp, kd=ratio * kp, T=T, latency=0.0, velocity=VELOCITIES["true"],
            actuation="next_sync",
        )  # fmt: skip
        study: Any = Study(Scenario.parse(text), "default")
        growth[kp] = study.close(study.linear(study.waypoints())).radius(np.arange(1), np.ones(1))[0]
    small, large = growth.values()
    assert small > 1 > large
