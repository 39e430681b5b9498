"""Writes identified parameters back: the arm's own MJCF with new inertias and joint parameters, in full precision.

MuJoCo's writer rounds to six digits and turns every orientation into a quaternion, so the source's XML is edited: what
is not identified stays as its author wrote it, comments included.
"""

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.errors import IdentificationError, ModelError, RecordError
from lwa4d_sim.identification.consistent import margin
from lwa4d_sim.identification.inertia import NAMES, inertia_matrix, standard_parameters
from lwa4d_sim.identification.parameters import Unknowns
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of, home, load_model, torque_limits
from lwa4d_sim.rotations import rotation_vector

_AGREE = 1e-9  # of a link's size: what is read back equals what was written (rounding of metres for a link of 1 um)
_KIND = [0, 1, 1, 1, 2, 2, 2, 2, 2, 2]  # of the ten parameters: kg, kg m, kg m^2
_OVERRULE = ("settotalmass", "boundmass", "boundinertia")  # compiler attributes that change an inertia after reading
_FOLDERS = ("meshdir", "texturedir")


def write_model(
    source: Path,
    destination: Path,
    *,
    pi: Array,
    armature: Array,
    viscous: Array,
    coulomb: Array,
    about: str,
) -> None:
    """Write an MJCF equal to ``source`` but for these parameters, whole or not at all, after loading it as a check.

    A link's inertia goes to its own body; bodies welded to it keep their shape and lose their mass. Files that the
    source includes are put in; meshes and textures are named by their path from the new file. Where the friction is too
    stiff for the source's explicit integrator, the file asks for ``implicitfast``.

    Args:
        source: MJCF of the nominal arm.
        destination: the new file.
        pi: inertial parameters of the links (n, 10), see `lwa4d_sim.identification.inertia`.
        armature: reflected rotor inertia (n,) [kg m^2].
        viscous: friction (n,) [N m s/rad].
        coulomb: friction (n,) [N m].
        about: where the numbers come from, for a comment.

    Raises:
        IdentificationError: no body can have such an inertia, a joint parameter is negative, or the source is built in
            a way that cannot be edited.
        ModelError: the source is no arm.
        RecordError: a file cannot be read or written.
    """
    model = load_model(str(source))
    joints = {"armature": armature, "damping": viscous, "frictionloss": coulomb}
    _check(pi, joints, model.njnt)
    partial = destination.with_name(f".{destination.stem}.part.xml")
    try:
        if destination.exists() and destination.samefile(source):
            raise IdentificationError(f"{destination}: is the nominal model itself; write to another file")
        root = _read(source)
        links = _links(root, [model.joint(j).name for j in range(model.njnt)], source)
        _edit(root, links, pi, joints)
        destination.parent.mkdir(parents=True, exist_ok=True)
        _move(root, source, destination)
        _write(partial, root, about)
        try:
            written = load_model(str(partial))
        except ModelError:  # stiff friction is the one thing that another integrator mends; anything else comes back
            _option(root).set("integrator", "implicitfast")
            _write(partial, root, f"{about}\nIts friction is too stiff for the integrator of the nominal model.")
            written = load_model(str(partial))
        _verify(written, model, pi, joints, source)
        os.replace(partial, destination)
    except ModelError as error:
        raise IdentificationError(f"{destination}: cannot be written so that it loads: {error}") from error
    except OSError as error:
        raise RecordError(f"{destination}: cannot write the model ({error})") from error
    finally:
        with suppress(OSError):
            partial.unlink()


def write_unknowns(unknowns: Unknowns, values: Array, source: Path, destination: Path, about: str) -> None:
    """Write the arm with these values (P,) of its unknowns; offsets and gains have no place in an MJCF.

    Raises:
        ModelError: it cannot be written, see `write_model`.
    """
    write_model(
        source,
        destination,
        pi=values[: 10 * unknowns.n].reshape(unknowns.n, 10),
        armature=values[unknowns.columns("armature")],
        viscous=values[unknowns.columns("viscous")],
        coulomb=values[unknowns.columns("coulomb")],
        about=about,
    )


def _check(pi: Array, joints: dict[str, Array], n: int) -> None:
    if pi.shape != (n, 10) or any(values.shape != (n,) for values in joints.values()):
        raise IdentificationError(f"parameters of {len(pi)} links do not fit an arm of {n}")
    for k in range(n):
        if not np.isfinite(pi[k]).all():
            bad = int(np.argmin(np.isfinite(pi[k])))
            raise IdentificationError(f"link {k + 1}: {NAMES[bad]} is {pi[k, bad]:g}; it must be finite")
        if not margin(pi[k]) > 0:
            raise IdentificationError(f"link {k + 1}: no body has this inertia; take consistent parameters")
        for name, values in joints.items():
            if not (values[k] >= 0 and np.isfinite(values[k])):
                raise IdentificationError(f"joint {k + 1}: {name} is {values[k]:g}; it must be at least 0")


def _read(source: Path) -> ET.Element:
    """The source with all that it includes."""
    root = _parse(source)
    if root.tag != "mujoco":
        raise IdentificationError(f"{source}: its root is <{root.tag}>; only an MJCF file (<mujoco>) can be rewritten")
    _include(root, source.parent, source.parent)
    return root


def _parse(path: Path) -> ET.Element:
    try:
        return ET.parse(path, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))).getroot()
    except (ET.ParseError, ValueError) as error:
        raise IdentificationError(f"{path}: cannot be rewritten, it is not plain XML ({error})") from error


def _include(element: ET.Element, main: Path, here: Path) -> None:
    """Put included files in place of their tags; they are sought where the main file is, then where the tag is."""
    for index, child in reversed(list(enumerate(element))):
        if child.tag != "include":
            _include(child, main, here)
            continue
        path = next((p for p in (main / child.get("file", ""), here / child.get("file", "")) if p.is_file()), None)
        if path is None:
            raise IdentificationError(f"{main / child.get('file', '')}: cannot read what the model includes")
        part = _parse(path)
        _include(part, main, path.parent)
        element[index : index + 1] = list(part)


def _bodies(element: ET.Element) -> Iterator[ET.Element]:
    """Bodies right below an element, frames looked through."""
    for child in element:
        if child.tag == "body":
            yield child
        elif child.tag == "frame":
            yield from _bodies(child)


def _links(root: ET.Element, names: list[str], source: Path) -> list[tuple[ET.Element, list[ET.Element]]]:
    """Each link's body and the bodies welded to it, in the order of the chain."""
    links: list[tuple[ET.Element, list[ET.Element]]] = []

    def follow(element: ET.Element, link: int | None) -> None:
        for body in _bodies(element):
            if body.find("joint") is not None:
                links.append((body, []))
                follow(body, len(links) - 1)
            else:
                if link is not None:
                    links[link][1].append(body)
                follow(body, link)

    for world in root.findall("worldbody"):
        follow(world, None)
    found = [body.find("joint").get("name", "") for body, _ in links]  # type: ignore[union-attr]
    if found != names:
        raise IdentificationError(
            f"{source}: its joints {', '.join(names)} do not stand there one by one as <joint> in <body>; a model that "
            "replicates or attaches parts cannot be rewritten"
        )
    return links


def _edit(
    root: ET.Element, links: list[tuple[ET.Element, list[ET.Element]]], pi: Array, joints: dict[str, Array]
) -> None:
    for compiler in root.findall("compiler"):
        for attribute in _OVERRULE:
            compiler.attrib.pop(attribute, None)
        if compiler.get("inertiafromgeom") == "true":
            compiler.set("inertiafromgeom", "auto")  # from shapes only where no inertia is given
    for k, (body, welded) in enumerate(links):
        _set_inertia(body, pi[k])
        for other in welded:
            _inertial(other).update(pos="0 0 0", mass="0", diaginertia="0 0 0")
        joint = body.find("joint")
        assert joint is not None  # that is what made it a link
        joint.set("damping", f"{_text(joints['damping'][k])} 0 0")  # linear, quadratic and cubic in speed
        joint.set("armature", _text(joints["armature"][k]))
        joint.set("frictionloss", _text(joints["frictionloss"][k]))


def _set_inertia(body: ET.Element, pi: Array) -> None:
    """The link's inertia about its centre of mass, along principal axes.

    Moments about these axes are sums of two second moments, so that A + B >= C holds for what is written and not only
    for what was meant.
    """
    com = pi[1:4] / pi[0]
    I = inertia_matrix(pi) - pi[0] * (com @ com * np.eye(3) - np.outer(com, com))
    second, axes = np.linalg.eigh(0.5 * np.trace(I) * np.eye(3) - I)
    second = np.maximum(second, np.finfo(float).eps * second[-1])
    axes[:, 2] *= np.linalg.det(axes)
    # MuJoCo takes axes within a microradian of the body's for the body's: name them so that they are far from those
    order = min(([0, 1, 2], [1, 2, 0], [2, 0, 1]), key=lambda order: float(np.trace(axes[:, order])))
    second, turn = second[order], rotation_vector(axes[:, order])
    half = 0.5 * np.linalg.norm(turn)
    _inertial(body).update(
        pos=_text(*com),
        quat=_text(np.cos(half), *(0.5 * np.sinc(half / np.pi) * turn)),
        mass=_text(pi[0]),
        diaginertia=_text(*(second.sum() - second)),
    )


def _inertial(body: ET.Element) -> dict[str, str]:
    """Attributes of the body's <inertial>, emptied; made where it has none."""
    element = body.find("inertial")
    if element is None:
        element = ET.Element("inertial")
        body.insert(0, element)
    element.attrib.clear()
    return element.attrib


def _text(*numbers: float) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _option(root: ET.Element) -> ET.Element:
    """The last <option>, for later ones overrule earlier ones; made where there is none."""
    options = root.findall("option")
    return options[-1] if options else ET.SubElement(root, "option")


def _move(root: ET.Element, source: Path, destination: Path) -> None:
    """Name the folders of meshes and textures by their way from the destination."""
    old, new = source.resolve().parent, destination.resolve().parent
    if old == new or not any(name.startswith("file") for element in root.iter() for name in element.attrib):
        return
    folders = dict.fromkeys(_FOLDERS, "")
    compilers = root.findall("compiler") or [ET.SubElement(root, "compiler")]
    for compiler in compilers:  # later ones overrule earlier ones, and a folder of one kind that of both
        both = compiler.attrib.pop("assetdir", None)
        for name in _FOLDERS:
            folders[name] = compiler.attrib.pop(name, folders[name] if both is None else both)
    for name, folder in folders.items():
        compilers[0].set(name, Path(os.path.relpath(old / folder, new)).as_posix())


def _write(path: Path, root: ET.Element, about: str) -> None:
    comment = re.sub(r"-(?=-)", "- ", f" {about.strip()} ")  # XML allows no double hyphen in a comment
    ET.indent(root)
    path.write_text(f"<!--{comment}-->\n{ET.tostring(root, encoding='unicode')}\n", encoding="utf-8")


def _verify(written: Any, model: Any, pi: Array, joints: dict[str, Array], source: Path) -> None:
    """Hold what was written, as MuJoCo reads it, to what was asked and to the source."""
    trace = pi[:, [4, 6, 9]].sum(axis=-1)
    size = np.stack([pi[:, 0], np.sqrt(pi[:, 0] * trace), trace], axis=-1)  # kg, kg m, kg m^2; none exceeds it
    ours, theirs = chain_of(written), chain_of(model)
    same = (
        (np.abs(standard_parameters(written) - pi) <= _AGREE * size[:, _KIND]).all()
        and all(np.array_equal(getattr(written, f"dof_{name}"), values) for name, values in joints.items())
        and all(np.array_equal(getattr(ours, f.name), getattr(theirs, f.name)) for f in fields(ours))
        and np.array_equal(home(written), home(model))
        and np.array_equal(torque_limits(written), torque_limits(model))
        and np.array_equal(written.opt.gravity, model.opt.gravity)
    )
    if not same:
        raise IdentificationError(f"{source}: does not come back as it was with new parameters; cannot be rewritten")
