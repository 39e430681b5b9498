"""The critical gain over a slice of the workspace: two joints move, the others stay."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import joint_facts
from lwa4d_sim.stability.study import Study


@dataclass(frozen=True, slots=True)
class Slice:
    """Gain margins over two joints.

    Attributes:
        joints: indices of the joint along the rows and of the one along the columns.
        first, second: their angles [rad], (R,) and (C,).
        x: tool points (R, C, 3) [m].
        spectral_radius: (R, C).
        gain_margin: (R, C).
        frequency: of the mode at the limit [Hz], (R, C); nan where there is no limit.
        limiting: index of the joint that moves most in it (R, C); -1 where there is no limit.
    """

    joints: tuple[int, int]
    first: Array
    second: Array
    x: Array
    spectral_radius: Array
    gain_margin: Array
    frequency: Array
    limiting: Array


def default_joints(study: Study) -> tuple[int, int]:
    """The two joints that sweep out the vertical plane: the first two whose axes are level and parallel."""
    q = study.waypoints().q[:1]
    frames = study.blocks.arm.kinematics.frames(q[0])
    level = [j for j in range(study.n) if abs(frames.z[j, 2]) < 0.5]
    for a in level:
        for b in level:
            if b > a and abs(frames.z[a] @ frames.z[b]) > 0.99:
                return a, b
    return 0, min(1, study.n - 1)


def workspace(
    study: Study,
    joints: tuple[int, int] | None = None,
    size: tuple[int, int] = (50, 50),
    advance: Callable[[], None] = lambda: None,
) -> Slice:
    """Critical gains at rest over a grid of two joints, the others as at the first waypoint.

    The first joint goes through its whole range; the second stays on the side of zero, the branch of the elbow, on
    which the first waypoint has it.

    Args:
        study: the loop.
        joints: indices of the two; default those that move the tool in a vertical plane.
        size: number of angles of each.
        advance: called after each row.

    Raises:
        ScenarioError: there is no such joint.
    """
    joints = joints or default_joints(study)
    q, first, second = slice_of(study, joints, size)
    radius, margin, frequency = np.empty(size), np.empty(size), np.full(size, np.nan)
    limiting = np.full(size, -1)
    for row in range(size[0]):
        loop = study.close(study.linear(study.resting(q[row])))
        radius[row] = loop.radius(np.arange(size[1]), np.ones(size[1]))
        margin[row] = study.gain_margin(loop)
        bounded = np.isfinite(margin[row]) & (margin[row] > 0)
        for column in np.flatnonzero(bounded):
            mode = study.mode(loop, int(column), float(margin[row, column]))
            frequency[row, column], limiting[row, column] = mode.frequency, int(np.argmax(mode.share))
        advance()
    x = study.blocks.arm.kinematics.point(q.reshape(-1, study.n)).reshape(*size, 3)
    return Slice(joints, first, second, x, radius, margin, frequency, limiting)


def slice_of(study: Study, joints: tuple[int, int], size: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Poses (R, C, n) of a slice, and the angles of its two joints (R,) and (C,), see `workspace`."""
    i, j = joints
    if not (0 <= i < study.n and 0 <= j < study.n and i != j):
        rule = f"give two of 1 to {study.n}" if study.n > 1 else "an arm of one joint has none"
        raise ScenarioError(f"joints {i + 1} and {j + 1} make no slice of the workspace; {rule}")
    here = study.waypoints().q[0]
    low, high = _range(study, i)
    first = np.linspace(low, high, size[0])
    low, high = _range(study, j)
    second = np.linspace(0.0, high, size[1]) if here[j] >= 0 else np.linspace(low, 0.0, size[1])
    q = np.broadcast_to(here, (size[0], size[1], study.n)).copy()
    q[..., i], q[..., j] = first[:, None], second
    return q, first, second


def _range(study: Study, joint: int) -> tuple[float, float]:
    """A joint's range [rad]; a full turn where it has none."""
    return joint_facts(study.blocks.model)[joint][1] or (-np.pi, np.pi)
