"""Reads an MJCF arm, checks that it is one, and applies a scenario's physical changes."""

from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lwa4d_sim.arm import ARMS
from lwa4d_sim.chain import Chain
from lwa4d_sim.dynamics import tool_site
from lwa4d_sim.edits import ArmEdits, Payload
from lwa4d_sim.errors import ModelError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf_checks import check_arm, check_damping, name_of, require, torque_ranges

_INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}


_AS_IT_IS = ArmEdits()


def model_path(name_or_path: str, base: Path | None = None) -> Path:
    """File of a shipped arm (by name) or of any other (by path, relative to ``base`` or the working directory).

    Raises:
        ModelError: no such file.
    """
    if name_or_path in ARMS:
        here = Path(__file__).parent  # an installed package holds the models, a checkout has them beside it
        folder = here / "models" if (here / "models").is_dir() else here.parent / "models"
        return folder / f"{name_or_path}.xml"
    path = (base or Path()) / name_or_path
    try:
        found = path.is_file()
    except (OSError, ValueError):  # a name too long, or with a NUL in it
        found = False
    if not found:
        raise ModelError(
            f"arm {name_or_path!r}: no such file ({path}); give {', '.join(ARMS)} or the path of an MJCF file"
        )
    return path


def load_model(
    name_or_path: str,
    edits: ArmEdits = _AS_IT_IS,
    *,
    timestep: float | None = None,
    integrator: str | None = None,
    base: Path | None = None,
    tool_body: bool = False,
) -> mujoco.MjModel:
    """Compile a shipped arm or an MJCF file with ``edits`` applied; callers share the model and must not change it.

    The automatic reset of a diverging simulation is switched off, so that a diverged run stays visible.

    Args:
        name_or_path: see `model_path`.
        edits: physical changes.
        timestep: physics step [s]; default the file's.
        integrator: Euler, RK4, implicit, implicitfast or discrete; default the file's.
        base: folder that a relative path starts from.
        tool_body: add a weightless body ``tool`` at the tool frame, for outside forces to act on.

    Raises:
        ModelError: the file is missing, broken, or not a serial arm with one plain motor a joint; an edit does not
            fit the arm; or its viscous friction is too stiff for an explicit integrator at this step.
    """
    path = model_path(name_or_path, base)
    # a subclass's other settings are no part of the arm, nor of the key under which it is kept
    plain = ArmEdits(**{f.name: getattr(edits, f.name) for f in fields(ArmEdits)})
    return _load(path, path.stat().st_mtime_ns, name_or_path, plain, timestep, integrator, tool_body)


@lru_cache(maxsize=64)
def _load(
    path: Path,
    modified: int,  # part of the key, so that an edited file is read again
    name_or_path: str,
    edits: ArmEdits,
    timestep: float | None,
    integrator: str | None,
    tool_body: bool,
) -> mujoco.MjModel:
    """`load_model`, once for each file and set of edits: a batch of a thousand arms has few different ones."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if tool_body or edits != _AS_IT_IS:
            plain = spec.compile()
            check_arm(plain)
            _edit(spec, plain, edits, name_or_path)
            if tool_body:
                _add_tool_body(spec, plain)
        if timestep is not None:
            require(timestep > 0, f"timestep is {timestep} s; it must be positive")
            spec.option.timestep = timestep
        if integrator is not None:
            require(integrator in _INTEGRATORS, f"no integrator {integrator!r}; give one of {', '.join(_INTEGRATORS)}")
            spec.option.integrator = _INTEGRATORS[integrator]
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        model = spec.compile()
        check_arm(model)
        check_damping(model, home(model))
    except ValueError as error:  # ModelError is one too; MuJoCo's own speaks in several lines
        raise ModelError(f"arm {name_or_path!r}: {' '.join(str(error).split())}") from error
    return model


def _add_tool_body(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    site = tool_site(model)
    if site >= 0:
        frame = spec.site(model.site(site).name)
        frame.parent.add_body(name="tool", pos=frame.pos, quat=frame.quat, ipos=(0, 0, 0))
    else:
        spec.bodies[-1].add_body(name="tool", ipos=(0, 0, 0))


def torque_limits(model: mujoco.MjModel) -> Array:
    """Largest torque of each joint [N m], (n,); inf where the model has no limit."""
    return np.asarray(torque_ranges(model)[..., 1].min(axis=0))


def joint_facts(model: mujoco.MjModel) -> list[tuple[str, tuple[float, float] | None, float]]:
    """Name, position limits [rad] or None, and largest torque [N m] of each joint."""
    limits = [tuple(model.jnt_range[j].tolist()) if model.jnt_limited[j] else None for j in range(model.njnt)]
    return [(model.joint(j).name, limits[j], float(peak)) for j, peak in enumerate(torque_limits(model))]


def home(model: mujoco.MjModel) -> Array:
    """The keyframe ``home``, or the pose in which the file describes the arm, (n,) [rad]."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    return np.array(model.key_qpos[key] if key >= 0 else model.qpos0)


def chain_of(model: mujoco.MjModel) -> Chain:
    """The arm's geometry as plain numbers; the base is the model's world.

    Raises:
        ModelError: the tool frame is not on the last link.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    links = np.asarray(model.jnt_bodyid)
    site = tool_site(model)
    if site >= 0:
        body, x, xmat = int(model.site_bodyid[site]), data.site_xpos[site], data.site_xmat[site]
    else:
        body, x, xmat = model.nbody - 1, data.xpos[-1], data.xmat[-1]
    last = name_of(model, "BODY", links[-1])
    require(
        model.body_weldid[body] == links[-1],
        f"the tool frame is on {name_of(model, 'BODY', body)}, which is not fixed to the last link; "
        f"put a site named tcp on {last}",
    )
    pos = np.vstack([np.zeros(3), data.xpos[links], x])
    R = np.vstack([np.eye(3).ravel(), data.xmat[links], xmat]).reshape(-1, 3, 3)
    inverse = R[:-1].swapaxes(-1, -2)
    steps = (inverse @ np.diff(pos, axis=0)[..., None])[..., 0]
    turns = inverse @ R[1:]
    limited = np.asarray(model.jnt_limited, bool)
    return Chain(
        names=tuple(name_of(model, "JOINT", i) for i in range(model.njnt)),
        pos=steps[:-1],
        R=turns[:-1],
        axis=np.array(model.jnt_axis),
        anchor=np.array(model.jnt_pos),
        slide=np.asarray(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE),
        tool_pos=steps[-1],
        tool_R=turns[-1],
        lower=np.where(limited, model.jnt_range[:, 0], -np.inf),
        upper=np.where(limited, model.jnt_range[:, 1], np.inf),
    )


def _edit(spec: mujoco.MjSpec, model: mujoco.MjModel, edits: ArmEdits, name: str) -> None:
    """Write ``edits`` into ``spec``, whose compiled, unedited ``model`` tells what is there."""

    def per_joint(key: str, value: Any) -> Array:
        if isinstance(value, str):
            require(name in ARMS, f"{key}: lwa4d is known for {', '.join(ARMS)} only; give numbers")
            value = getattr(ARMS[name], key.split(".")[-1])
        values = np.asarray(value, float)
        fits = values.ndim == 0 or len(values) == model.njnt
        require(fits, f"{key} has {values.size} values for {model.njnt} joints; give one number or {model.njnt}")
        return np.broadcast_to(values, model.njnt)

    joints = sorted(spec.joints, key=lambda joint: int(joint.id))
    if edits.armature is not None:
        for joint, armature in zip(joints, per_joint("armature", edits.armature), strict=True):
            joint.armature = armature
    if edits.friction is not None:
        viscous, coulomb = (
            per_joint(f"friction.{key}", edits.friction if edits.friction == "lwa4d" else getattr(edits.friction, key))
            for key in ("viscous", "coulomb")
        )
        for joint, joint_viscous, joint_coulomb in zip(joints, viscous, coulomb, strict=True):
            joint.damping = [joint_viscous, 0.0, 0.0]  # linear, quadratic and cubic in speed
            joint.frictionloss = joint_coulomb
    if edits.gravity is not None:
        spec.option.gravity = edits.gravity
    if edits.payload is not None or edits.mass_scale != 1.0:
        _edit_masses(spec, model, per_joint("mass_scale", edits.mass_scale), edits.payload)


def _edit_masses(spec: mujoco.MjSpec, model: mujoco.MjModel, scale: Array, payload: Payload | None) -> None:
    """Give every body of every link an explicit inertia: the compiled one, scaled, the payload merged into the last.

    Merging, rather than adding a body, leaves the model's structure as it was: a batch may mix payloads.
    """
    spec.compiler.settotalmass = -1  # this and the next would undo the edit
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    bodies = {body.id: body for body in spec.bodies}
    for link, factor in zip(model.jnt_bodyid, scale, strict=True):
        for b in np.flatnonzero(model.body_weldid == link):
            if b != link and model.body_mass[b] == 0.0:
                continue  # a tool frame or the like; MuJoCo takes no full inertia of zeros
            flat = np.empty(9)
            mujoco.mju_quat2Mat(flat, model.body_iquat[b])
            R = flat.reshape(3, 3)
            lumps = [(factor * model.body_mass[b], model.body_ipos[b], R * (factor * model.body_inertia[b]) @ R.T)]
            if payload is not None and b == model.jnt_bodyid[-1]:
                lumps.append(_lump(payload, chain_of(model)))
            _set_inertia(bodies[b], lumps)


_Lump = tuple[float, Array, Array]  # mass [kg], centre of mass (3,) [m], inertia about it (3, 3) [kg m^2]


def _lump(payload: Payload, chain: Chain) -> _Lump:
    """The payload in the last link's frame."""
    sphere = 0.4 * payload.mass * payload.radius**2  # solid
    inertia = np.diag(payload.inertia or (sphere, sphere, sphere))
    R = chain.tool_R
    return payload.mass, chain.tool_pos + R @ np.array(payload.com), R @ inertia @ R.T


def _set_inertia(body: mujoco.MjsBody, lumps: list[_Lump]) -> None:
    """Give ``body`` the sum of ``lumps``, which are in its frame: I = sum of I_i + m_i (d_i² 1 - d_i d_iᵀ)."""
    mass = sum(m for m, _, _ in lumps)
    com = sum((m * c for m, c, _ in lumps), np.zeros(3)) / (mass or 1.0)
    offsets = [(m, c - com, inertia) for m, c, inertia in lumps]
    I = sum((inertia + m * (d @ d * np.eye(3) - np.outer(d, d)) for m, d, inertia in offsets), np.zeros((3, 3)))
    body.explicitinertial, body.mass, body.ipos = True, mass, com
    body.iquat, body.inertia = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)  # MuJoCo finds the principal axes itself
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = I[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
