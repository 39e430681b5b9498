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
  a: [[0.5, 0.0], [1.0, 0.3], [2.2, 0.4]]
  b: [[0.0, 0.0], [0.0, 0.2], [0.0, -0.3]]
  offset: [0.0, -1.2, 1.5]
  omega: 2.0
  duration: 12.6
controller: {law}
loop: {{actuation: {actuation}}}
"""
