"""A tuned scenario as a file of its own: the document with new gains, checked by running it."""

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.scenario_file import make_absolute, place_for, write_scenario
from lwa4d_sim.tuning import Tuned, Wish

_MADE = "Made by lwa4d-sim tune"


def tuned_document(scenario: Scenario, variant: str, tuned: Tuned, name: str) -> dict[str, Any]:
    """The scenario's document with the gains found; it expects of the tuned variant that it is stable, and no more."""
    document = deepcopy(dict(scenario.changed(tuned.overrides, variant).document))
    document["name"] = name
    document["expect"] = {variant: {"stable": True}}
    for block in (document, *(document.get("variants") or {}).values()):
        make_absolute(block or {}, scenario.folder)
    return document


def tuned_place(scenario: Scenario, out: Path) -> Path:
    """The file that the tuned scenario goes into, after making sure that it may.

    Raises:
        RecordError: a folder cannot be there, or there is a file that was not made by a tuning.
    """
    return place_for(out / f"{scenario.name}_tuned.yaml", _MADE)


def write_tuned(path: Path, document: Mapping[str, Any], scenario: Scenario, variant: str, wish: Wish) -> None:
    """Write the scenario, whole or not at all.

    Raises:
        RecordError: it cannot be written.
    """
    what = {"one": "one factor on all gains", "two": "kp and kd", "joints": "kp and kd of each joint"}[wish.gains]
    remarks = [
        f"{scenario.name}, variant {variant}, tuned: {what}, for the {_aim(wish)}",
        f"that bears {wish.gain_margin:g} times its gains and {1e3 * wish.delay_margin:g} ms more delay everywhere.",
        f"{_MADE} from {scenario.source}; other variants have the gains that they had.",
    ]
    write_scenario(path, remarks, document)


def _aim(wish: Wish) -> str:
    return "fastest loop" if wish.objective == "bandwidth" else "least error"


def verified(scenario: Scenario, variant: str, tuned: Tuned) -> dict[str, dict[str, Any]]:
    """Metrics of a run with the gains before and after."""
    after = scenario.changed(tuned.overrides, variant)
    return {"before": run(scenario, variant).metrics(), "after": run(after, variant).metrics()}
