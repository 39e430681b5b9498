"""The command `lwa4d-sim tune`."""

import json
import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.console import Json, Out, Set, busy, override, scenario_path
from lwa4d_sim.errors import ScenarioError


class GainsOption(StrEnum):
    """What may be changed."""

    one = "one"
    two = "two"
    joints = "joints"


class ObjectiveOption(StrEnum):
    """What is to be best."""

    bandwidth = "bandwidth"
    error = "error"


class OverOption(StrEnum):
    """Where the margins must hold."""

    waypoints = "waypoints"
    workspace = "workspace"


def tune(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Scenario file, or the name of a shipped one.")],
    variant: Annotated[
        str | None, typer.Option("--variant", metavar="NAME", help="Default: the first variant with a bus.")
    ] = None,
    gains: Annotated[
        GainsOption, typer.Option(help="one factor on all gains; two: kp and kd; joints: kp and kd of each joint.")
    ] = GainsOption.one,
    objective: Annotated[
        ObjectiveOption, typer.Option(help="Largest bandwidth, or least rms error of the tool in a run.")
    ] = ObjectiveOption.bandwidth,
    gain_margin: Annotated[float, typer.Option(metavar="FACTOR", help="All gains must bear this factor.")] = 2.0,
    delay_margin: Annotated[float, typer.Option(metavar="SECONDS", help="More latency that it must bear.")] = 0.0,
    peak: Annotated[float, typer.Option(metavar="FACTOR", help="No reference is amplified more (two, joints).")] = 1.3,
    over: Annotated[OverOption, typer.Option(help="Where that must hold.")] = OverOption.waypoints,
    out: Out = Path("runs"),
    overrides: Set = None,
    as_json: Json = False,
) -> None:
    """Find the gains that make the loop fastest and still bear a stated margin; write them back as a scenario.

    Exit code 1 when a run with them is not stable all the same.

    Example: lwa4d-sim tune pd_joint_p2.5 --gain-margin 2 --delay-margin 0.005 -o runs
    """
    from lwa4d_sim.scenario import Scenario
    from lwa4d_sim.stability.analysis import default_variant
    from lwa4d_sim.tuned_file import tuned_document, tuned_place, verified, write_tuned
    from lwa4d_sim.tuning import Wish, tune

    _require("--gain-margin", gain_margin, 1.0, 1000.0)
    _require("--delay-margin", delay_margin, 0.0, 0.1)
    _require("--peak", peak, 1.0, 100.0)
    scenario = Scenario.load(scenario_path(file), dict(override(text) for text in overrides or []))
    name = default_variant(scenario, variant)
    wish = Wish(
        gains=gains.value,
        objective=objective.value,
        gain_margin=gain_margin,
        delay_margin=delay_margin,
        peak=peak,
        workspace=over is OverOption.workspace,
    )
    path = tuned_place(scenario, out)
    with busy(f"tuning {scenario.name}", quiet=as_json):
        found = tune(scenario, name, wish)
        runs = verified(scenario, name, found)
    write_tuned(path, tuned_document(scenario, name, found, path.stem), scenario, name, wish)
    answer = {
        "gains": dict(found.overrides),
        "variant": name,
        "file": str(path),
        "gain_margin": _number(found.gain_margin),
        "delay_margin": _number(found.delay_margin),
        "evaluations": found.evaluations,
        **{
            side: {"bandwidth": float(t.bandwidth[0]), "peak": _number(float(t.peak[0])), "metrics": runs[side]}
            for side, t in (("before", found.before), ("after", found.after))
        },
    }
    if as_json:
        print(json.dumps(answer))
    else:
        _print(answer, wish.gains != "one" and float(found.after.peak[0]) > peak * 1.001)
    raise typer.Exit(0 if runs["after"]["stable"] else 1)


def _require(option: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise ScenarioError(f"{option} (={value:g}): must be from {least:g} to {most:g}")


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _print(answer: dict[str, Any], pointed: bool) -> None:
    for key, value in answer["gains"].items():
        values = value if isinstance(value, list) else [value]
        print(f"{key:28} {', '.join('none' if each is None else f'{each:.4g}' for each in values)}")
    print(f"\n{'':28} {'before':>12} {'after':>12}")
    rows = [("bandwidth [Hz]", "bandwidth", "{:.3f}"), ("largest amplification", "peak", "{:.2f}")]
    for text, key, form in rows:
        cells = ["-" if answer[side][key] is None else form.format(answer[side][key]) for side in ("before", "after")]
        print(f"{text:28} {cells[0]:>12} {cells[1]:>12}")
    before, after = (_told(answer[side]["metrics"]) for side in ("before", "after"))
    for text in before:
        print(f"{text:28} {before[text]:>12} {after[text]:>12}")
    gain = "any factor" if answer["gain_margin"] is None else f"{answer['gain_margin']:.2f} times these gains"
    delay = "any delay" if answer["delay_margin"] is None else f"{1e3 * answer['delay_margin']:.2f} ms more delay"
    print(f"\nbears {gain}, or {delay}, at every pose looked at")
    if pointed:
        print("no gains were found that also keep the amplification asked for")
    print(f"scenario: {answer['file']}")


def _told(metrics: dict[str, Any]) -> dict[str, str]:
    return {
        "run": "stable" if metrics["stable"] else "UNSTABLE",
        "rms error of the tool [mm]": f"{1e3 * metrics['rms_error']:.2f}",
        "largest error at ends [mm]": _largest(metrics["final_error"]),
    }


def _largest(errors: list[float | None]) -> str:
    known = [error for error in errors if error is not None]
    return f"{1e3 * max(known):.2f}" if known else "-"
