"""The numbers of a model that a fit to its motion may turn, as parameters of mujoco.sysid."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.mjcf_checks import name_of

What = Literal["delay", "delays", "friction", "offset", "mass", "inertia"]

REACH = 0.05  # [s]; largest delay either way: five periods of the thesis's bus (assumed)
_LARGE = 1e4  # bound of friction in its units (assumed: a hundred times what an arm of this size has)
_SCALE = (0.01, 100.0)  # bounds of a factor on mass (assumed)
#: Coefficients of MuJoCo's damping polynomial: torque = -(viscous + quadratic |dq| + cubic dq^2) dq.
_DAMPING = {"viscous": "N m s/rad", "quadratic": "N m s^2/rad^2", "cubic": "N m s^3/rad^3"}

_Write = Callable[[float], None]


def adjustable(sysid: Any, spec: Any, what: Sequence[What]) -> tuple[Any, tuple[str, ...]]:
    """Parameters with the values of ``spec``, which they change; and their units.

    Args:
        sysid: the library.
        spec: of the model.
        what: see `lwa4d_sim.identification.refine.refine`.

    Raises:
        IdentificationError: nothing is asked for, or one thing twice.
    """
    if not set(what) - {"inertia"} or {"delay", "delays"} <= set(what) or {"mass", "inertia"} <= set(what):
        raise IdentificationError("what to refine: give delay or delays, friction, offset, mass or inertia, not both")
    params, units = sysid.ParameterDict(), []
    for name, unit, start, bounds, write in _unknowns(spec.compile(), spec, what):
        params.add(sysid.Parameter(name, start, *bounds, modifier=write and _modifier(write)))
        units.append(unit)
    return params, tuple(units)


def _modifier(write: _Write) -> Callable[[Any, Any], None]:
    """A closure, as the library copies its parameters in depth, and with them all but functions."""
    return lambda _spec, parameter: write(float(parameter.value[0]))


def _unknowns(
    model: Any, spec: Any, what: Sequence[What]
) -> Iterator[tuple[str, str, float, tuple[float, float], _Write | None]]:
    """Name, unit, value, bounds and what writes it into ``spec``, in a fixed order.

    What changes the torques instead of the model has nothing that writes it.
    """
    names = [name_of(model, "JOINT", j) for j in range(model.njnt)]
    joints = sorted(spec.joints, key=lambda joint: int(joint.id))
    if "delay" in what:
        yield "delay", "s", 0.0, (-REACH, REACH), None
    if "delays" in what:
        yield from ((f"{name}.delay", "s", 0.0, (-REACH, REACH), None) for name in names)
    if "friction" in what:
        poly = np.column_stack([model.dof_damping, model.dof_dampingpoly])
        for power, (kind, unit) in enumerate(_DAMPING.items()):
            bounds = (-_LARGE if power else 0.0, _LARGE)
            for name, joint, value in zip(names, joints, poly[:, power], strict=True):
                yield f"{name}.{kind}", unit, value, bounds, partial(_damp, joint, power)
        for name, joint, value in zip(names, joints, model.dof_frictionloss, strict=True):
            yield f"{name}.coulomb", "N m", value, (0.0, _LARGE), partial(setattr, joint, "frictionloss")
    if "offset" in what:
        yield from ((f"{name}.offset", "N m", 0.0, (-_LARGE, _LARGE), None) for name in names)
    if "mass" in what:
        for link in model.jnt_bodyid:
            name = name_of(model, "BODY", link)
            yield f"{name}.scale", "1", 1.0, _SCALE, partial(_scale, _explicit(model, spec, link))


def _damp(joint: Any, power: int, value: float) -> None:
    polynomial = np.array(joint.damping)
    polynomial[power] = value
    joint.damping = polynomial


def _explicit(model: Any, spec: Any, link: int) -> list[tuple[Any, float, Any]]:
    """Body, mass and moments of a link and of what is welded to it, after giving them these explicitly."""
    import mujoco

    spec.compiler.settotalmass = -1  # this and the next would undo what is given
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    bodies = [body for body in spec.bodies if model.body_weldid[body.id] == link]
    for body in bodies:
        body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
        body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
        body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    return [(body, float(model.body_mass[body.id]), np.array(model.body_inertia[body.id])) for body in bodies]


def _scale(bodies: list[tuple[Any, float, Any]], factor: float) -> None:
    for body, mass, inertia in bodies:
        body.mass, body.inertia = factor * mass, factor * inertia
