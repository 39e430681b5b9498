"""What a scenario may change about an arm: payload, masses, rotors, friction, gravity."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from lwa4d_sim.interfaces import STRICT, NonNegative, Positive

_Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Payload:
    """A body fixed to the flange.

    Attributes:
        mass: [kg].
        com: centre of mass in the flange frame [m].
        inertia: principal moments about the centre of mass along the flange axes [kg m^2]; default a solid sphere.
        radius: of that sphere [m].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    mass: NonNegative
    com: _Vector = (0.0, 0.0, 0.0)
    inertia: tuple[NonNegative, NonNegative, NonNegative] | None = None
    radius: Positive = 0.05


@dataclass(frozen=True, kw_only=True)
class Friction:
    """Joint friction, one number for all joints or one per joint.

    Attributes:
        viscous: [N m s/rad].
        coulomb: [N m].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    viscous: NonNegative | tuple[NonNegative, ...] = 0.0
    coulomb: NonNegative | tuple[NonNegative, ...] = 0.0


@dataclass(frozen=True, kw_only=True)
class ArmEdits:
    """Physical changes to an arm; what is None stays as the model file has it.

    Attributes:
        payload: a body fixed to the flange.
        mass_scale: factor on mass and inertia of all links, or one per link; the payload is not scaled.
        armature: reflected rotor inertia [kg m^2], one number or one per joint; "lwa4d" takes the table in
            `lwa4d_sim.arm` (shipped arms only).
        friction: joint friction in place of the model's; "lwa4d" as above.
        gravity: [m/s^2] in base axes.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    payload: Payload | None = None
    mass_scale: Positive | tuple[Positive, ...] = 1.0
    armature: NonNegative | tuple[NonNegative, ...] | Literal["lwa4d"] | None = None
    friction: Friction | Literal["lwa4d"] | None = None
    gravity: _Vector | None = None
