"""The command `lwa4d-sim sweep`."""

import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.console import Json, Out, busy, progress, shipped_scenarios


def sweep(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A sweep file, or the name of a shipped one.")],
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers run it, e.g. tcp://host:8786.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("-j", "--jobs", metavar="N", min=1, help="Processes; default all CPUs.")
    ] = None,
    out: Out = Path("runs"),
    limit: Annotated[int, typer.Option(metavar="RUNS", min=1, help="Most runs.")] = 20_000,
    fresh: Annotated[bool, typer.Option("--fresh", help="Throw away what the folder holds and start again.")] = False,
    no_plots: Annotated[bool, typer.Option("--no-plots", help="Write the table only.")] = False,
    as_json: Json = False,
) -> None:
    """Run a scenario at many points and put the numbers into one table. What is there already is kept.

    Example: lwa4d-sim sweep gain_latency -j 4 -o runs
    """
    from lwa4d_sim.batch import default_workers
    from lwa4d_sim.sweep.file import Sweep
    from lwa4d_sim.sweep.folder import Watch, processes, run_sweep, spell
    from lwa4d_sim.sweep.summary import summarise
    from lwa4d_sim.sweep.tasks import Cost
    from lwa4d_sim.sweep.workers import Processes, Workers

    class Bar(Watch):
        """A progress bar on the terminal, or a line where nobody watches."""

        def __init__(self, stack: ExitStack) -> None:
            self._stack = stack
            self._step: Any = None

        def begin(self, runs: int, kept: int, cost: Cost, size: int) -> None:
            left = runs - kept
            if not as_json:
                known = f", {kept:,} of them are there" if kept else ""
                about = spell(cost.seconds * left / size)
                print(f"{runs:,} runs{known}; about {about} on {processes(size)}", file=sys.stderr)
            self._step = self._stack.enter_context(progress("runs", left, quiet=as_json))

        def advance(self, runs: int) -> None:
            for _ in range(runs):
                self._step()

    made = Sweep.load(sweep_path(file), shipped_scenarios())
    workers: Workers
    if cluster is None:
        workers = Processes(jobs or default_workers())
    else:
        from lwa4d_sim.sweep.cluster import Cluster

        workers = Cluster(cluster)
    with ExitStack() as stack:
        stack.enter_context(workers)
        folder = run_sweep(made, out, workers, limit=limit, fresh=fresh, watch=Bar(stack))
    summary: dict[str, Any] = summarise(made, folder)
    if not no_plots:
        from lwa4d_sim.sweep.report import report
        from lwa4d_sim.sweep.theory import stability_limit

        with busy("drawing", quiet=as_json):
            summary["report"] = str(report(made, folder, summary, stability_limit(made)))
    if as_json:
        print(json.dumps(summary))
    else:
        _print(summary)
    raise typer.Exit(1 if summary["errors"] else 0)


def sweep_path(text: str) -> Path:
    """The file ``text`` names: a path, or the name of a shipped sweep."""
    path = Path(text)
    shipped = shipped_sweeps() / f"{text}.yaml"
    return shipped if not path.exists() and path.name == text and shipped.is_file() else path


def shipped_sweeps() -> Path:
    """Folder of the shipped sweeps, beside that of the scenarios."""
    return shipped_scenarios().parent / "sweeps"


def _print(summary: dict[str, Any]) -> None:
    rate = summary["pass_rate"]
    print(f"{summary['name']}  ->  {summary['folder']}")
    low, high = (f"{100 * rate[key]:.1f}" for key in ("low", "high"))
    share = "" if rate["estimate"] is None else f" ({100 * rate['estimate']:.1f} %, 95 % interval {low} to {high} %)"
    print(f"  {summary['runs']:,} runs: {summary['stable']:,} stable{share}, {summary['errors']:,} errors")
    for what, run in summary["worst"].items():
        where = ", ".join(f"{key} = {_short(value)}" for key, value in run["point"].items())
        print(f"  {what.replace('_', ' ')}: run {run['run']} at {where}: {run['metric']} {_short(run['value'])}")
    if summary["error"]:
        print(f"  first error: {summary['error']}")
    print(f"table: {summary['table']}")
    if "report" in summary:
        print(f"report: {summary['report']}")


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
