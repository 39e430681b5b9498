"""What an identification found, in words."""

from collections.abc import Mapping, Sequence
from math import comb
from typing import Any

import numpy as np

from lwa4d_sim.identification.estimate import INTERVAL
from lwa4d_sim.identification.findings import Findings
from lwa4d_sim.identification.grades import LOST, WEAK, WELL, Grades, grades

_LISTED = 6  # names in one sentence (assumed: more are not read)
_NOTHING = 1e-5  # of a parameter's size: less is called nothing (assumed)
UNEXPLAINED = 0.1  # assumed: share of the torque's variation beyond which an estimate is not to be trusted
SLIGHT = 1e-3  # assumed: share of a parameter's size; what is known better than that is not called wrong
_CHANCE = 0.01  # assumed: probability below which so few intervals that hold the truth are no chance
_LINK = {
    "m": "mass of {}",
    "hx": "mass of {} times its centre's x",
    "hy": "mass of {} times its centre's y",
    "hz": "mass of {} times its centre's z",
    "Ixx": "inertia of {} about x",
    "Iyy": "inertia of {} about y",
    "Izz": "inertia of {} about z",
    "Ixy": "product of inertia of {}, x and y",
    "Ixz": "product of inertia of {}, x and z",
    "Iyz": "product of inertia of {}, y and z",
    "viscous": "viscous friction of {}",
    "coulomb": "Coulomb friction of {}",
    "offset": "torque in {} where none is recorded",
    "armature": "reflected rotor inertia of {}",
    "gain": "torque in {} over torque recorded, less one",
}


def squared(unit: str) -> str:
    """A unit as people write it."""
    return unit.replace("^2", "\u00b2")


def meaning(name: str) -> str:
    """What a parameter's name stands for; empty for p1 to p5, whose formula says it."""
    owner, _, what = name.rpartition(".")
    return _LINK[what].format(owner) if owner and what in _LINK else ""


def headline(found: Findings) -> list[str]:
    """Two sentences: how many parameters and how good, and what torque they predict."""
    grade = grades(found)
    well, n = grade.rows(WELL), len(grade.told)
    seconds = found.recording.end - float(found.recording.t.min())
    told = f"All {n}" if len(well) == n else f"{len(well)} of {n}"
    head = f"{told} parameters are well told by {seconds:.3g} s of motion"
    against = doubts(found)
    if against:
        head = f"The estimate is not to be trusted: {'; '.join(against)}"
    elif well:
        head += _furthest(found, grade, well)
    nrmse, joints = found.validation.nrmse, found.recording.joints
    best, before = (f"{percent(e.max())} ({joints[int(e.argmax())]})" for e in (nrmse["estimate"], nrmse["nominal"]))
    return [
        f"{head}.",
        f"On a motion that was not used, the predicted torque has an rms error of at most {best} of its variation, "
        f"that of the nominal model {before}.",
    ]


def _furthest(found: Findings, grade: Grades, well: Sequence[int]) -> str:
    """Which of the parameters ``well`` is worst, and how bad that is."""
    off = grade.half if found.truth is None else np.abs(grade.error)
    share = off[well] / grade.size[well]
    k = int(share.argmax())
    size, name = percent(share[k]), found.problem.parameters.names[well[k]]
    if found.truth is None:
        return f", {name} worst with a 95 % interval of \u00b1 {size}"
    return ", each to 0.001 %" if share[k] < _NOTHING else f", {name} worst with an error of {size}"


def details(found: Findings) -> list[str]:
    """Sentences on what the data do not tell, the intervals, the written model, the bus, and the controllers."""
    grade = grades(found)
    return [
        *_shaking(found),
        *_untold(found, grade),
        *_intervals(found, grade),
        *_written(found),
        *_biases(found, grade),
        *_tried(found),
    ]


def doubts(found: Findings) -> list[str]:
    """What speaks against the estimate, each as half a sentence; empty where nothing does."""
    grade, nrmse = grades(found), {name: float(values.max()) for name, values in found.validation.nrmse.items()}
    out = []
    if found.recording.shook:
        out.append("the loop shook while the data were taken")
    if honest(found, grade) is False:
        out.append(f"only {_holding(grade)}")
    if nrmse["estimate"] > UNEXPLAINED:
        out.append(f"on the other motion it leaves {percent(nrmse['estimate'])} of the torque's variation unexplained")
    if nrmse["identified"] > max(2.0 * nrmse["estimate"], nrmse["estimate"] + 0.05):
        out.append(
            f"no body can have these parameters, and the possible model that was written errs by "
            f"{percent(nrmse['identified'])}: look at signs, units and known values"
        )
    moved = found.bias.get("noise and quantisation of the positions")
    well = grade.rows(WELL)
    if moved is not None and found.problem.options.method != "total":
        beyond = [k for k in well if abs(moved[k]) > grade.half[k] > SLIGHT * grade.size[k]]
        if beyond:
            names = listed([found.problem.parameters.names[k] for k in beyond])
            out.append(f"the positions are too noisy: they move {names} out of the interval; try method: total")
    return out


def sound(found: Findings) -> bool:
    """Whether nothing speaks against it: no `doubts`, nothing lost, and torque no worse than before."""
    nrmse = found.validation.nrmse
    better = nrmse["estimate"].max() <= 1.1 * nrmse["nominal"].max()
    return bool(better and not grades(found).rows(LOST) and not doubts(found))


def _shaking(found: Findings) -> list[str]:
    if not found.recording.shook:
        return []
    return ["What shakes faster than the filter lets pass spoils the equations: lower the gains, and repeat the run."]


def _untold(found: Findings, grade: Grades) -> list[str]:
    names = found.problem.parameters.names
    lost, weak = ([names[k] for k in grade.rows(what)] for what in (LOST, WEAK))
    out = []
    if lost:
        out.append(
            f"The data do not tell {listed(lost)}: no number is given, and what the written model has in their place "
            "comes from the nominal arm."
        )
    if weak:
        out.append(
            f"The data tell {listed(weak)} only weakly: the 95 % interval is wider than such a parameter is large."
        )
    return out


def honest(found: Findings, grade: Grades) -> bool | None:
    """Whether as many intervals hold the truth as chance allows; None where the truth is not known."""
    if found.truth is None:
        return None
    held, n = _held(grade)
    return sum(comb(n, k) * 0.95**k * 0.05 ** (n - k) for k in range(held + 1)) > _CHANCE


def _held(grade: Grades) -> tuple[int, int]:
    """How many intervals hold the truth, of how many."""
    told = np.isfinite(grade.half)
    return int((np.abs(grade.error[told]) <= grade.half[told]).sum()), int(told.sum())


def _holding(grade: Grades) -> str:
    held, n = _held(grade)
    return f"{held} of {n} intervals of 95 % hold the truth"


def _intervals(found: Findings, grade: Grades) -> list[str]:
    out = []
    if found.truth is not None:
        why = (
            ""
            if honest(found, grade)
            else ", fewer than chance allows: something other than noise is wrong with the data"
        )
        out.append(f"{_holding(grade)}{why}.".capitalize())
    if found.coverage is not None:
        share = 100.0 * found.coverage[~found.fit.estimate.lost]
        out.append(
            f"Over {found.repeats} repeats with new noise the intervals hold the truth in {share.mean():.1f} % of all "
            f"cases, {share.min():.1f} to {share.max():.1f} % from parameter to parameter."
        )
    return out


def _written(found: Findings) -> list[str]:
    error = found.validation.nrmse["identified"].max()
    return [
        f"The written model is the physically possible arm that fits best; its torque has an rms error of at "
        f"most {percent(error)} on that motion."
    ]


def _biases(found: Findings, grade: Grades) -> list[str]:
    names, some = found.problem.parameters.names, grade.rows(WELL)
    out = []
    for source, shift in found.bias.items() if some else ():
        share = np.abs(shift[some]) / grade.size[some]
        k = int(share.argmax())
        if share[k] < _NOTHING:
            out.append(f"Bias, {source}: no well-told parameter moves by more than {percent(_NOTHING)}.")
            continue
        moved = int((np.abs(shift[some]) > grade.half[some]).sum())
        beyond = {0: "all stay within", 1: "one leaves"}.get(moved, f"{moved} leave")
        most = f"{names[some[k]]} moves most of the well-told ones, by {percent(share[k])}"
        out.append(f"Bias, {source}: {most}; {beyond} the 95 % interval.")
    return out


def _tried(found: Findings) -> list[str]:
    if found.tried is None:
        return []
    shaky = [name for name, run in found.tried.items() if not run["stable"]]
    if shaky:
        return [f"The controller that was tried shakes with the {' and the '.join(shaky)} model."]
    before, after = (1e3 * joint_error(found.tried[name]) for name in ("nominal", "identified"))
    change = f"{before / after:.3g} times less than" if 0 < after < before else "no less than"
    return [
        f"The controller that was tried leaves a joint error of {after:.3g} mrad with the identified model (rms over "
        f"time, all joints together), {change} with the nominal one ({before:.3g} mrad)."
    ]


def joint_error(metrics: Mapping[str, Any]) -> float:
    """Root mean square of the joint error's length [rad]."""
    return float(np.linalg.norm(metrics["rms_joint_error"]))


def percent(share: float) -> str:
    """A share as a percentage that can be read, rounded up where it is tiny."""
    value = max(100.0 * share, 1e-3)
    if value > 1e4:
        return "more than 10000 %"
    return f"{value:.0f} %" if value >= 9.95 else f"{value:.2g} %"


def interval(found: Findings, k: int) -> tuple[float, float] | None:
    """The 95 % interval of parameter ``k``, None where the data do not tell."""
    x, s = found.fit.estimate.x[k], found.fit.std_error[k]
    return (float(x - INTERVAL * s), float(x + INTERVAL * s)) if np.isfinite(x) and np.isfinite(s) else None


def listed(names: Sequence[str]) -> str:
    """Some of the names, and how many more."""
    shown = list(names[:_LISTED])
    more = len(names) - len(shown)
    if more:
        return f"{', '.join(shown)} and {more} more"
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"
