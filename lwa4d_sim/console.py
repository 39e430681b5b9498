"""What all commands share: options, where scenarios are, progress, and the one line of an error."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.errors import ScenarioError

Json = Annotated[bool, typer.Option("--json", help="Print one machine-readable object on stdout.")]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key, e.g. controller.kp=2.0.")
]
Out = Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Folder the results go into.")]


def shipped_scenarios() -> Path:
    """Folder of the shipped scenarios: inside an installed package, beside it in a checkout."""
    here = Path(__file__).parent
    return here / "scenarios" if (here / "scenarios").is_dir() else here.parent / "scenarios"


def scenario_path(text: str) -> Path:
    """The file ``text`` names: a path, or the name of a shipped scenario."""
    path = Path(text)
    shipped = shipped_scenarios() / f"{text}.yaml"
    return shipped if not path.exists() and path.name == text and shipped.is_file() else path


def override(text: str) -> tuple[str, Any]:
    """Key and value of one `--set KEY=VALUE`."""
    from lwa4d_sim.yaml_text import parse

    key, sign, value = text.partition("=")
    if not sign or not key.strip():
        raise ScenarioError(f"--set {text}: must be KEY=VALUE, e.g. controller.kp=2.0")
    return key.strip(), parse(value, f"--set {key.strip()}", numbered=False)[0]


@contextmanager
def busy(text: str, *, quiet: bool) -> Iterator[None]:
    """A spinner on stderr while something runs, where somebody watches."""
    if quiet or not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(text):
        yield


@contextmanager
def progress(text: str, total: int, *, quiet: bool) -> Iterator[Any]:
    """A progress bar on stderr, where somebody watches; yields the function to call per finished item."""
    if quiet or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(text, total=total)
        yield lambda: bar.advance(task)


def complain(text: str) -> int:
    """Print one line on stderr; returns the exit code of bad input."""
    print(f"lwa4d-sim: {' '.join(text.split())}", file=sys.stderr)
    return 2
