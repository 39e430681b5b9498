"""The command `lwa4d-sim stability`: is the loop stable, by how much, and what would shake first."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.console import Json, Out, Set, busy, override, progress, scenario_path
from lwa4d_sim.errors import ScenarioError

_PIPE_WIDTH = 160  # columns where nobody watches


def stability(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Scenario file, or name of a shipped one.")],
    out: Out = Path("runs"),
    variant: Annotated[str | None, typer.Option(metavar="NAME", help="Variant; default the first with a bus.")] = None,
    overrides: Set = None,
    poses: Annotated[
        list[str] | None,
        typer.Option("--pose", metavar="Q1,Q2,...", help="A pose [rad] instead of the waypoints; repeatable."),
    ] = None,
    joints: Annotated[
        str | None, typer.Option(metavar="A,B", help="The two joints that the map moves, counted from 1.")
    ] = None,
    size: Annotated[int, typer.Option(metavar="N", min=2, max=500, help="Angles of each joint of the map.")] = 50,
    no_plots: Annotated[
        bool, typer.Option("--no-plots", help="Margins only: no charts, no map, nothing written.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Say whether the loop is stable at each waypoint, how far its gains and delays may grow, and what shakes first.

    Example: lwa4d-sim stability pd_joint_p2.5 -o runs
    """
    from lwa4d_sim.scenario import Scenario
    from lwa4d_sim.stability.findings import CURVES, check_joints, find, points_as_objects, with_charts
    from lwa4d_sim.stability.folder import claim_for, write_findings
    from lwa4d_sim.stability.words import details, headline

    scenario = Scenario.load(scenario_path(file), dict(override(text) for text in overrides or []))
    folder = None if no_plots else claim_for(scenario, out)
    with busy("margins", quiet=as_json):
        found, points = find(scenario, variant, poses or [])
    pair = check_joints(found.study, None if joints is None else _pair(joints))
    if folder is not None:
        with progress("map and charts", CURVES + (size if pair else 0), quiet=as_json) as advance:
            found = with_charts(found, points, pair, size, advance)
        with busy("drawing", quiet=as_json):
            write_findings(folder, found)
    if as_json:
        print(
            json.dumps(
                {
                    "name": scenario.name,
                    "variant": found.variant,
                    "verdict": headline(found),
                    "points": points_as_objects(found),
                    "remarks": list(found.remarks),
                    "folder": None if folder is None else str(folder),
                }
            )
        )
        return
    print(f"{scenario.name}, {found.variant}" + ("" if folder is None else f"  ->  {folder}"))
    _print_table(found)
    for text in (headline(found), *details(found), *(f"note: {remark}" for remark in found.remarks)):
        print(text)
    if folder is not None:
        print(f"report: {folder / 'report.html'}")


def _pair(text: str) -> tuple[int, int]:
    try:
        first, second = (int(part) for part in text.split(","))
    except ValueError:
        raise ScenarioError(f"--joints {text}: must be two joint numbers, e.g. 2,3") from None
    return first - 1, second - 1


def _print_table(found: Any) -> None:
    from rich.console import Console
    from rich.table import Table

    from lwa4d_sim.stability.words import factor, milliseconds, radius, unstable

    columns = (
        "",
        "",
        "spectral radius",
        "gain margin",
        "delay margin [ms]",
        "jitter margin [ms]",
        "mode [Hz]",
        "joint",
    )
    table = Table(*columns, box=None, pad_edge=False)
    for name, point in zip(found.names, found.points, strict=True):
        table.add_row(
            name,
            "UNSTABLE" if unstable(point) else "stable",
            radius(point.spectral_radius),
            factor(point.gain_margin),
            milliseconds(point.delay_margin),
            milliseconds(point.jitter_margin),
            f"{point.mode.frequency:.1f}",
            str(int(point.mode.share.argmax()) + 1),
        )
    Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH, highlight=False, markup=False).print(table)
