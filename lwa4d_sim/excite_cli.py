"""The command `lwa4d-sim excite`."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.console import Json, Out, Set, override, progress, scenario_path
from lwa4d_sim.errors import ScenarioError

LEAD_IN, LEAD_OUT = 0.5, 0.2  # of the period, where not given (assumed: time to go as far as half a period goes)

SLOWEST = 0.001  # [rad/s] assumed


def excite(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Scenario file, or the name of a shipped one.")],
    variant: Annotated[
        str | None, typer.Option("--variant", metavar="NAME", help="Default: the first variant with a bus.")
    ] = None,
    harmonics: Annotated[int, typer.Option(metavar="N", help="Of the Fourier series.")] = 5,
    period: Annotated[float, typer.Option(metavar="SECONDS", help="Of the series.")] = 10.0,
    periods: Annotated[int, typer.Option(metavar="N", help="How often it is repeated.")] = 2,
    lead_in: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="From rest to the series; default half a period.")
    ] = None,
    lead_out: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="To rest after it; default a fifth of a period.")
    ] = None,
    speed: Annotated[
        str | None, typer.Option(metavar="V[,V...]", help="Speed limits [rad/s]; needed where the arm is your own.")
    ] = None,
    speed_share: Annotated[float, typer.Option(metavar="SHARE", help="Of the speed limits to use.")] = 0.95,
    torque_share: Annotated[float, typer.Option(metavar="SHARE", help="Of the torque limits to use.")] = 0.8,
    margin: Annotated[float, typer.Option(metavar="RAD", help="To keep from end stops.")] = 0.05,
    clearance: Annotated[float, typer.Option(metavar="M", help="To keep between links, and from the floor.")] = 0.02,
    seed: Annotated[int, typer.Option(metavar="N", help="Another seed finds another motion.")] = 0,
    iterations: Annotated[int, typer.Option(metavar="N", help="Most steps of the search.")] = 300,
    out: Out = Path("runs"),
    overrides: Set = None,
    as_json: Json = False,
) -> None:
    """Find the motion that tells most about the arm's parameters within its limits; write it as a scenario.

    Example: lwa4d-sim excite ct7_drivetrain --seed 1 -o runs
    """
    from lwa4d_sim.excitation.design import ExcitationWish
    from lwa4d_sim.excitation.written import excitation_for, excited_place, write_excited
    from lwa4d_sim.scenario import Scenario
    from lwa4d_sim.stability.analysis import default_variant

    scenario = Scenario.load(scenario_path(file), dict(override(text) for text in overrides or []))
    name = default_variant(scenario, variant)
    wish = ExcitationWish(
        harmonics=harmonics,
        period=period,
        periods=periods,
        lead_in=LEAD_IN * period if lead_in is None else lead_in,
        lead_out=LEAD_OUT * period if lead_out is None else lead_out,
        speed_share=speed_share,
        torque_share=torque_share,
        position_margin=margin,
        clearance=clearance,
        seed=seed,
        iterations=iterations,
    )
    path = excited_place(scenario, out)
    with progress("excitation", iterations, quiet=as_json) as advance:
        found = excitation_for(scenario, name, wish, _numbers(speed), advance)
    write_excited(path, scenario, name, found, wish)
    sides = {"before": found.before, "after": found.after}
    answer: dict[str, Any] = {
        "file": str(path),
        "variant": name,
        "parameters": found.parameters,
        "gain": found.gain,
        **{side: {"log_det": one.log_det, "condition": one.condition} for side, one in sides.items()},
        "limits": [
            {**asdict(after), "before": before.reached}
            for before, after in zip(found.before.room, found.after.room, strict=True)
        ],
        "remarks": list(found.remarks),
    }
    if as_json:
        print(json.dumps(answer))
    else:
        _print(answer)


def _numbers(text: str | None) -> list[float] | None:
    try:
        numbers = None if text is None else [float(part) for part in text.split(",")]
    except ValueError:
        raise ScenarioError(f"--speed (={text}): must be numbers [rad/s] with commas between them") from None
    if numbers is not None and min(numbers) < SLOWEST:
        raise ScenarioError(f"--speed (={text}): must be at least {SLOWEST:g} rad/s; slower motion tells nothing")
    return numbers


def _print(answer: dict[str, Any]) -> None:
    print(f"{'':34} {'limit':>10} {'before':>10} {'after':>10} {'room left':>10}")
    for row in answer["limits"]:
        cells = [row["limit"], row["before"], row["reached"], row["left"]]
        texts = ("far" if cell is None else f"{cell:.4g}" for cell in cells)
        text = f"{row['what']} [{row['unit']}], {row['where']}"
        print(f"{text:34} " + " ".join(f"{cell:>10}" for cell in texts))
    before, after = answer["before"], answer["after"]
    print(f"\nlog det of the information  {before['log_det']:.2f} before, {after['log_det']:.2f} after")
    print(f"condition number            {before['condition']:.4g} before, {after['condition']:.4g} after")
    print(f"base parameters             {answer['parameters']}; standard errors shrink by {answer['gain']:.3g}")
    for remark in answer["remarks"]:
        print(f"note: {remark}")
    print(f"scenario: {answer['file']}")
