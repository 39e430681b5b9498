"""A tuned scenario as a file of its own: the document with new gains, checked by running it."""

import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

from lwa4d_sim.arm import ARMS
from lwa4d_sim.errors import RecordError
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.tuning import Tuned, Wish
from lwa4d_sim.yaml_text import dump

_MADE = "# Made by lwa4d-sim tune"


def tuned_document(scenario: Scenario, variant: str, tuned: Tuned, name: str) -> dict[str, Any]:
    """The scenario's document with the gains found; it expects of the tuned variant that it is stable, and no more."""
    document = deepcopy(dict(scenario.changed(tuned.overrides, variant).document))
    document["name"] = name
    document["expect"] = {variant: {"stable": True}}
    for block in (document, *(document.get("variants") or {}).values()):
        _make_absolute(block or {}, scenario.folder)
    return document


def _make_absolute(block: dict[str, Any], folder: Path) -> None:
    """Paths that began at the old file's folder begin at the root, for the new file stands elsewhere."""
    if isinstance(block.get("arm"), str) and block["arm"] not in ARMS:
        block["arm"] = str((folder / block["arm"]).resolve())
    trajectory = block.get("trajectory")
    if isinstance(trajectory, dict) and isinstance(trajectory.get("file"), str):
        trajectory["file"] = str((folder / trajectory["file"]).resolve())


def place_for(scenario: Scenario, out: Path) -> Path:
    """The file that the tuned scenario goes into, after making sure that it may.

    Raises:
        RecordError: a folder cannot be there, or there is a file that was not made by a tuning.
    """
    path = out / f"{scenario.name}_tuned.yaml"
    try:
        ours = not path.exists() or _MADE in path.read_text(encoding="utf-8", errors="replace")
        # the nearest folder that is there already, so that bad input leaves not even an empty folder behind
        with tempfile.TemporaryFile(dir=next(place for place in (out, *out.absolute().parents) if place.exists())):
            pass
    except OSError as error:
        raise RecordError(f"{path}: cannot write the tuned scenario ({error.strerror})") from error
    if not ours:
        raise RecordError(f"{path}: is there already and was not made by a tuning; choose another folder with -o")
    return path


def write_tuned(path: Path, document: Mapping[str, Any], scenario: Scenario, variant: str, wish: Wish) -> None:
    """Write the scenario, whole or not at all.

    Raises:
        RecordError: it cannot be written.
    """
    what = {"one": "one factor on all gains", "two": "kp and kd", "joints": "kp and kd of each joint"}[wish.gains]
    lines = [
        f"# {scenario.name}, variant {variant}, tuned: {what}, for the {_aim(wish)}",
        f"# that bears {wish.gain_margin:g} times its gains and {1e3 * wish.delay_margin:g} ms more delay everywhere.",
        f"{_MADE} from {scenario.source}; other variants have the gains that they had.",
    ]
    partial = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text("\n".join(lines) + "\n" + dump(dict(document)), encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise RecordError(f"{path}: cannot write the tuned scenario ({error.strerror})") from error


def _aim(wish: Wish) -> str:
    return "fastest loop" if wish.objective == "bandwidth" else "least error"


def verified(scenario: Scenario, variant: str, tuned: Tuned) -> dict[str, dict[str, Any]]:
    """Metrics of a run with the gains before and after."""
    after = scenario.changed(tuned.overrides, variant)
    return {"before": run(scenario, variant).metrics(), "after": run(after, variant).metrics()}
