"""The command line `lwa4d-sim`. Exit codes: 0 fine, 1 an expectation failed, 2 bad input."""

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.bus_cli import bus_app
from lwa4d_sim.calibrate_cli import calibrate
from lwa4d_sim.console import Json, Out, Set, busy, complain, override, progress, scenario_path, shipped_scenarios
from lwa4d_sim.errors import LwaError, ScenarioError
from lwa4d_sim.excite_cli import excite
from lwa4d_sim.identify_cli import identify
from lwa4d_sim.stability_cli import stability
from lwa4d_sim.sweep_cli import shipped_sweeps, sweep
from lwa4d_sim.tune_cli import tune

app = typer.Typer(
    name="lwa4d-sim",
    help="What a 10 ms CAN bus does to a robot-arm controller: run scenarios, check them, report them.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


app.add_typer(bus_app, name="bus")
app.command()(stability)
app.command()(sweep)
app.command()(tune)
app.command()(excite)
app.command()(identify)
app.command()(calibrate)


@app.command()
def run(
    files: Annotated[list[str], typer.Argument(metavar="FILE...", help="Scenario files, or names of shipped ones.")],
    out: Out = Path("runs"),
    overrides: Set = None,
    no_plots: Annotated[bool, typer.Option("--no-plots", help="Write records and summary only.")] = False,
    video: Annotated[bool, typer.Option("--video", help="Also render the arm as an animated picture.")] = False,
    as_json: Json = False,
) -> None:
    """Run scenarios and write one folder of results for each.

    Example: lwa4d-sim run pd_joint_p2.5 --set controller.kp=2.0 -o runs
    """
    from lwa4d_sim.results import passed, run_scenario
    from lwa4d_sim.scenario import Scenario

    values = dict(override(text) for text in overrides or [])
    scenarios = [Scenario.load(scenario_path(file), values) for file in files]
    names = [scenario.name for scenario in scenarios]
    for name in names:
        if names.count(name) > 1:
            raise ScenarioError(f"two of the scenarios are named '{name}' and would share one folder")
    summaries = []
    for scenario in scenarios:
        with busy(f"running {scenario.name}", quiet=as_json):
            summary = run_scenario(scenario, out, plots=not no_plots)
            if video:
                _video(scenario, Path(summary["folder"]))
        summaries.append(summary)
        if not as_json:
            _print_summary(summary)
    if as_json:
        print(json.dumps(summaries[0] if len(summaries) == 1 else {"runs": summaries}))
    elif not no_plots:
        report = Path(summaries[0]["folder"]) / "report.html" if len(summaries) == 1 else _combined(summaries, out)
        print(f"report: {report}")
    raise typer.Exit(0 if all(passed(summary) for summary in summaries) else 1)


@app.command()
def batch(
    places: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of scenarios, or scenario files.")],
    workers: Annotated[
        int | None, typer.Option("-j", "--jobs", metavar="N", min=1, help="Processes; default all CPUs.")
    ] = None,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a JUnit file for CI.")] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", metavar="DIR", help="Keep the results here.")] = None,
    plots: Annotated[bool, typer.Option("--plots", help="With -o: draw plots and reports as well.")] = False,
    as_json: Json = False,
) -> None:
    """Run every scenario of some folders in parallel and say which pass.

    Example: lwa4d-sim batch scenarios -j 4 --junit report.xml
    """
    from lwa4d_sim.batch import check_writable, default_workers, find_scenarios, run_files, write_junit

    files = find_scenarios(places)
    if junit is not None:
        check_writable(junit)
    jobs = []
    with progress("scenarios", len(files), quiet=as_json) as advance:
        for job in run_files(files, out, plots=plots and out is not None, workers=workers or default_workers()):
            jobs.append(job)
            advance()
    if junit is not None:
        write_junit(junit, jobs)
    for job in jobs:
        if job.error:
            complain(job.error)
    if as_json:
        rows = [{"file": str(j.file), "verdict": j.verdict, "error": j.error, **(j.summary or {})} for j in jobs]
        print(json.dumps({"scenarios": rows}))
    else:
        _print_jobs(jobs)
    verdicts = {job.verdict for job in jobs}
    raise typer.Exit(2 if "error" in verdicts else 1 if "failed" in verdicts else 0)


@app.command()
def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders that `run` has written.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="The page to write.")] = Path("report.html"),
    as_json: Json = False,
) -> None:
    """Put finished runs on one self-contained HTML page.

    Example: lwa4d-sim report runs/pd_joint_p2.5 runs/pd_joint_p1.25 -o comparison.html
    """
    from lwa4d_sim.report import section_from_folder, write_report

    with busy("drawing", quiet=as_json):
        write_report(out, [section_from_folder(folder) for folder in runs])
    print(json.dumps({"report": str(out)}) if as_json else f"report: {out}")


@app.command()
def schema(
    as_json: Annotated[bool, typer.Option("--json", help="The schema is JSON anyway.")] = False,
) -> None:
    """Print the JSON schema of a scenario file, for editors that check YAML.

    Example: lwa4d-sim schema > scenario.schema.json
    """
    from lwa4d_sim.schema import json_schema

    print(json.dumps(json_schema(), indent=None if as_json else 1))


@app.command()
def scenarios(as_json: Json = False) -> None:
    """List the scenarios and sweeps that come with the package.

    Example: lwa4d-sim scenarios
    """
    folders = {"scenarios": shipped_scenarios(), "sweeps": shipped_sweeps()}
    files = {what: sorted(folder.glob("*.yaml")) for what, folder in folders.items()}
    if as_json:
        print(json.dumps({what: {file.stem: str(file) for file in found} for what, found in files.items()}))
        return
    for what, found in files.items():
        print(f"{what}:")
        for file in found:
            first = file.read_text(encoding="utf-8").splitlines()[0]
            print(f"  {file.stem:28} {first.removeprefix('#').strip()}")


def _combined(summaries: list[dict[str, Any]], out: Path) -> Path:
    """One report of several scenarios, and their verdicts side by side on stdout."""
    from lwa4d_sim.report import section_from_folder, write_report
    from lwa4d_sim.verdict import headline

    path = out / "report.html"
    sections = [section_from_folder(Path(summary["folder"])) for summary in summaries]
    write_report(path, sections)
    print("\nside by side")
    for section in sections:
        print(f"  {section.title}: {headline(section.runs)}")
    return path


def _video(scenario: Any, folder: Path) -> None:
    from lwa4d_sim.mjcf import load_model
    from lwa4d_sim.record import RunLog
    from lwa4d_sim.video import animate

    logs = {name: RunLog.load(folder / f"{name}.h5") for name in scenario.variants}
    first = next(iter(scenario.variants.values()))
    animate(logs, folder / "arm.gif", load_model(first.arm, base=scenario.folder))


def _print_summary(summary: Mapping[str, Any]) -> None:
    from lwa4d_sim.batch import describe

    print(f"{summary['name']}  ->  {summary['folder']}")
    for name, variant in summary["variants"].items():
        values = variant["metrics"]
        state = "stable" if values["stable"] else f"UNSTABLE since {values['unstable_since']:.2f} s"
        if values["diverged_at"] is not None:
            state = f"DIVERGED at {values['diverged_at']:.2f} s"
        errors = ", ".join("-" if e is None else f"{1e3 * e:.2f}" for e in values["final_error"])
        print(f"  {name:12} {state:26} error at segment ends [mm]: {errors}")
        if variant["stopped"] is not None:
            print(f"    STOPPED at {variant['stopped']['at']:.2f} s: {variant['stopped']['why']}")
        for check in variant["expect"]["checks"]:
            print(f"    {'passed' if check['passed'] else 'FAILED'}  {describe(check)}")


def _print_jobs(jobs: list[Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from lwa4d_sim.batch import describe

    table = Table("scenario", "verdict", "variants", "time [s]", box=None, pad_edge=False)
    for job in jobs:
        states = "" if job.summary is None else ", ".join(map(_state, job.summary["variants"].items()))
        table.add_row(job.file.stem, job.verdict, states, f"{job.seconds:.1f}")
    Console(width=None if sys.stdout.isatty() else 160).print(table)
    for job in jobs:
        for name, variant in (job.summary or {"variants": {}})["variants"].items():
            for check in variant["expect"]["checks"]:
                if not check["passed"]:
                    print(f"{job.file}: {name}: {describe(check)}")
    counts = {verdict: sum(job.verdict == verdict for job in jobs) for verdict in ("passed", "failed", "error")}
    print(f"{len(jobs)} scenarios: " + ", ".join(f"{count} {verdict}" for verdict, count in counts.items()))


def _state(item: tuple[str, Any]) -> str:
    name, variant = item
    return f"{name}: {'stable' if variant['metrics']['stable'] else 'unstable'}"


def main() -> None:
    """Entry point: runs the app and turns every expected error into one line and exit code 2."""
    sys.path.append(os.getcwd())  # a controller of one's own is found in the folder one works in
    try:
        code = app(sys.argv[1:] or ["--help"], standalone_mode=False) or 0
        if code == _INTERRUPTED:
            complain("interrupted; finished results are kept")
    except (LwaError, OSError) as error:
        code = complain(str(error))
    except MemoryError:
        code = complain("out of memory; a shorter motion or a longer plant.timestep needs less")
    except Exception as error:
        if not hasattr(error, "format_message"):  # Typer's usage errors have no public class
            raise
        code = complain(f"{error.format_message()} (see lwa4d-sim --help)")
    sys.exit(code)


_INTERRUPTED = 130  # Typer's exit code after Ctrl-C, as shells have it
