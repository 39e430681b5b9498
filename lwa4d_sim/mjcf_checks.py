"""What makes a compiled MJCF model an arm: an open chain with one plain motor a joint, and a step it can bear."""

import mujoco
import numpy as np

from lwa4d_sim.errors import ModelError
from lwa4d_sim.interfaces import Array

_HINGE_OR_SLIDE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))

# Largest stable product of pole and step on the negative real axis (derived): |1 + z + z²/2 + z³/6 + z⁴/24| <= 1, and
# |1 + z| <= 1.
_RK4_LIMIT, _EULER_LIMIT = 2.785, 2.0


def require(condition: bool, message: str) -> None:
    """Raise a ModelError unless ``condition`` holds."""
    if not condition:
        raise ModelError(message)


def name_of(model: mujoco.MjModel, kind: str, i: int) -> str:
    """Name of an object, or its kind and number, as in "joint 3", when it has none."""
    name = mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), i)
    return str(name) if name else f"{kind.lower()} {i + (kind != 'BODY')}"


def check_arm(model: mujoco.MjModel) -> None:
    """Demand a serial chain with one hinge or slide a link and one plain motor a joint, in chain order.

    Raises:
        ModelError: says what is wrong and what would be valid.
    """
    require(model.njnt > 0, "it has no joint; an arm needs at least one hinge or slide joint")
    require(model.neq == 0, "it has an equality constraint, which closes a loop; an arm must be an open chain")
    below = 0  # the world
    for j, (kind, body) in enumerate(zip(model.jnt_type, model.jnt_bodyid, strict=True)):
        joint, link = name_of(model, "JOINT", j), name_of(model, "BODY", body)
        require(int(kind) in _HINGE_OR_SLIDE, f"{joint} is neither hinge nor slide; an arm has no ball or free joints")
        count = model.body_jntnum[body]
        require(count == 1, f"{link} has {count} joints; give every link exactly one")
        parent = model.body_weldid[model.body_parentid[body]]
        require(
            parent == below,
            f"the chain branches: {link} hangs on {name_of(model, 'BODY', parent)} instead of "
            f"{name_of(model, 'BODY', below)}; an arm has one moving body on each link",
        )
        below = body
    _check_motors(model)


def _check_motors(model: mujoco.MjModel) -> None:
    joints = [name_of(model, "JOINT", j) for j in range(model.njnt)]
    fixed, no_bias, no_dynamics = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE
    for i, trntype in enumerate(model.actuator_trntype):
        gain, gear = model.actuator_gainprm[i, 0], model.actuator_gear[i, 0]
        faults = {
            "it acts on something other than a joint": trntype != mujoco.mjtTrn.mjTRN_JOINT,
            "its gain is not fixed": model.actuator_gaintype[i] != fixed,
            "it has a bias, as position and velocity servos do": model.actuator_biastype[i] != no_bias,
            "it has activation dynamics": model.actuator_dyntype[i] != no_dynamics,
            "it has a delay": model.actuator_delay[i] != 0,
            "it has damping": model.actuator_damping[i] != 0 or model.actuator_dampingpoly[i].any(),
            "it has armature": model.actuator_armature[i] != 0,
            f"its gain is {gain:g}": gain != 1,
            f"its gear is {gear:g}": gear != 1,
        }
        fault = next((text for text, present in faults.items() if present), None)
        motor = name_of(model, "ACTUATOR", i)
        require(fault is None, f"{motor} is not a plain motor: {fault}; write <motor joint=... gear='1' ctrlrange=...>")
    driven = [joints[j] for j in model.actuator_trnid[:, 0]]
    for joint in joints:
        require(driven.count(joint) == 1, f"{joint} has {driven.count(joint)} motors; give every joint exactly one")
    require(
        driven == joints,
        f"the motors drive {', '.join(driven)} in this order; put them in the order of the chain: {', '.join(joints)}",
    )
    for joint, ranges in zip(joints, torque_ranges(model).swapaxes(0, 1), strict=True):
        for low, high in ranges:
            require(low == -high < 0, f"{joint} has torque range {low:g} to {high:g}; give it as -limit to limit")


def torque_ranges(model: mujoco.MjModel) -> Array:
    """The three ranges MuJoCo clamps a motor's torque to, infinite when not in force: (3, n, 2) [N m]."""
    ranges = np.stack([model.actuator_ctrlrange, model.actuator_forcerange, model.jnt_actfrcrange])
    in_force = np.stack([model.actuator_ctrllimited, model.actuator_forcelimited, model.jnt_actfrclimited])
    return np.where(in_force[..., None], ranges, [-np.inf, np.inf])


def check_damping(model: mujoco.MjModel, q: Array) -> None:
    """Refuse viscous friction that an explicit integrator would blow up at the model's step.

    Args:
        model: compiled arm.
        q: one pose to look at (n,) [rad]; 64 more are drawn within the joint limits, for the arm stretched upwards
            turns a hundred times more easily than the arm stretched out.

    Raises:
        ModelError: the fastest pole of ddq = -M⁻¹ D dq lies outside the integrator's stability region.
    """
    if not model.dof_damping.any():
        return
    explicit_euler = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    limit = {
        int(mujoco.mjtIntegrator.mjINT_RK4): _RK4_LIMIT,
        int(mujoco.mjtIntegrator.mjINT_EULER): _EULER_LIMIT if explicit_euler else np.inf,
    }.get(model.opt.integrator, np.inf)  # the others, and Euler as a rule, treat damping implicitly
    reach: Array = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.pi, np.pi])
    drawn = np.random.default_rng(0).uniform(reach[:, 0], reach[:, 1], (64, model.nv))
    poses = np.vstack([q, np.zeros_like(q), drawn])
    data = mujoco.MjData(model)
    M = np.empty((len(poses), model.nv, model.nv))
    for pose, inertia in zip(poses, M, strict=True):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
    pole = float(np.linalg.eigvals(np.linalg.solve(M, np.diag(model.dof_damping))).real.max())
    step = model.opt.timestep
    require(
        pole * step <= limit,
        f"viscous friction is too stiff for this integrator: its fastest pole is {pole:.4g} 1/s, so the timestep "
        f"(={step:g} s) must be at most {limit / max(pole, 1e-300):.3g} s; or add armature, or use implicitfast",
    )
