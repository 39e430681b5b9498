"""The command `lwa4d-sim identify`: from joint torques to the arm's parameters and a model with them."""

import json
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.console import Json, Out, Set, busy, override, progress, scenario_path
from lwa4d_sim.errors import ScenarioError

_FEW = 24  # parameters that fit on a screen; of more, those with the widest intervals are left to the report


def identify(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Scenario file, or name of a shipped one.")],
    data: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Measured data in place of a simulation: CSV, Parquet, run record, CAN log."),
    ] = None,
    validation_data: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The same of a second motion; default the last part of the first."),
    ] = None,
    eds: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="Data sheets (EDS, DCF) of the drives in a CAN log, or their folder; repeatable."
        ),
    ] = None,
    repeats: Annotated[
        int,
        typer.Option(metavar="N", min=0, help="Draw the noise N times more: how often do intervals hold the truth?"),
    ] = 0,
    out: Out = Path("runs"),
    variant: Annotated[str | None, typer.Option(metavar="NAME", help="Variant; default the first.")] = None,
    overrides: Set = None,
    no_plots: Annotated[bool, typer.Option("--no-plots", help="Model, parameters and numbers only.")] = False,
    as_json: Json = False,
) -> None:
    """Estimate the arm's parameters from its motion, check them on another motion, and write a model with them.

    Example: lwa4d-sim identify identify_planar_can -o runs
    """
    from lwa4d_sim.identification.experiment import Experiment
    from lwa4d_sim.identification.findings import STEPS
    from lwa4d_sim.identification.findings import identify as run_identification
    from lwa4d_sim.identification.folder import as_object, claim_for, write_findings
    from lwa4d_sim.identification.sources import read_data
    from lwa4d_sim.scenario import Scenario

    if data is None and (validation_data is not None or eds):
        raise ScenarioError("--validation-data and --eds belong to --data")
    if data is not None and repeats:
        raise ScenarioError("--repeats draws noise for a simulated arm; it does not go with --data")
    scenario = Scenario.load(scenario_path(file), dict(override(text) for text in overrides or []))
    experiment = Experiment.of(scenario, variant)
    given = [path for path in (data, validation_data, *(eds or [])) if path is not None]
    if data is not None and validation_data is not None and data.resolve() == validation_data.resolve():
        raise ScenarioError(f"--validation-data {validation_data}: must be another motion than --data")
    folder = claim_for(scenario, out, given)
    with tempfile.TemporaryDirectory() as scratch:
        model = Path(scratch) / "identified.xml"
        recordings = None
        if data is not None:
            with busy(f"reading {data}", quiet=as_json):
                second = None if validation_data is None else read_data(validation_data, experiment, eds or [])
                recordings = read_data(data, experiment, eds or []), second
        with progress(f"identifying {scenario.name}", repeats + STEPS, quiet=as_json) as advance:
            found = run_identification(experiment, model, data=recordings, repeats=repeats, advance=advance)
        with busy("drawing", quiet=as_json or no_plots):
            write_findings(folder, found, model, plots=not no_plots, data=_told_again(data, validation_data, eds))
    answer = as_object(found)
    answer["folder"] = str(folder)
    if as_json:
        print(json.dumps(answer))
        return
    _print(found, answer, report=not no_plots)
    print(f"model: {folder / 'identified.xml'}")
    if not no_plots:
        print(f"report: {folder / 'report.html'}")


def _told_again(data: Path | None, second: Path | None, sheets: list[Path] | None) -> list[str]:
    """The options that name the data, for whoever wants to repeat the command."""
    named = [("--data", data), ("--validation-data", second), *(("--eds", sheet) for sheet in sheets or [])]
    return [word for option, value in named if value is not None for word in (option, str(value))]


def _print(found: Any, answer: dict[str, Any], *, report: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    from lwa4d_sim.identification.words import details, headline

    rows = list(answer["parameters"].items())
    shown = sorted(rows, key=_doubt)[:_FEW] if len(rows) > _FEW else rows
    truth = found.truth is not None
    columns = ["parameter", "estimate", "std. error", *(["truth"] if truth else []), "unit", "stands for"]
    table = Table(*columns, box=None, pad_edge=False)
    for name, row in rows:
        if (name, row) in shown:
            numbers = [row["estimate"], row["std_error"], *([row["truth"]] if truth else [])]
            forms = [
                ("{:.6g}", "{:.2g}", "{:.6g}")[k].format(v) if v is not None else "not seen"
                for k, v in enumerate(numbers)
            ]
            table.add_row(name, *forms, row["unit"], row["words"])
    Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False).print(table)
    if len(shown) < len(rows):
        where = "the report" if report else "parameters.yaml"
        print(f"({len(rows) - len(shown)} more, less certain ones, in {where})")
    for text in (*headline(found), *details(found), *(f"note: {remark}" for remark in found.remarks)):
        print(text)


def _doubt(item: tuple[str, dict[str, Any]]) -> float:
    row = item[1]
    if row["estimate"] is None or not row["estimate"]:
        return float("inf")
    return float(row["std_error"] / abs(row["estimate"]))
