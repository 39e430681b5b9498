"""The thesis's errata: each printed formula, written out here, against the corrected code or MuJoCo; docs/errata.md."""

from typing import Any

import numpy as np
import pytest
from scipy.signal import bilinear, lfilter

from lwa4d_sim import Scenario, run
from lwa4d_sim.arm import ARMS, GRAVITY, L1, L2, L3, L4, MODULES, load_arm
from lwa4d_sim.console import shipped_scenarios
from lwa4d_sim.dh import DH_7DOF, THESIS_DH_3DOF, dh_forward
from lwa4d_sim.interfaces import Array
from lwa4d_sim.polynomials import boundary_polynomial, differentiate
from lwa4d_sim.trajectories import FourierMotion

FOREARM = L3 + L4
START = np.array([-np.pi / 2, -np.pi / 2, np.pi / 2])  # thesis, section 5.3.4
X_START = np.array([0.0, -0.397, 0.628])  # the same place, ibidem
WAYPOINTS = [[-0.5, -0.3, 0.6], [-0.5, -0.3, 0.05], [0.5, -0.4, 0.05], [0.5, -0.4, 0.6]]
M2, M3, LC2, LC3 = 4.8, 4.0, 0.164, 0.1985  # thesis, Table 5.5, with lc3 for its lc3 + lc4
COUNT = 2000


def states(seed: int) -> tuple[Array, Array]:
    """Random q in a full turn and dq up to 2 rad/s, each (COUNT, 3)."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-np.pi, np.pi, (COUNT, 3)), rng.uniform(-2, 2, (COUNT, 3))


def test_1_the_signs_of_alpha() -> None:
    """Tables 4.1 and 4.2: with every alpha +pi/2 the start is not the thesis's own Xinit and the arm folds up."""
    printed = THESIS_DH_3DOF.copy()
    printed[0, 1] = np.pi / 2
    np.testing.assert_allclose(dh_forward(THESIS_DH_3DOF, START)[:3, 3], X_START, atol=1e-12)
    assert np.linalg.norm(dh_forward(printed, START)[:3, 3] - X_START) == pytest.approx(0.656, abs=1e-9)

    printed = DH_7DOF.copy()
    printed[:6, 1] = np.pi / 2
    tall = L1 + L2 + L3 + L4
    np.testing.assert_allclose(load_arm("lwa4d_7dof").kinematics.point(np.zeros(7)), [0, 0, tall], atol=1e-12)
    np.testing.assert_allclose(dh_forward(DH_7DOF, np.zeros(7))[:3, 3], [0, 0, tall], atol=1e-12)
    np.testing.assert_allclose(dh_forward(printed, np.zeros(7))[:3, 3], [0, 0, L1 - L2 + L3 - L4], atol=1e-12)


def test_2_the_inverse_kinematics() -> None:
    """Eq. 4.5: its q2 counts from the vertical, and its root lacks a square."""
    ik = load_arm("lwa4d_3dof").kinematics.ik
    x = np.array([X_START, *WAYPOINTS])
    r, z = np.hypot(x[:, 0], x[:, 1]), x[:, 2] - L1
    c4 = (r**2 + z**2 - L2**2 - FOREARM**2) / (2 * L2 * FOREARM)

    def printed(root: Array) -> Array:
        q4 = np.arctan2(np.sqrt(root), c4)
        q2 = np.arctan2(r, z) - np.arctan2(FOREARM * np.sin(q4), L2 + FOREARM * np.cos(q4))
        return np.stack([np.arctan2(x[:, 1], x[:, 0]), q2, q4], axis=1)

    right = ik(x, elbow="up")
    np.testing.assert_allclose(printed(1 - c4**2) - right, np.broadcast_to([0, np.pi / 2, 0], (5, 3)), atol=1e-12)
    wrong = load_arm("lwa4d_3dof").kinematics.point(printed(1 - c4) - [0, np.pi / 2, 0])
    miss = np.linalg.norm(wrong - x, axis=1)
    assert miss[0] == pytest.approx(0.0, abs=1e-12), "at the start c4 = 0, where the slip does not show"
    assert miss.max() == pytest.approx(0.0175, abs=1e-4)
    assert np.abs(printed(1 - c4) - right)[:, 2].max() == pytest.approx(0.134, abs=1e-3)


def test_3_the_sign_in_g2() -> None:
    """Section 5.3.2: as printed the shoulder's gravity torque is wrong by up to 15 N m."""
    q, _ = states(3)
    c2, c24 = np.cos(q[:, 1]), np.cos(q[:, 1] + q[:, 2])
    g = load_arm("lwa4d_3dof").dynamics.g(q)
    printed = -GRAVITY * M3 * (LC3 * c24 + L2 * c2) + LC2 * GRAVITY * M2 * c2
    corrected = -GRAVITY * (M3 * (LC3 * c24 + L2 * c2) + M2 * LC2 * c2)
    np.testing.assert_allclose(corrected, g[:, 1], atol=1e-12)
    np.testing.assert_allclose(-LC3 * GRAVITY * M3 * c24, g[:, 2], atol=1e-12)
    assert (
        np.abs(printed - g[:, 1]).max()
        == pytest.approx(2 * LC2 * GRAVITY * M2, rel=1e-4)
        == pytest.approx(15.4, abs=0.1)
    )


def coriolis(q: Array, dq: Array, inertia: Array, cosine: Any) -> Array:
    """C dq as printed in section 5.3.2, (COUNT, 3).

    Args:
        q, dq: joint states.
        inertia: Ixx, Iyy, Izz of links 2 and 3 in the thesis's frames, (2, 3).
        cosine: what stands for cos(q2 + q4) in c31, a function of c24 and the matrix entry c23.
    """
    (Ixx2, Iyy2, _), (Ixx3, Iyy3, _) = inertia
    q2, q4 = q[:, 1], q[:, 2]
    dq1, dq2, dq4 = dq.T
    s22, s224, s2244 = np.sin(2 * q2), np.sin(2 * q2 + q4), np.sin(2 * (q2 + q4))
    c2, s4, s24, c24 = np.cos(q2), np.sin(q4), np.sin(q2 + q4), np.cos(q2 + q4)
    slope2 = s22 * (M3 * L2**2 + M2 * LC2**2 - Ixx2 + Iyy2) + 2 * M3 * s224 * L2 * LC3
    slope2 += s2244 * (M3 * LC3**2 - Ixx3 + Iyy3)

    def slope4(c24: Array) -> Array:
        return np.asarray(c24 * (M3 * LC3**2 - Ixx3 + Iyy3) + L2 * c2 * M3 * LC3)

    c11 = -slope2 * dq2 / 2 - dq4 * s24 * slope4(c24)
    c12, c13, c21 = -dq1 * slope2 / 2, -dq1 * s24 * slope4(c24), dq1 * slope2 / 2
    c22, c23, c32 = -L2 * LC3 * dq4 * M3 * s4, -L2 * LC3 * M3 * s4 * (dq2 + dq4), L2 * LC3 * dq2 * M3 * s4
    c31 = dq1 * s24 * slope4(cosine(c24, c23))
    rows = [c11 * dq1 + c12 * dq2 + c13 * dq4, c21 * dq1 + c22 * dq2 + c23 * dq4, c31 * dq1 + c32 * dq2]
    return np.stack(rows, axis=1)


def thesis_inertia(name: str) -> Array:
    """Ixx along the link, Iyy upwards, Izz about the pitch axis for links 2 and 3; the models have z along the link."""
    return np.array([link.inertia for link in ARMS[name].links[1:]])[:, [2, 0, 1]]


@pytest.mark.parametrize(("name", "worst"), [("lwa4d_3dof_printed", 0.8418), ("lwa4d_3dof", 1.1121)])
def test_4_the_entry_c31(name: str, worst: float) -> None:
    """Section 5.3.2: c31 holds the matrix entry c23 where a cosine of that name belongs, hence its m3 squared."""
    q, dq = states(4)
    inertia, dynamics = thesis_inertia(name), load_arm(name).dynamics
    truth = dynamics.h(q, dq) - dynamics.g(q)
    np.testing.assert_allclose(coriolis(q, dq, inertia, lambda cosine, entry: cosine), truth, atol=1e-12)
    wrong = coriolis(q, dq, inertia, lambda cosine, entry: entry) - truth
    np.testing.assert_allclose(wrong[:, :2], 0.0, atol=1e-12)
    assert 0.7 * worst < np.abs(wrong).max() < worst

    # the same entry letter by letter as printed
    (Ixx3, Iyy3), q2, q4 = inertia[1, :2], q[:, 1], q[:, 2]
    K = L2 * LC3 * M3 * np.sin(q4) * (dq[:, 1] + dq[:, 2])
    letters = L2 * LC3 * np.cos(q2) * M3 - LC3**2 * M3 * K + Ixx3 * K - Iyy3 * K
    c32 = L2 * LC3 * dq[:, 1] * M3 * np.sin(q4)
    printed = dq[:, 0] ** 2 * np.sin(q2 + q4) * letters + c32 * dq[:, 1]
    np.testing.assert_allclose(wrong[:, 2], printed - truth[:, 2], atol=1e-12)


def test_5_the_frame_of_the_inertias() -> None:
    """Table 5.5 has Izz along the cylinder, the equations use it about the joint axis: the elbow is 24 % too light."""
    table = np.array([[0.0465, 0.0465, 0.0070], [0.0545, 0.0545, 0.0039]])  # Ixx, Iyy, Izz
    np.testing.assert_allclose(thesis_inertia("lwa4d_3dof_printed"), table, atol=5e-5)
    np.testing.assert_allclose(thesis_inertia("lwa4d_3dof"), table[:, [2, 1, 0]], atol=5e-5)
    physical, printed = (load_arm(name).dynamics.M(START) for name in ("lwa4d_3dof", "lwa4d_3dof_printed"))
    assert printed[2, 2] == pytest.approx(M3 * LC3**2 + 0.0039, abs=5e-5)
    assert physical[2, 2] == pytest.approx(M3 * LC3**2 + 0.0545, abs=5e-5)
    assert 1 - printed[2, 2] / physical[2, 2] == pytest.approx(0.24, abs=0.002)


def test_6_the_mass_of_link_3() -> None:
    """Section 5.3.1: the formula names ERB 115 once and gives 3.1 kg; the table's 4.0 kg counts both its axes."""
    prl100, prl80, erb115 = MODULES[3].mass, MODULES[4].mass, MODULES[5].mass
    assert prl100 / 2 + prl80 + erb115 == pytest.approx(3.1)
    assert prl100 / 2 + prl80 + 2 * erb115 == pytest.approx(4.0)
    assert ARMS["lwa4d_3dof"].links[2].mass == pytest.approx(4.0)
    everything = sum(module.mass for module in MODULES)
    assert sum(link.mass for link in ARMS["lwa4d_3dof"].links) == pytest.approx(everything) == pytest.approx(14.2)


def test_7_the_damping_gain() -> None:
    """Eq. 5.6: KD = 53 p, the lost fraction bar, barely moves the ideal arm and shakes it at once under the bus."""
    one_segment = {"trajectory.waypoints.points": WAYPOINTS[:1]}
    found = {}
    for name, kd in (("fraction", 5 / 3 * 1.25), ("printed", 53 * 1.25)):
        file = shipped_scenarios() / "pd_joint_p1.25.yaml"
        scenario = Scenario.load(file, {"controller.kd": kd, **one_segment})
        found[name] = {variant: run(scenario, variant).metrics() for variant in ("ideal", "can")}
    distance = np.linalg.norm(WAYPOINTS[0] - X_START)
    assert found["fraction"]["ideal"]["final_error"][0] < 0.05 * distance
    assert found["fraction"]["can"]["stable"]
    # a time constant of 53 s: exp(-5 / 53) = 0.91 of the way is left
    assert found["printed"]["ideal"]["final_error"][0] > 0.9 * distance
    assert not found["printed"]["can"]["stable"]
    assert found["printed"]["can"]["unstable_since"] < 0.1


def test_8_the_order_of_the_polynomial() -> None:
    """Eq. 4.24-4.26: powers ascend in the matrix and descend in the derivatives; the vector of 4.25 is upside down."""
    T, start, end = 2.0, np.array([0.3, 0.0, 0.0]), np.array([1.1, 0.0, 0.0])  # position, speed, acceleration
    powers = np.arange(6)
    matrix = np.zeros((6, 6))
    for row, t in ((0, 0.0), (3, T)):
        for derivative in range(3):
            factors = np.prod([powers - i for i in range(derivative)], axis=0) if derivative else np.ones(6)
            matrix[row + derivative] = factors * t ** np.maximum(powers - derivative, 0)
    right = boundary_polynomial(T, start, end)
    np.testing.assert_allclose(np.linalg.solve(matrix, [*start, *end]), right, atol=1e-12)
    speed_at_end = np.polynomial.polynomial.polyval(T, differentiate(right))
    assert speed_at_end == pytest.approx(0.0, abs=1e-12)

    def printed_speed(a: Array) -> float:  # eq. 4.26
        return float(5 * a[0] * T**4 + 4 * a[1] * T**3 + 3 * a[2] * T**2 + 2 * a[3] * T + a[4])

    literal = np.linalg.solve(matrix, [*end[::-1], *start[::-1]])  # eq. 4.25
    for coefficients in (right, literal):
        assert abs(printed_speed(coefficients)) > 1.0  # [rad/s] instead of rest
    assert printed_speed(right[::-1]) == pytest.approx(0.0, abs=1e-12)


def test_9_the_base_frequency() -> None:
    """Section 5.1.3, "omega = 1 [Hz]": 2 pi rad/s instead of 1 makes 2 pi times the acceleration."""
    a = ((0.156, -0.478, 0.078, -0.388, -0.070), (0.064, -0.335, 0.451, 0.292, 1.046))
    b = ((0.088, 0.253, -0.207, 0.549, 0.150), (-0.125, 0.292, -0.369, 0.557, 0.964))
    arm = load_arm("lwa4d_planar")
    assert FourierMotion(a=a, b=b, duration=1.0).omega == 1.0
    peaks = []
    for omega in (1.0, 2 * np.pi):
        motion = FourierMotion(a=a, b=b, omega=omega, duration=2 * np.pi / omega).build(arm.kinematics, np.zeros(2))
        ref = motion.joint(np.linspace(0, 2 * np.pi / omega, 2001))
        peaks.append([np.ptp(ref.q[:, 1]), np.abs(ref.dq[:, 1]).max(), np.abs(ref.ddq[:, 1]).max()])
    np.testing.assert_allclose(peaks[0], [1.228, 2.076, 9.69], rtol=1e-3)
    np.testing.assert_allclose(np.divide(peaks[1], peaks[0]), [1 / (2 * np.pi), 1.0, 2 * np.pi], rtol=1e-6)


def test_10_the_regressor() -> None:
    """Eq. 5.3: y25 = 0 loses the elbow's whole gravity torque, 7.8 N m; cos(q2 + q4) is right."""
    rng = np.random.default_rng(10)
    q, dq, ddq = rng.uniform(-2, 2, (3, COUNT, 2))
    dynamics = load_arm("lwa4d_planar").dynamics
    tau = np.einsum("kij,kj->ki", dynamics.M(q), ddq) + dynamics.h(q, dq)
    Izz1, Izz2 = thesis_inertia("lwa4d_3dof_printed")[:, 2]
    m1, m2 = M2, M3  # the planar arm's links 1 and 2
    p = [
        m1 * LC2**2 + m2 * L2**2 + Izz1,
        m2 * LC3**2 + Izz2,
        m2 * L2 * LC3,
        GRAVITY * (m1 * LC2 + m2 * L2),
        GRAVITY * m2 * LC3,
    ]
    c4, s4, c24 = np.cos(q[:, 1]), np.sin(q[:, 1]), np.cos(q.sum(axis=1))
    zero = np.zeros(COUNT)
    common = [zero, ddq.sum(axis=1), c4 * ddq[:, 0] + s4 * dq[:, 0] ** 2, zero]
    printed, corrected = (np.stack([*common, y25], axis=1) @ p for y25 in (zero, c24))
    np.testing.assert_allclose(corrected, tau[:, 1], atol=1e-12)
    assert np.abs(printed - tau[:, 1]).max() == pytest.approx(7.79, abs=0.01)


def test_11_the_estimates() -> None:
    """Section 5.1.4: up to 14 % off without any noise; what plausible mistakes make of the same run, in per cent."""
    real = np.array([0.56644, 0.16151, 0.26043, 20.5931, 7.78914])
    estimated = np.array([0.54630, 0.14777, 0.29674, 20.4553, 7.95738])
    np.testing.assert_allclose(100 * (estimated / real - 1), [-3.6, -8.5, 13.9, -0.7, 2.2], atol=0.05)

    log = run(Scenario.load(shipped_scenarios() / "identify_planar.yaml"))
    h, q, dq, tau = log.timestep / 1e9, log.q[:-1], log.dq[:-1], log.tau[:-1]
    ddq = np.gradient(dq, h, axis=0)

    def error(q: Array, dq: Array, ddq: Array, tau: Array, y25: float = 1.0) -> Array:
        """Of a fit of eq. 5.2 [%]."""
        c2, c4, s4, c24 = np.cos(q[:, 0]), np.cos(q[:, 1]), np.sin(q[:, 1]), np.cos(q.sum(axis=1))
        (d2, d4), (a2, a4), zero = dq.T, ddq.T, np.zeros(len(q))
        rows: list[Any] = [
            [a2, a2 + a4, 2 * c4 * a2 + c4 * a4 - 2 * s4 * d2 * d4 - s4 * d4**2, c2, c24],
            [zero, a2 + a4, c4 * a2 + s4 * d2**2, zero, y25 * c24],
        ]
        Y = np.stack([np.stack(row, axis=-1) for row in rows], axis=1)
        return np.asarray(100 * (np.linalg.lstsq(Y.reshape(-1, 5), tau.ravel(), rcond=None)[0] / real - 1))

    def filtered(x: Array) -> Array:
        """Derivative by the thesis's s / (1 + T s)^2, T = 10 ms."""
        return np.asarray(lfilter(*bilinear([1, 0], [1e-4, 0.02, 1], 1 / h), x - x[0], axis=0))

    Q, TAU = q[::10], tau[::10]
    speed = filtered(q)
    found = {
        "differences": error(Q[2:], np.diff(Q, axis=0)[1:] / 0.01, np.diff(Q, 2, axis=0) / 1e-4, TAU[2:]),
        "filter": error(q, speed, filtered(speed), tau),
        "late": error(q[:-5], dq[:-5], ddq[:-5], tau[5:]),
        "y25": error(q, dq, ddq, tau, y25=0.0),
    }
    table = {
        "differences": [-12.2, -19.8, 15.5, 0.6, -1.5],
        "filter": [-15.4, -34.1, 20.0, 1.2, -3.8],
        "late": [-9.6, -14.2, 11.6, 0.3, -0.8],
        "y25": [-18.0, -62.9, 11.5, 6.6, -22.5],
    }
    for what, row in table.items():
        np.testing.assert_allclose(found[what], row, atol=0.1, err_msg=what)
        assert np.abs(found[what]).max() > 9.0


def test_what_is_lost_was_decided_once() -> None:
    """The fourth waypoint closes the rectangle and is the same in every scenario that goes through waypoints."""
    assert WAYPOINTS[3] == [*WAYPOINTS[2][:2], WAYPOINTS[0][2]]
    for file in sorted(shipped_scenarios().glob("*.yaml")):
        trajectory = Scenario.load(file).document["trajectory"]
        if trajectory["kind"] == "waypoints":
            assert trajectory["waypoints"]["points"] == WAYPOINTS, file
