"""Late, later, and late by turns: margins of delay and jitter against simulation."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from stability_rig import PERIOD, apart, compare, growth, limits, margins, pd, predicted, simulated

from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability.study import Study

FINE = 0.001  # [s] plant step where latencies of a millisecond are told apart

LOOPS: dict[str, dict[str, Any]] = {
    "measurement": {"loop.latency": {"measurement": 0.005}},
    "both": {"loop.latency": {"measurement": 0.0025, "command": 0.005}},
    "longer than a period": {"loop.latency": {"measurement": 0.0125, "command": 0.0025}},
    "three periods": {"loop.latency": {"measurement": 0.0225, "command": 0.0125}},
    "command of a period": {"loop.latency": {"command": 0.01}},
    "phase": {"loop.latency": {"command": 0.0025}, "loop.phase": 0.005},
    "phase too early": {"loop.latency": {"measurement": 0.005}, "loop.phase": 0.0025},
}


@pytest.mark.parametrize("actuation", ["immediate", "next_sync"])
@pytest.mark.parametrize("name", list(LOOPS))
def test_limits_under_latency(name: str, actuation: str) -> None:
    limit = compare(limits("lwa4d_3dof", pd("joint", 0.5), actuation=actuation, changes=LOOPS[name]))
    np.testing.assert_allclose(limit, 1.0, atol=2e-3)


@pytest.mark.parametrize(
    "velocity",
    [
        {"kind": "true"},
        {"kind": "backward_difference"},
        {"kind": "tustin", "time_constant": 0.02},
        {"kind": "kalman", "acceleration": 50.0, "position": 1e-3},
    ],
    ids=lambda velocity: velocity["kind"],
)
@pytest.mark.parametrize("latency", [0.0, 0.005])
def test_limits_with_other_estimators(velocity: dict[str, Any], latency: float) -> None:
    changes = {"loop.velocity": velocity, "loop.latency": latency}
    compare(limits("lwa4d_3dof", pd("joint", 0.5), changes=changes))


@pytest.mark.parametrize(
    "latency",
    [
        {"command": [0.0, 0.005, 0.0075]},
        {"command": [0.0, 0.0125, 0.0025]},
        {"measurement": [0.0, 0.0025, 0.0125], "command": [0.0025, 0.0, 0.005]},
    ],
    ids=str,
)
def test_limits_with_latencies_of_each_joint(latency: dict[str, list[float]]) -> None:
    """The brakes open when the last joint has its command, so here only the growth is compared."""
    study = limits("lwa4d_3dof", pd("joint", 0.5), changes={"loop.latency": latency})
    margin = margins(study)
    rows = [0, 1, 2, 3]
    calm = [growth(one) for one in simulated(study, rows, (0.97 * margin).tolist())]
    grown = [growth(one) for one in simulated(study, rows, (1.03 * margin).tolist())]
    loop = study.close(study.linear(study.waypoints()))
    assert max(calm) < 1 < min(grown)
    np.testing.assert_allclose(grown, loop.radius(np.arange(4), 1.03 * margin), atol=2e-4)


@pytest.mark.parametrize("p", [0.8, 1.25])
@pytest.mark.parametrize("runs_on", ["continuous", "held"])
def test_delay_margin_in_simulation(runs_on: str, p: float) -> None:
    """A millisecond below the margin the arm calms down, a millisecond above it shakes, tick by tick as computed."""
    study = limits("lwa4d_3dof", pd("joint", p), runs_on=runs_on, changes={"plant.timestep": FINE})
    linear = study.linear(study.waypoints())
    steps = np.rint(study.delay_margin(linear) / FINE)
    assert (steps > 1).all()
    for latency, grows in ((steps - 1) * FINE, False), ((steps + 1) * FINE, True):
        found = simulated(study, [0, 1, 2, 3], [1.0] * 4, [{"loop.latency": x} for x in latency.tolist()])
        for i, extra in enumerate(latency.tolist()):
            assert apart(found[i : i + 1], predicted(study, [i], [1.0], extra)) < 1e-3
            loop = study.close(linear, extra)
            assert (loop.radius(np.array([i]), np.ones(1))[0] > 1) == grows
            if study.mode(loop, i).frequency > 1:  # a slower one is none that `growth` sees
                assert (growth(found[i]) > 1) == grows


def test_delay_margin_at_the_next_sync_is_what_the_wait_forgives() -> None:
    """A command in time for its SYNC is not late; where one period more is too much, that is the margin."""
    changes = {"plant.timestep": FINE, "loop.latency": 0.003}
    study = limits("lwa4d_3dof", pd("joint", 1.6), actuation="next_sync", changes=changes)
    margin = study.delay_margin(study.linear(study.waypoints()))[3]
    assert margin == pytest.approx(PERIOD - 0.003, abs=1e-6)
    calm, late = simulated(study, [3, 3], [1.0, 1.0], [{"loop.latency": 0.009}, {"loop.latency": 0.011}])
    assert growth(calm) < 1 < growth(late)


# Jitter ---------------------------------------------------------------------------------------------------------------


def jittery(p: float, changes: dict[str, Any] | None = None, actuation: str = "immediate") -> tuple[Study, Array]:
    """A loop and its jitter margin at the waypoints."""
    study = limits(
        "lwa4d_3dof", pd("joint", p), actuation=actuation, changes={"plant.timestep": FINE, **(changes or {})}
    )
    return study, study.jitter_margin(study.linear(study.waypoints()))


def radius_of(matrices: list[Array], word: tuple[int, ...]) -> float:
    """Growth over one round of a sequence of delays."""
    product = np.linalg.multi_dot([matrices[i] for i in word] * 2)
    return float(np.abs(np.linalg.eigvals(product)).max() ** (0.5 / len(word)))


@pytest.mark.parametrize("p", [0.5, 1.25, 2.5])
def test_jitter_margin_is_a_share_of_the_delay_margin(p: float) -> None:
    """Any delay held constant is one way to vary, so the margin is less; far less would say nothing."""
    study, margin = jittery(p)
    delay = study.delay_margin(study.linear(study.waypoints()))
    assert (margin < delay).all()
    assert (margin > 0.1 * delay).all()


@pytest.mark.parametrize(("p", "velocity"), [(2.5, "filtered_derivative"), (2.8, "filtered_derivative"), (8, "true")])
def test_no_switching_within_the_jitter_margin_is_unstable(p: float, velocity: str) -> None:
    """Every sequence of up to seven delays, none, half or all of the margin, that goes on for ever."""
    study, margin = jittery(p, {"loop.velocity": {"kind": velocity}})
    linear = study.linear(study.waypoints())
    rows = np.flatnonzero((margin > 0) & (margin < PERIOD))  # one waiting command tells the whole state
    assert rows.size
    for i in rows:
        matrices = [study.close(linear, extra).at_gain()[i] for extra in (1e-7, 0.5 * margin[i], margin[i])]
        words = [word for length in range(1, 8) for word in product(range(3) if length < 6 else (0, 2), repeat=length)]
        assert max(radius_of(matrices, word) for word in words) < 1.0


def test_changing_delays_may_shake_what_bears_each_of_them() -> None:
    """Why there is a margin for jitter beside that for delay: 6 ms by turns with none, true speed, waypoint 2."""
    study, margin = jittery(8.0, {"loop.velocity": {"kind": "true"}})
    linear = study.linear(study.waypoints())
    row, late = 1, 0.006
    assert margin[row] < late < study.delay_margin(linear)[row]
    matrices = [study.close(linear, extra).at_gain()[row] for extra in (1e-7, late)]
    assert max(radius_of(matrices, (0,)), radius_of(matrices, (1,))) < 1 < radius_of(matrices, (0, 1))
    traces = [[0.0], [late], [0.0, late]]
    changes = [{"loop.latency": {"kind": "trace", "values": values}, "loop.phase": 0.0} for values in traces]
    prompt, steady, by_turns = np.abs(simulated(study, [row] * 3, [1.0] * 3, changes)).max(axis=2)
    for calm in (prompt, steady):
        assert calm[-100:].max() < 0.5 * calm[:100].max()
    assert by_turns[-100:].max() > 100 * by_turns[:10].max()


PATTERNS = ([0, 1], [0, 0, 1, 1], [0, 0, 0, 1], [1, 1, 1, 0], [0, 0.25, 0.5, 0.75, 1])


def fades(motion: Array) -> bool:
    """Whether a motion (ticks, 2n) dies out: its last quarter is smaller than its second."""
    _, second, _, last = np.abs(motion).max(axis=1).reshape(4, -1)
    return bool(last.max() < 0.8 * second.max())


@pytest.mark.parametrize("p", [0.3, 1.25])
def test_jitter_up_to_the_margin_does_no_harm_in_simulation(p: float) -> None:
    """Commands late by patterns and by chance, by up to nearly three periods."""
    study, margin = jittery(p)
    rows: list[int] = []
    changes: list[dict[str, Any]] = []
    for i, most in enumerate((np.floor(margin / FINE) * FINE).tolist()):
        traces = [[most * share for share in pattern] for pattern in PATTERNS]
        changes += [{"loop.latency": {"kind": "trace", "values": values}} for values in traces]
        changes.append({"loop.jitter": most})
        rows += [i] * (len(PATTERNS) + 1)
    assert all(fades(one) for one in simulated(study, rows, [1.0] * len(rows), changes))


def test_jitter_of_each_joint_on_its_own() -> None:
    study, margin = jittery(1.25, {"loop.per_joint": True})
    together = jittery(1.25)[1]
    assert (margin < together * (1 + 1e-9)).all(), "more may happen, so less is allowed"
    changes = [{"loop.jitter": float(most), "plant.seed": seed} for most in margin for seed in range(3)]
    rows = np.repeat(np.arange(4), 3).tolist()
    assert all(fades(one) for one in simulated(study, rows, [1.0] * len(rows), changes))


def test_jitter_that_the_sync_forgives_changes_no_bit() -> None:
    """Below the wait for the SYNC the margin counts the wait itself; so late commands act when they would anyway."""
    study, margin = jittery(1.6, {"loop.latency": 0.003}, "next_sync")
    slack = PERIOD - 0.003
    assert (margin >= slack * (1 - 1e-6)).all()
    assert margin[3] == pytest.approx(slack, abs=1e-6)
    plain, shaken = simulated(study, [3, 3], [1.0, 1.0], [{}, {"loop.jitter": 0.0069}])
    np.testing.assert_array_equal(plain, shaken)
