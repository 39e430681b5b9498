"""Stability along a motion that repeats: growth per period over a whole cycle against a disturbed simulation."""

import numpy as np
import pytest

from lwa4d_sim.runner import run_batch
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.motion import along
from lwa4d_sim.stability.study import Study

# Joints 2 and 4 swing through half a turn, so that the inertia changes threefold within a cycle.
TEXT = """
name: swing
arm: lwa4d_3dof
plant: {{timestep: 0.0025}}
initial: {{q: {start}}}
trajectory:
  kind: fourier
  a: [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
  b: [[0.5, 0.3], [1.0, 0.2], [2.2, -0.3]]
  offset: [0.0, -1.2, 1.5]
  omega: 2.0
  duration: 12.6
controller: {law}
loop: {{actuation: {actuation}}}
"""
TICKS = 314  # periods of a cycle, to a part in two thousand


def swing(kp: float, actuation: str) -> tuple[float, float, float]:
    """Growth per period by the analysis and in simulation, and the least gain margin of the loop frozen on its way."""
    law = f"{{kind: computed_torque, kp: {kp}, kd: {kp / 4}}}"
    scenario = Scenario.parse(TEXT.format(start=[0, 0, 0], law=law, actuation=actuation))
    study = Study(scenario, "default")
    course = along(study)
    q0 = study.along(np.zeros(1)).q[0]
    starts = [q0, q0 + 1e-7 * np.array([0, -1, 1])]
    one, other = run_batch(scenario, [{"initial.q": q.tolist()} for q in starts])
    apart = np.hstack([one.q - other.q, one.dq - other.dq])[:: len(one.q) // (4 * TICKS)]
    third, fourth = (np.linalg.norm(apart[i * TICKS : (i + 1) * TICKS]) for i in (2, 3))
    assert np.abs(apart).max() < 1e-3, "small enough to be linear"
    assert course.floquet is not None
    return course.floquet, float((fourth / third) ** (1 / TICKS)), float(course.gain_margin.min())


@pytest.mark.parametrize(("actuation", "below", "above"), [("immediate", 370, 380), ("next_sync", 190, 200)])
def test_growth_over_a_cycle_in_simulation(actuation: str, below: float, above: float) -> None:
    """A cycle decides, not its worst instant: there the frozen loop is unstable long before the motion is.

    The analysis follows the motion that is asked for, the arm one some hundredths of a radian beside it, hence the
    tolerance: five parts in a thousand of the gain.
    """
    first, second = swing(below, actuation), swing(above, actuation)
    for floquet, simulated, frozen in (first, second):
        assert abs(np.log(simulated / floquet)) < 1e-3
        assert frozen < 0.85
    assert max(first[:2]) < 1 < min(second[:2])
    slope = np.log(second[0] / first[0]) / (above - below)
    limits = [below - np.log(growth) / slope for growth in first[:2]]
    assert limits[1] == pytest.approx(limits[0], rel=5e-3)


def test_a_motion_that_does_not_repeat_has_no_growth_over_a_cycle() -> None:
    text = TEXT.format(start=[0, 0, 0], law="{kind: computed_torque, p: 8}", actuation="immediate")
    study = Study(Scenario.parse(text.replace("omega: 2.0", "omega: 0.3")), "default")
    assert along(study).floquet is None
