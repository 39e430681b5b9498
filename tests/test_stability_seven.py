"""Seven joints under the bus: which motion limits the gains, and why rotor inertia matters."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from stability_rig import PERIOD, RATIO
from test_docs import VALIDATION, table
from test_thesis import SCENARIOS

from lwa4d_sim.dynamics import NominalModel
from lwa4d_sim.interfaces import Array
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.study import Study

ROTORS: dict[str, dict[str, Any]] = {
    "none": {},
    "known": {"plant.armature": "lwa4d", "controller.model.armature": "lwa4d"},
    "unknown": {"plant.armature": "lwa4d"},
}
ACTUATIONS = ["immediate", "next_sync"]
ROWS = table(VALIDATION, "seven joints")


def seven(name: str, rotors: str, actuation: str, **changes: Any) -> Study:
    """A shipped scenario with or without rotors."""
    file = next(file for file in SCENARIOS if file.stem == name)
    return Study(Scenario.load(file, {"loop.actuation": actuation, **ROTORS[rotors], **changes}), "can")


@cache
def one_gain(rotors: str, actuation: str) -> tuple[Study, Any]:
    """PD with the same gains at every joint, kp = 1, and its loop."""
    study = seven("pd7_one_gain", rotors, actuation, **{"controller.kp": 1.0, "controller.kd": RATIO})
    return study, study.close(study.linear(study.waypoints()))


def window(rotors: str, actuation: str, row: int) -> tuple[float, float] | None:
    """Least and largest gain between which one gain for all joints is stable; None if none is."""
    _, loop = one_gain(rotors, actuation)
    at = np.array([row])

    def excess(log_p: float) -> float:
        return float(loop.radius(at, np.exp([log_p]))[0]) - 1.0 - 1e-12

    grid = np.linspace(np.log(1e-4), np.log(30), 500)
    radii = loop.radius(np.full(500, row), np.exp(grid)) - 1.0 - 1e-12
    stable = np.flatnonzero(radii < 0)
    if not stable.size:
        return None
    low = 0.0 if stable[0] == 0 else np.exp(brentq(excess, grid[stable[0] - 1], grid[stable[0]]))
    return float(low), float(np.exp(brentq(excess, grid[stable[-1]], grid[stable[-1] + 1])))


@cache
def pole_limit(rotors: str, actuation: str) -> Array:
    """Largest p of computed torque with kp = p^2, kd = 2 p, at each waypoint."""

    def radius(p: float) -> Array:
        study = seven("ct7_joint", rotors, actuation, **{"controller.p": p})
        loop = study.close(study.linear(study.waypoints()))
        found: Array = loop.radius(np.arange(4), np.ones(4))
        return found

    low, high = np.full(4, 10.0), np.full(4, 100.0)
    for i in range(4):
        a, b = float(low[i]), float(high[i])
        while b - a > 2e-3:
            c = 0.5 * (a + b)
            values = radius(c)
            for j in range(i, 4):  # what one pose is asked tells the others something, too
                if values[j] > 1:
                    high[j] = min(high[j], c)
                else:
                    low[j] = max(low[j], c)
            a, b = float(low[i]), float(high[i])
    middle: Array = 0.5 * (low + high)
    return middle


def damping_edge(late: int, ratio: float) -> float:
    """kd T / J at the limit of one joint with the filter's time constant T, kd = ratio kp J: see stability.md."""
    T, a = PERIOD, np.exp(-1.0)

    def kp(angle: float) -> complex:
        z = np.exp(1j * angle)
        Q = T**2 / 2 * (z + 1) / (z - 1) ** 2
        V = T / (z - 1) - 2 * T + (z - 1) * (T * a / (z - a) ** 2 + 2 * T / (z - a))
        return complex(-(z**late) / (Q + ratio * V))

    angles = np.linspace(0.05, np.pi - 0.01, 400)
    values = np.array([kp(angle) for angle in angles])
    at = [
        brentq(lambda x: kp(x).imag, angles[i], angles[i + 1])
        for i in np.flatnonzero(values.imag[1:] * values.imag[:-1] < 0)
    ]
    return float(min(kp(x).real for x in at if kp(x).real > 0)) * ratio * T


@pytest.mark.parametrize("row", ROWS, ids=lambda row: " ".join(row[:3]))
def test_the_table_of_seven_joints(row: list[str]) -> None:
    law, rotors, actuation, *cells = row
    if law.startswith("one gain"):
        found = [window(rotors, actuation, i) for i in range(4)]
        shown = ["none" if one is None else f"{one[0]:.3g} to {one[1]:.3g}" for one in found]
    elif law.startswith("`pd7_joint`"):
        study = seven("pd7_joint", rotors, actuation)
        shown = [f"{x:.2f}" for x in study.gain_margin(study.close(study.linear(study.waypoints())))]
    else:
        shown = [f"{p:.1f}" for p in pole_limit(rotors, actuation)]
    assert cells == shown


@pytest.mark.parametrize("actuation", ACTUATIONS)
@pytest.mark.parametrize("rotors", ["none", "known"])
def test_one_gain_is_limited_by_the_smallest_eigenvalue_of_the_inertia(rotors: str, actuation: str) -> None:
    """Equal gains leave M's eigenvectors alone: each is a joint of its own, and the lightest shakes first."""
    edge = damping_edge(int(actuation == "next_sync"), RATIO)
    assert edge == pytest.approx({"immediate": 1.044, "next_sync": 0.560}[actuation], abs=5e-4)
    study, loop = one_gain(rotors, actuation)
    model = NominalModel(study.blocks.model)
    for i, q in enumerate(study.waypoints().q):
        stable = window(rotors, actuation, i)
        if stable is None:
            continue
        M = model.at(q[None]).M[0]
        lightest, vectors = np.linalg.eigh(M)
        assert RATIO * stable[1] * PERIOD / lightest[0] == pytest.approx(edge, rel=1e-3)
        mode = study.mode(loop, i, stable[1])
        np.testing.assert_allclose(mode.share, np.abs(vectors[:, 0]) / np.abs(vectors[:, 0]).max(), atol=0.02)
        assert np.argmax(mode.share) == {"none": 6, "known": 5}[rotors]


@pytest.mark.parametrize("actuation", ACTUATIONS)
@pytest.mark.parametrize("rotors", ["none", "known"])
def test_gains_of_each_joint_are_limited_by_the_fastest_damping(rotors: str, actuation: str) -> None:
    """T times the largest eigenvalue of M^-1 Kd says it, and which joint leads."""
    study = seven("pd7_joint", rotors, actuation)
    loop = study.close(study.linear(study.waypoints()))
    margin = study.gain_margin(loop)
    law: Any = study.settings.controller
    model = NominalModel(study.blocks.model)
    for i, q in enumerate(study.waypoints().q):
        fastest = np.linalg.eigvals(np.linalg.solve(model.at(q[None]).M[0], np.diag(law.kd))).real.max()
        expected = {"immediate": 1.01, "next_sync": 0.546}[actuation]
        assert PERIOD * margin[i] * fastest == pytest.approx(expected, abs=0.007)
        assert np.argmax(study.mode(loop, i, margin[i]).share) == {"none": 2, "known": 1}[rotors]


@pytest.mark.parametrize("actuation", ACTUATIONS)
def test_computed_torque_has_one_limit_for_all_joints(actuation: str) -> None:
    """It divides by the inertia, so a joint of 1 kg m^2 tells the limit; gravity moves it by a percent."""
    late = int(actuation == "next_sync")
    p = brentq(lambda p: damping_edge(late, 2 / p) - 2 * p * PERIOD, 10, 60)
    for rotors in ("none", "known"):
        np.testing.assert_allclose(pole_limit(rotors, actuation), p, rtol=0.012)
