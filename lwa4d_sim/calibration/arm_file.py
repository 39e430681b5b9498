"""The calibrated arm as an MJCF file that every command takes: links and tool frame moved, all else as it was."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lwa4d_sim.calibration.error_model import ErrorModel
from lwa4d_sim.calibration.exact_xml import exact_quat, exact_xml
from lwa4d_sim.calibration.identifiable import random_poses
from lwa4d_sim.chain import SerialKinematics
from lwa4d_sim.dynamics import tool_site
from lwa4d_sim.errors import ModelError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of, load_model, model_path
from lwa4d_sim.rotations import rotation_matrix

_EXACT = 1e-12  # [m] and [-]: the rounding of a dozen products of numbers near 1
_MADE = "<!-- Made by lwa4d-sim calibrate; parameters.yaml beside it says what was changed. -->\n"
_POSES = 20  # at which the file is verified


def write_arm(path: Path, arm: str, model: ErrorModel, xi: Array) -> None:
    """Write the arm with errors ``xi`` (p,), and make sure that the file says the same.

    Args:
        path: the file to write.
        arm: name of a shipped arm, or path of its MJCF file.
        model: the coordinates, of that arm.
        xi: errors [m, rad].

    Raises:
        ModelError: MuJoCo cannot write this arm so that it reads it again as the same.
    """
    source = model_path(arm)
    plain = load_model(arm)
    spec = mujoco.MjSpec.from_file(str(source))
    spec.compile()  # numbers the bodies
    spec.modelname = f"{spec.modelname}_calibrated"
    shifts, turns = model.in_links(xi)
    bodies = {body.id: body for body in spec.bodies}
    for i, link in enumerate(plain.jnt_bodyid):
        # the file describes the arm at q = qpos0, the chain at q = 0: the joint's motion between is undone around it
        D, back = _transform(shifts[i], turns[i]), _joint_motion(plain, i, -float(plain.qpos0[i]))
        _move(spec, bodies[int(link)], back @ D @ np.linalg.inv(back))
    _move(spec, _tool(spec, plain), _transform(xi[-6:-3], rotation_matrix(xi[-3:])))
    try:
        path.write_text(_MADE + exact_xml(spec, source.parent), encoding="utf-8")
        found = chain_of(load_model(str(path)))
    except (ValueError, KeyError) as error:  # ModelError is a ValueError, MuJoCo's own speaks in several lines
        raise ModelError(
            f"arm {arm!r}: the calibrated arm cannot be written: {' '.join(str(error).split())}"
        ) from error
    q = random_poses(model, _POSES, np.random.default_rng(0))
    read, wanted = SerialKinematics(found).fk(q), SerialKinematics(model.corrected(xi)).fk(q)
    off = max(float(np.abs(read.x - wanted.x).max()), float(np.abs(read.R - wanted.R).max()))
    if not off < _EXACT:
        raise ModelError(
            f"arm {arm!r}: the calibrated arm, written as MJCF, is {off:.2g} m or rad off; at most {_EXACT:g} is valid"
        )


def _tool(spec: mujoco.MjSpec, plain: mujoco.MjModel) -> Any:
    """The site that is the tool frame; where the last body's frame is it, a site tcp added there."""
    site = tool_site(plain)
    if site >= 0:
        return spec.site(plain.site(site).name)
    last = next(body for body in spec.bodies if body.id == plain.nbody - 1)
    return last.add_site(name="tcp")


def _transform(shift: Array, turn: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, shift
    return T


def _joint_motion(model: mujoco.MjModel, i: int, q: float) -> Array:
    """How joint ``i`` moves its link at ``q`` [rad or m], in the link's frame (4, 4)."""
    axis, anchor = model.jnt_axis[i], model.jnt_pos[i]
    if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_SLIDE:
        return _transform(q * axis, np.eye(3))
    R = rotation_matrix(q * axis)
    return _transform(anchor - R @ anchor, R)


def _move(spec: mujoco.MjSpec, element: Any, D: Array) -> None:
    """Move a body or site by ``D`` (4, 4) as seen in its own frame."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, exact_quat(spec, element))
    R = flat.reshape(3, 3)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, (R @ D[:3, :3]).ravel())
    element.pos = np.array(element.pos) + R @ D[:3, 3]
    element.quat = quat
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
