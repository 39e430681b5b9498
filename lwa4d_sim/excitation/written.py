"""An excitation for a scenario's arm, and the scenario that runs it."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.controllers.belief import believed_model
from lwa4d_sim.errors import LwaError, ScenarioError
from lwa4d_sim.excitation.design import Excitation, ExcitationWish, optimise
from lwa4d_sim.excitation.limits import known_speeds
from lwa4d_sim.mjcf import home, load_model
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.scenario_file import make_absolute, place_for, write_scenario
from lwa4d_sim.settings import IdealLoop

_MADE = "Made by lwa4d-sim excite"


def excitation_for(
    scenario: Scenario,
    variant: str,
    wish: ExcitationWish,
    speed: float | Sequence[float] | None = None,
    progress: Callable[[], None] = lambda: None,
) -> Excitation:
    """A motion for the arm of a scenario, as its controller believes it to be, from its start, at its period.

    Args:
        scenario: where arm, belief, start and period are taken from.
        variant: of the scenario.
        wish: what the motion shall be like; its control period is replaced by the scenario's.
        speed: largest joint speeds [rad/s]; needed where the arm is none of the shipped ones.
        progress: see `optimise`.

    Raises:
        ModelError: the arm cannot be loaded.
        ScenarioError: its start does not fit it.
        IdentificationError: no such motion, see `optimise`.
    """
    settings = scenario.variants[variant]
    key = "arm"
    try:
        load_model(settings.arm, base=scenario.folder)  # so that what is wrong from here on is wrong with the belief
        key = "controller.model"
        model = believed_model(settings.controller.model, settings.arm, scenario.folder)
        key = "initial.q"
        start = home(model) if settings.initial.q is None else np.asarray(settings.initial.q)
        if len(start) != model.njnt:
            raise ScenarioError(f"has {len(start)} values, the arm has {model.njnt} joints")
    except LwaError as error:
        raise scenario.locate(error, key, variant) from error
    loop = settings.loop
    period = settings.plant.timestep if isinstance(loop, IdealLoop) else loop.period
    speeds = known_speeds(settings.arm, speed, model.njnt)
    return optimise(model, start, speeds, replace(wish, control_period=period), progress)


def excited_place(scenario: Scenario, out: Path) -> Path:
    """The file that the scenario with the motion goes into, after making sure that it may.

    Raises:
        RecordError: it may not.
    """
    return place_for(out / f"excite_{scenario.name}.yaml", _MADE)


def write_excited(path: Path, scenario: Scenario, variant: str, found: Excitation, wish: ExcitationWish) -> None:
    """Write the scenario with the motion found; its variants keep all but their own motions and starts.

    Raises:
        RecordError: it cannot be written.
    """
    document = excited_document(scenario, variant, found, path.stem)
    remarks = [
        f"Excites {found.parameters} base parameters of the arm in {scenario.name}, variant {variant}: "
        f"{wish.harmonics} harmonics, {wish.period:g} s, seed {wish.seed}.",
        f"Log determinant of the information {found.after.log_det:.2f}, condition number {found.after.condition:.1f}.",
        f"{_MADE} from {scenario.source}; the start is where the arm must stand, and rest, when it begins.",
    ]
    write_scenario(path, remarks, document)


def excited_document(scenario: Scenario, variant: str, found: Excitation, name: str) -> dict[str, Any]:
    """The scenario's document with the motion found and its start; it expects nothing."""
    document = deepcopy(dict(scenario.document))
    document.pop("expect", None)
    arm = scenario.variants[variant].arm
    kept = {
        key: {part: value for part, value in (block or {}).items() if part not in ("trajectory", "initial")}
        for key, block in (document.pop("variants", None) or {}).items()
        if scenario.variants[key].arm == arm
    }
    motion = found.motion
    document |= {
        "name": name,
        "arm": arm,
        "initial": {"q": [float(angle) for angle in found.start]},
        "trajectory": {
            "kind": "fourier",
            "omega": motion.omega,
            "duration": motion.duration,
            "lead_in": motion.lead_in,
            "lead_out": motion.lead_out,
            "offset": list(motion.offset or ()),
            "a": [list(row) for row in motion.a],
            "b": [list(row) for row in motion.b],
        },
    }
    if kept:
        document["variants"] = kept
    for block in (document, *kept.values()):
        make_absolute(block, scenario.folder)
    return document
