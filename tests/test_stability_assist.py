"""Compensation blocks in the analysis: the limits that predictor, observers, schedule and damping limit move."""

from typing import Any

import numpy as np
import pytest
from stability_rig import NUDGE, PERIOD, limits, margins, pd, simulated

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability.assist import Forecast

OBSERVER: dict[str, Any] = {"loop.velocity": {"kind": "observer"}}
PREDICTOR: dict[str, Any] = {"compensation.predictor": {}}
BLOCKS: dict[str, dict[str, Any]] = {
    "observer": OBSERVER,
    "predictor": PREDICTOR,
    "predictor, observer": {**PREDICTOR, **OBSERVER},
    "predictor with a horizon": {"compensation.predictor": {"horizon": 0.014}},
    "disturbance observer": {"compensation.disturbance_observer": {"bandwidth": 20}},
    "all": {**PREDICTOR, **OBSERVER, "compensation.disturbance_observer": {"bandwidth": 20}},
    "schedule diagonal": {"controller.schedule": "diagonal"},
    "schedule inertia": {"controller.schedule": "inertia"},
    "damping limit": {"controller.damping_limit": 0.5},
    "wrong belief": {**PREDICTOR, **OBSERVER, "controller.model.mass_scale": 0.8, "plant.gravity": [0, 0, 0],
                     "controller.model.gravity": [0, 0, 0]},
}  # fmt: skip
LATE: dict[str, dict[str, Any]] = {
    "immediate": {"loop.actuation": "immediate"},
    "next_sync": {"loop.actuation": "next_sync"},
    "commands 5 ms late": {"loop.actuation": "immediate", "loop.latency": 0.005},
    "samples 15 ms late": {"loop.actuation": "immediate", "loop.latency": {"measurement": 0.015, "command": 0.0}},
}


def confirmed(changes: dict[str, Any], arm: str = "lwa4d_3dof") -> Array:
    """Limits (4,) of the analysis; 3 % below and above each, a simulated disturbance dies out and grows."""
    study = limits(arm, pd("joint", 1.0), changes=changes)
    margin = margins(study)
    assert np.isfinite(margin).all()
    runs = simulated(study, [0, 1, 2, 3] * 2, np.concatenate([0.97 * margin, 1.03 * margin]).tolist())
    rates = np.array([shaking(run) for run in runs])
    assert (rates[:4] < 1).all(), rates
    assert (rates[4:] > 1).all(), rates
    return margin


def shaking(motion: Array) -> float:
    """Growth of what is fast in a motion (ticks, 2n), from one window of a second to one two seconds later.

    Fourth differences leave 1e-9 of a motion that dies out by 0.6 % a period, as the slow ones do. A motion that has
    grown a thousandfold is not linear any more and may be held by the torque limits.
    """
    if np.abs(motion).max() > 1000 * NUDGE:
        return np.inf
    fast = np.diff(motion, n=4, axis=0)
    early, late = (np.sqrt(np.mean(fast[-100 - shift :][:100] ** 2)) for shift in (200, 0))
    return float(late / early)


@pytest.mark.slow
@pytest.mark.parametrize("late", LATE)
@pytest.mark.parametrize("blocks", BLOCKS)
def test_limits_with_blocks_are_those_of_the_simulation(blocks: str, late: str) -> None:
    confirmed({**LATE[late], **BLOCKS[blocks]})


@pytest.mark.parametrize("arm", ["lwa4d_3dof_printed", "lwa4d_3dof"])
def test_what_each_block_gives_back(arm: str) -> None:
    """At the next SYNC; predictor and observer together bear more than the thesis's loop without any delay."""
    found = {name: confirmed({**LATE["next_sync"], **BLOCKS[name]}, arm) for name in list(BLOCKS)[:3]}
    bare = confirmed(LATE["next_sync"], arm)
    thesis = confirmed(LATE["immediate"], arm)
    assert (found["observer"] > 1.7 * bare).all()
    assert (found["predictor"] > 1.7 * bare).all()
    assert (found["predictor, observer"] > 3.5 * bare).all()
    assert (found["predictor, observer"] > 1.9 * thesis).all()


def test_a_predictor_with_the_exact_model_is_a_loop_without_delay() -> None:
    """It makes up for the delay but not for the lag of the filter; with the true speed nothing is left."""
    true: dict[str, Any] = {"loop.velocity": {"kind": "true"}}
    late = limits("lwa4d_3dof", pd("joint", 1.0), changes={**true, **LATE["next_sync"], **PREDICTOR})
    here = limits("lwa4d_3dof", pd("joint", 1.0), changes={**true, **LATE["immediate"]})
    np.testing.assert_allclose(margins(late), margins(here), rtol=1e-6)


def test_a_block_that_cannot_know_when_torques_act_is_refused() -> None:
    changes = {"loop": {"kind": "canopen", "actuation": "immediate", "velocity": {"kind": "observer"}}}
    study = limits("lwa4d_3dof", pd("joint", 1.0), changes=changes)
    with pytest.raises(ScenarioError, match="has no linear model where each command acts when it arrives"):
        margins(study)


@pytest.mark.parametrize("acts", [[0.0, 0.0], [0.004, 0.013], [0.01, 0.01]])
def test_weights_of_commands_add_up(acts: list[float]) -> None:
    """Equal commands are one constant torque, and every instant belongs to one command."""
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(1, 4, 4)), rng.normal(size=(1, 4, 2))
    forecast = Forecast(A, B, np.array(acts), PERIOD)
    for start, end in ((-0.02, -0.01), (-0.013, 0.007), (0.0, 0.003)):
        np.testing.assert_allclose(sum(forecast.commands(start, end)), forecast.constant(end - start), atol=1e-13)
        np.testing.assert_allclose(sum(forecast.shares(start, end)), 1.0, atol=1e-12)
