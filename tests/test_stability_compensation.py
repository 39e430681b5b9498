"""Limits with predictor, observers and shaped gains: the analysis against simulation, tick by tick."""

from typing import Any

import numpy as np
import pytest
from stability_rig import compare, limits, margins, pd

PREDICTOR: dict[str, Any] = {"compensation": {"predictor": {}}}
OBSERVER: dict[str, Any] = {"loop.velocity": {"kind": "observer", "acceleration": 0.3, "position": 1.75e-5}}
DISTURBANCE: dict[str, Any] = {"compensation": {"disturbance_observer": {"bandwidth": 5.0}}}
BOTH: dict[str, Any] = {"compensation": {"predictor": {}, "disturbance_observer": {"bandwidth": 5.0}}}
LATE: dict[str, Any] = {"loop.latency": {"measurement": 0.005, "command": 0.0025}}
UNLIKE: dict[str, Any] = {"loop.latency": {"measurement": [0.0, 0.0025, 0.0125]}}
LATER: dict[str, Any] = {"loop.latency": {"measurement": 0.0125, "command": 0.005}}

BLOCKS = {
    "observer": OBSERVER,
    "predictor": PREDICTOR,
    "predictor and observer": {**PREDICTOR, **OBSERVER},
    "predictor that looks half as far": {"compensation": {"predictor": {"horizon": 0.005}}, **OBSERVER},
    "disturbance observer": DISTURBANCE,
    "all": {**BOTH, **OBSERVER},
    "observer of late samples": {**OBSERVER, **LATE},
    "all of late samples": {**BOTH, **OBSERVER, **LATER},
    "predictor of late samples": {**PREDICTOR, **LATE},
    "predictor of samples of different ages": {**PREDICTOR, **UNLIKE},
    "all of samples of different ages": {**BOTH, **OBSERVER, **UNLIKE},
}
LIMITED = "{kind: pd_gravity, space: joint, kp: 0.5, kd: 0.83, damping_limit: 1.2}"
SHAPED = {
    "diagonal": ("{kind: pd_gravity, space: joint, kp: 5, kd: 8, schedule: diagonal}", {}),
    "inertia": ("{kind: pd_gravity, space: joint, kp: 5, kd: 8, schedule: inertia}", {}),
    "inertia, task": ("{kind: pd_gravity, space: task, kp: 5, kd: 8, schedule: inertia}", {}),
    "damping limit": (LIMITED, {}),
    "damping limit and predictor": (
        "{kind: pd_gravity, space: joint, kp: 0.5, kd: 0.83, damping_limit: 1.2}",
        PREDICTOR,
    ),
}


@pytest.mark.parametrize(
    ("name", "actuation"),
    [
        *[(name, "next_sync") for name in BLOCKS],
        *[(name, "immediate") for name in ("observer", "predictor of late samples", "observer of late samples")],
    ],
)
def test_limits_with_compensation(name: str, actuation: str) -> None:
    limit = compare(limits("lwa4d_3dof", pd("joint", 0.5), actuation=actuation, changes=BLOCKS[name]))
    np.testing.assert_allclose(limit, 1.0, atol=2e-3)


@pytest.mark.parametrize("name", list(SHAPED))
def test_limits_with_shaped_gains(name: str) -> None:
    law, changes = SHAPED[name]
    compare(limits("lwa4d_3dof", law, actuation="next_sync", changes=changes))


def test_predictor_and_observer_give_back_what_the_bus_took() -> None:
    """With the arm's own model the limit at the next SYNC is that of the true speed at once."""
    whole = margins(limits("lwa4d_3dof", pd("joint", 0.5), changes={"loop.velocity": {"kind": "true"}}))
    changes = {**PREDICTOR, **OBSERVER}
    back = margins(limits("lwa4d_3dof", pd("joint", 0.5), actuation="next_sync", changes=changes))
    np.testing.assert_allclose(back, whole, rtol=1e-6)
