"""The thesis's identification motion as the head of a scenario (section 5.1.3)."""

from lwa4d_sim.trajectories import THESIS_EXCITATION

# arm, start and motion; `duration` and what else the trajectory needs come next, two blanks in
THESIS_MOTION = f"""arm: lwa4d_planar
initial: {{q: [0.0, -1.5707963]}}
trajectory:
  kind: fourier
  a: {[list(row) for row in THESIS_EXCITATION.a]}
  b: {[list(row) for row in THESIS_EXCITATION.b]}
"""
