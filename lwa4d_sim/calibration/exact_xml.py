"""An MJCF text in which frames, joints, inertias and keyframes have all their digits; MuJoCo's writer keeps six."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from lwa4d_sim.interfaces import Array

_MARK = "unnamed "  # begins the names that nameless elements have while they are looked up


def exact_xml(spec: mujoco.MjSpec, folder: Path) -> str:
    """The text of ``spec``, which it compiles; what MuJoCo's own text rounds to six digits is put in again.

    Args:
        spec: the arm; nameless bodies, sites, joints and frames get names.
        folder: of the file it was read from, where meshes and textures are looked for.

    Raises:
        ValueError: MuJoCo cannot compile or write it.
    """
    if any(asset.file for asset in (*spec.meshes, *spec.hfields)):
        spec.compiler.meshdir = str((folder / spec.compiler.meshdir).resolve())
    if any(texture.file for texture in spec.textures):
        spec.compiler.texturedir = str((folder / spec.compiler.texturedir).resolve())
    kinds = {"body": spec.bodies[1:], "site": spec.sites, "joint": spec.joints, "frame": spec.frames}
    for kind, elements in kinds.items():
        for i, element in enumerate(elements):
            element.name = element.name or f"{_MARK}{kind} {i}"
    model = spec.compile()
    root = ElementTree.fromstring(spec.to_xml())
    written = {
        (node.tag, node.get("name")): node
        for world in root.iter("worldbody")
        for node in world.iter()
        if node.get("name")
    }
    for kind, elements in kinds.items():
        for element in elements:
            node = written[kind, element.name]
            if kind == "joint":
                _joint(node, model, element)
            else:
                _set(node, "pos", element.pos)
                _set(node, "quat", exact_quat(spec, element))
            if kind == "body":
                _inertial(node.find("inertial"), model, element.id)
            if element.name.startswith(_MARK):
                del node.attrib["name"]
    for key, node in zip(spec.keys, root.iterfind("keyframe/key"), strict=True):
        if node.get("qpos") is not None:
            _set(node, "qpos", key.qpos)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _set(node: ElementTree.Element, key: str, values: Any) -> None:
    node.set(key, " ".join(repr(float(v)).removesuffix(".0") for v in np.atleast_1d(values)))


def exact_quat(spec: mujoco.MjSpec, element: Any) -> Array:
    """Orientation of an element as a unit quaternion (4,), in whichever way it was given."""
    if element.alt.type == mujoco.mjtOrientation.mjORIENTATION_QUAT:
        quat = np.array(element.quat)
    else:
        compiler = spec.compiler
        quat = np.array(spec.resolve_orientation(compiler.degree, compiler.eulerseq, element.alt))
    return np.asarray(quat / np.linalg.norm(quat))


def _joint(node: ElementTree.Element, model: mujoco.MjModel, joint: Any) -> None:
    _set(node, "pos", model.jnt_pos[joint.id])
    _set(node, "axis", model.jnt_axis[joint.id])
    if model.jnt_limited[joint.id]:
        _set(node, "range", model.jnt_range[joint.id])
    if model.qpos0[joint.id]:
        _set(node, "ref", model.qpos0[joint.id])


def _inertial(node: ElementTree.Element | None, model: mujoco.MjModel, body: int) -> None:
    if node is None:
        return
    node.attrib.pop("fullinertia", None)
    for key, values in (
        ("pos", model.body_ipos),
        ("quat", model.body_iquat),
        ("mass", model.body_mass),
        ("diaginertia", model.body_inertia),
    ):
        _set(node, key, values[body])
