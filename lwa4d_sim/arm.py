"""The LWA4D's numbers, each with its source: one table of modules, from which the four arms are derived.

Sources: "thesis" is "Towards a Model-Based Motion Control Design for a 7-axis Robotic Arm LWA4D by Schunk"; "URDF" is
ipa320/schunk_modular_robotics, schunk_description/urdf/lwa4d; "identification" is AndreaGiusti/OTFCtrlModRob
(LWA 4P units). ``models/README.md`` tells how each number of the MJCF files follows from these.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lwa4d_sim.interfaces import Array

if TYPE_CHECKING:
    import mujoco

    from lwa4d_sim.chain import SerialKinematics
    from lwa4d_sim.dynamics import Dynamics

Vector = tuple[float, float, float]

GRAVITY = 9.81  # [m/s^2], thesis, Table 5.3

# Link lengths of the CAD model [m], thesis, Table 5.5: base to shoulder, shoulder to elbow, elbow to wrist, wrist to
# flange. The real arm has 0.380, 0.328, 0.323 and an unknown last length (thesis, table row lost).
L1, L2, L3, L4 = 0.300, 0.328, 0.320, 0.077


@dataclass(frozen=True, slots=True)
class Module:
    """One rotary drive module.

    Attributes:
        name: SCHUNK's name.
        mass: [kg], half of an ERB 115 for each of its two axes (thesis, Table 5.1).
        radius: of the CAD model, which the simulation uses [m] (thesis, Table 5.1).
        radius_real: of the real module [m] (thesis, Table 5.1).
        torque_max: peak torque [N m] (thesis, Table 5.1).
        position_max: the joint moves within +- this angle [rad] (URDF).
        velocity_max: [rad/s] (URDF).
    """

    name: str
    mass: float
    radius: float
    radius_real: float
    torque_max: float
    position_max: float
    velocity_max: float


MODULES = (
    Module("PRL 120", 3.6, 0.065, 0.066, 372.0, math.pi, 0.43633),
    Module("PRL 120", 3.6, 0.065, 0.066, 372.0, 2.14, 0.43633),
    Module("PRL 100", 2.0, 0.054, 0.056, 176.0, math.pi, 0.4189),
    Module("PRL 100", 2.0, 0.054, 0.056, 176.0, 2.18, 0.4189),
    Module("PRL 80", 1.2, 0.044, 0.0445, 41.4, math.pi, 0.43633),
    Module("ERB 115", 0.9, 0.0572, 0.058, 19.0, 2.09, 1.2566),
    Module("ERB 115", 0.9, 0.0572, 0.058, 19.0, 2.96, 1.2566),
)

# The pose in which the thesis starts its runs (section 5.3), in module angles [rad]: arm up, elbow bent by 90 degrees.
HOME = (-math.pi / 2, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Drivetrain:
    """What motor and gear add to a joint, on the joint side.

    Attributes:
        armature: reflected rotor inertia [kg m^2].
        viscous: viscous friction [N m s/rad].
        coulomb: Coulomb friction [N m].
    """

    armature: float
    viscous: float
    coulomb: float


# Identified on the two axes of an ERB 115 in an LWA 4P (identification); joints 6 and 7 here are the same module type.
WRIST = (Drivetrain(0.17, 4.45, 2.12), Drivetrain(0.21, 4.67, 2.33))


def drivetrain(joint: int) -> Drivetrain:
    """Drivetrain of joint 1 to 7: identified for the wrist, ASSUMED for the rest.

    No identification of the PRL modules is public. Theirs is the mean of the wrist axes times the ratio of peak
    torques. The rule is confirmed by the ERB 145 (64 N m, identification): it gives 0.64 kg m^2, 15.4 N m s/rad and
    7.5 N m, where 0.69 to 1.34, 13.6 to 18.4 and 5.1 to 8.24 were identified.
    """
    if joint >= 6:
        return WRIST[joint - 6]
    scale = MODULES[joint - 1].torque_max / MODULES[6].torque_max / 2
    return Drivetrain(
        armature=scale * sum(axis.armature for axis in WRIST),
        viscous=scale * sum(axis.viscous for axis in WRIST),
        coulomb=scale * sum(axis.coulomb for axis in WRIST),
    )


@dataclass(frozen=True, slots=True)
class Link:
    """One moving link; its frame has z along the link and its origin on the joint.

    Attributes:
        joint: number of the module that moves it, 1 to 7.
        pos: origin in the previous link's frame (the base for the first) [m].
        tilt: rotation of the frame about the previous frame's y axis at q = 0 [rad].
        axis: joint axis in the link frame.
        zero: joint angle at which the module reads zero [rad].
        mass: [kg].
        com: centre of mass in the link frame [m].
        inertia: about the centre of mass along the link frame's axes, which are principal [kg m^2].
    """

    joint: int
    pos: Vector
    tilt: float
    axis: Vector
    zero: float
    mass: float
    com: Vector
    inertia: Vector

    @property
    def module(self) -> Module:
        """The module that moves the link."""
        return MODULES[self.joint - 1]


@dataclass(frozen=True, slots=True)
class ArmParameters:
    """One shipped arm; vectors have one entry a joint.

    Attributes:
        name: name of the model, without ``.xml``.
        links: from the base to the flange.
        tool: flange centre in the last link's frame [m]; the flange frame has that link's orientation.
        limited: whether the joints have end stops.
    """

    name: str
    links: tuple[Link, ...]
    tool: Vector
    limited: bool = True

    @property
    def home(self) -> Array:
        """The thesis's start pose [rad]."""
        return _array(link.zero + sum(link.axis) * HOME[link.joint - 1] for link in self.links)

    @property
    def lower(self) -> Array:
        """Smallest joint angles [rad], -inf without end stops."""
        return _array(link.zero - link.module.position_max if self.limited else -math.inf for link in self.links)

    @property
    def upper(self) -> Array:
        """Largest joint angles [rad], inf without end stops."""
        return _array(link.zero + link.module.position_max if self.limited else math.inf for link in self.links)

    @property
    def torque_max(self) -> Array:
        """Peak torques [N m]."""
        return _array(link.module.torque_max for link in self.links)

    @property
    def velocity_max(self) -> Array:
        """Largest joint speeds [rad/s]."""
        return _array(link.module.velocity_max for link in self.links)

    @property
    def armature(self) -> Array:
        """Reflected rotor inertias [kg m^2]; the shipped models leave them out."""
        return _array(drivetrain(link.joint).armature for link in self.links)

    @property
    def viscous(self) -> Array:
        """Viscous friction [N m s/rad]; the shipped models leave it out."""
        return _array(drivetrain(link.joint).viscous for link in self.links)

    @property
    def coulomb(self) -> Array:
        """Coulomb friction [N m]; the shipped models leave it out."""
        return _array(drivetrain(link.joint).coulomb for link in self.links)


def _array(values: Iterable[float]) -> Array:
    return np.array(list(values))


def _link_mass(joint: int) -> float:
    """Half a module belongs to either side of its joint, module 1 wholly to link 1 (thesis, section 5.3.1)."""
    near = MODULES[joint - 1].mass * (1.0 if joint == 1 else 0.5)
    return near + (0.5 * MODULES[joint].mass if joint < 7 else 0.0)


def _links(groups: tuple[tuple[int, ...], ...]) -> tuple[Link, ...]:
    """Links of the arm that points up at q = 0; the joints of a group behind its first are locked.

    The arm is three uniform cylinders with the radii of PRL 120, 100 and 80 (thesis, section 5.3.1). A cylinder that
    several links share is cut across in proportion to mass (derived; thesis, Table 5.6 is lost), so that locking
    joints 3, 5, 6 and 7 gives exactly the thesis's three links.
    """
    bottom, radius, end = {}, {}, 0.0
    for joints, length, module in ((1,), L1, 0), ((2, 3), L2, 2), ((4, 5, 6, 7), L3 + L4, 4):
        density = sum(map(_link_mass, joints)) / length  # [kg/m]
        for joint in joints:
            bottom[joint], radius[joint] = end, MODULES[module].radius
            end += _link_mass(joint) / density
    bottom[8] = end
    joint_height = dict(zip(range(1, 8), (0, L1, L1, L1 + L2, L1 + L2, L1 + L2 + L3, L1 + L2 + L3), strict=True))

    links, below = [], 0.0
    for first, last in ((group[0], group[-1]) for group in groups):
        mass = sum(map(_link_mass, range(first, last + 1)))
        a, b, r, height = bottom[first], bottom[last + 1], radius[first], joint_height[first]
        across, along = mass * (3 * r**2 + (b - a) ** 2) / 12, mass * r**2 / 2  # uniform cylinder
        axis = (0.0, 0.0, 1.0) if first % 2 else (0.0, 1.0, 0.0)  # odd joints roll, even joints pitch (URDF)
        pos, com = (0.0, 0.0, height - below), (0.0, 0.0, (a + b) / 2 - height)
        links.append(Link(first, pos, 0.0, axis, 0.0, mass, com, (across, across, along)))
        below = height
    return tuple(links)


def _horizontal(link: Link) -> Link:
    """Shoulder link of an arm that is horizontal at q = 0: the arm points up at q2 = -pi/2."""
    return replace(link, tilt=math.pi / 2, zero=-math.pi / 2)


def _printed(link: Link) -> Link:
    """Inertia as thesis, Table 5.5 is used: its z is the cylinder's axis, the dynamics take it for the joint-2 axis.

    The table rounds to four places; here stand the exact values of the same formulas.
    """
    across, _, along = link.inertia
    return replace(link, inertia=(across, along, across))


def _upwards(link: Link) -> Link:
    """Pitch joint whose angle is counted upwards, as in thesis, section 5.1."""
    return replace(link, axis=(0.0, -1.0, 0.0), zero=-link.zero)


_SEVEN = _links(((1,), (2,), (3,), (4,), (5,), (6,), (7,)))
_TURN, _SHOULDER, _ELBOW = _links(((1,), (2, 3), (4, 5, 6, 7)))
_THREE = (_TURN, _horizontal(_SHOULDER), _ELBOW)
_PRINTED = tuple(map(_printed, _THREE))
_TWO = (replace(_upwards(_PRINTED[1]), pos=(0.0, 0.0, 0.0)), _upwards(_PRINTED[2]))

ARMS: dict[str, ArmParameters] = {
    arm.name: arm
    for arm in (
        ArmParameters("lwa4d_7dof", _SEVEN, tool=(0.0, 0.0, L4)),
        ArmParameters("lwa4d_3dof", _THREE, tool=(0.0, 0.0, L3 + L4)),
        ArmParameters("lwa4d_3dof_printed", _PRINTED, tool=(0.0, 0.0, L3 + L4)),
        # The planar study of thesis, section 5.1 knows no end stops; its weak PD would sag into them.
        ArmParameters("lwa4d_planar", _TWO, tool=(0.0, 0.0, L3 + L4), limited=False),
    )
}


@dataclass(frozen=True, slots=True)
class Arm:
    """A loaded arm: what MuJoCo simulates, and the same arm on paper."""

    model: mujoco.MjModel
    kinematics: SerialKinematics
    dynamics: Dynamics


def load_arm(name_or_path: str) -> Arm:
    """Load one of `ARMS` by name, or any MJCF arm by path.

    Raises:
        ModelError: the file is missing or is not a serial arm with one motor a joint.
    """
    from lwa4d_sim.dynamics import Dynamics
    from lwa4d_sim.kinematics import kinematics_for
    from lwa4d_sim.mjcf import chain_of, load_model

    model = copy(load_model(name_or_path))  # the caller's own, to change as he likes
    return Arm(model, kinematics_for(chain_of(model)), Dynamics(model))
