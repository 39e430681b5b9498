"""What compensation blocks give back, in the analysis and in simulation; the parts of their linear model."""

from typing import Any

import numpy as np
import pytest
from stability_rig import NUDGE, PERIOD, limits, margins, pd, simulated
from test_docs import ROOT, table

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability.assist import Forecast

OBSERVER: dict[str, Any] = {"loop.velocity": {"kind": "observer"}}
PREDICTOR: dict[str, Any] = {"compensation.predictor": {}}
IMMEDIATE: dict[str, Any] = {"loop.actuation": "immediate"}
NEXT_SYNC: dict[str, Any] = {"loop.actuation": "next_sync"}
BOTH: dict[str, Any] = {**PREDICTOR, **OBSERVER}
BLOCKS: dict[str, dict[str, Any]] = {
    "disturbance observer": {"compensation.disturbance_observer": {"bandwidth": 20}},
    "all": {**PREDICTOR, **OBSERVER, "compensation.disturbance_observer": {"bandwidth": 20}},
    "schedule diagonal": {"controller.schedule": "diagonal"},
    "schedule inertia": {"controller.schedule": "inertia"},
    "damping limit": {"controller.damping_limit": 0.5},
    # without gravity, whose wrong compensation would move the arm away
    "wrong belief": {
        **PREDICTOR,
        **OBSERVER,
        "controller.model.mass_scale": 0.8,
        "plant.gravity": [0, 0, 0],
        "controller.model.gravity": [0, 0, 0],
    },
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


@pytest.mark.parametrize("arm", ["lwa4d_3dof_printed", "lwa4d_3dof"])
def test_what_each_block_gives_back(arm: str) -> None:
    """At the next SYNC; predictor and observer together bear more than the thesis's loop without any delay."""
    bare, thesis = confirmed(NEXT_SYNC, arm), confirmed(IMMEDIATE, arm)
    observer, predictor, both = (confirmed({**NEXT_SYNC, **one}, arm) for one in (OBSERVER, PREDICTOR, BOTH))
    assert (observer > 1.7 * bare).all()
    assert (predictor > 1.7 * bare).all()
    assert (both > 3.5 * bare).all()
    assert (both > 1.9 * thesis).all()


@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_a_wrong_belief_moves_the_limit_as_the_analysis_says(scale: float) -> None:
    changes = {**NEXT_SYNC, **BLOCKS["wrong belief"]}
    wrong, right = (confirmed({**changes, "controller.model.mass_scale": factor}) for factor in (scale, 1.0))
    assert (wrong < right).all() if scale < 1 else (wrong > right).all()


PAGE: dict[str, dict[str, Any]] = {
    "none, but `actuation: immediate` (the thesis's loop)": IMMEDIATE,
    "none": {},
    "none, true speed": {"loop.velocity": {"kind": "true"}},
    "observer": OBSERVER,
    "predictor": PREDICTOR,
    "predictor and observer": BOTH,
    "the same, `horizon` T/2 longer": {**OBSERVER, "compensation.predictor": {"horizon": 1.5 * PERIOD}},
    "the same, model with masses times 0.8": BLOCKS["wrong belief"],
    "the same, model with masses times 1.2": {**BLOCKS["wrong belief"], "controller.model.mass_scale": 1.2},
    "disturbance observer, 20 rad/s": BLOCKS["disturbance observer"],
    "the same, predictor and observer": BLOCKS["all"],
    "`damping_limit: 0.5`": BLOCKS["damping limit"],
    "limit, predictor and observer": {**BLOCKS["damping limit"], **BOTH},
    "`schedule: diagonal`": BLOCKS["schedule diagonal"],
    "diagonal, predictor and observer": {**BLOCKS["schedule diagonal"], **BOTH},
    "`schedule: inertia`": BLOCKS["schedule inertia"],
    "inertia, predictor and observer": {**BLOCKS["schedule inertia"], **BOTH},
}
ROWS = table((ROOT / "docs" / "controllers.md").read_text(encoding="utf-8"), "blocks")


def test_the_page_has_all_blocks() -> None:
    assert [row[0] for row in ROWS] == list(PAGE)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_limits_of_the_page(row: list[str]) -> None:
    """The columns of theory, to all digits shown; what simulation found is no more than 1 % away."""
    for arm, theory, simulation in (("lwa4d_3dof_printed", *row[1:3]), ("lwa4d_3dof", *row[3:5])):
        found = margins(limits(arm, pd("joint", 1.0), changes={**NEXT_SYNC, **PAGE[row[0]]}))
        assert theory == ", ".join(f"{p:#.3g}" if p < 100 else f"{p:.0f}" for p in found)
        np.testing.assert_allclose(np.array(simulation.split(", "), float), found, rtol=0.01)


def test_a_predictor_with_the_exact_model_is_a_loop_without_delay() -> None:
    """It makes up for the delay but not for the lag of the filter; with the true speed nothing is left."""
    true: dict[str, Any] = {"loop.velocity": {"kind": "true"}}
    late, here = (
        limits("lwa4d_3dof", pd("joint", 1.0), changes={**true, **one})
        for one in ({**NEXT_SYNC, **PREDICTOR}, IMMEDIATE)
    )
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
