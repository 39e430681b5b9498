"""The command `lwa4d-sim calibrate`: from measured poses of the tool to a better model of the arm's geometry."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.console import Json, Out, busy
from lwa4d_sim.errors import ScenarioError

_ANGLE_PER_METRE = 10.0  # [rad/m] noise of an angle between targets 0.1 m apart, from their positions' (assumed)


def calibrate(
    arm: Annotated[str, typer.Argument(metavar="ARM", help="Name of a shipped arm, or path of an MJCF file.")],
    poses: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Measured poses: CSV with q1..qn,x,y,z[,roll,pitch,yaw] in rad and m."),
    ] = None,
    simulate: Annotated[
        int | None, typer.Option(metavar="N", min=1, max=5000, help="Draw an arm that is off and measure N poses.")
    ] = None,
    noise: Annotated[float, typer.Option(metavar="METRES", help="Standard deviation of a measured coordinate.")] = 1e-4,
    angle_noise: Annotated[
        float | None,
        typer.Option(metavar="RADIANS", help="The same of a measured angle; with --simulate also measures angles."),
    ] = None,
    error: Annotated[
        float, typer.Option(metavar="SIZE", help="With --simulate: size of the errors [m and rad].")
    ] = 1e-3,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="With --simulate: of all that is drawn.")] = 0,
    joints_only: Annotated[bool, typer.Option("--joints-only", help="Fit the zeros of the joints only.")] = False,
    out: Out = Path("runs"),
    as_json: Json = False,
) -> None:
    """Find the errors of an arm's geometry from poses of its tool, and write the corrected arm.

    Example: lwa4d-sim calibrate lwa4d_7dof --simulate 60 --angle-noise 1e-3 -o runs
    """
    from lwa4d_sim.calibration.error_model import ErrorModel
    from lwa4d_sim.calibration.folder import claim_for, write_study
    from lwa4d_sim.calibration.measured import Instrument
    from lwa4d_sim.calibration.pose_files import read_poses
    from lwa4d_sim.calibration.study import calibrate as fitted
    from lwa4d_sim.calibration.study import simulate as simulated
    from lwa4d_sim.calibration.words import record
    from lwa4d_sim.mjcf import chain_of, load_model

    if (poses is None) == (simulate is None):
        raise ScenarioError("calibrate needs either measured poses (--poses FILE) or to simulate some (--simulate N)")
    _require("--noise", noise, 1e-9, 0.1)
    _require("--error", error, 0.0, 0.01)
    if angle_noise is not None:
        _require("--angle-noise", angle_noise, 1e-9, 0.1)
    model = ErrorModel(chain_of(load_model(arm)))
    folder = claim_for(arm, out, poses)
    with busy(f"calibrating {arm}", quiet=as_json):
        if poses is not None:
            data = read_poses(poses, model)
            if data.R is None and angle_noise is not None:
                raise ScenarioError(f"--angle-noise (={angle_noise:g}): {poses} has no roll, pitch, yaw; leave it away")
            angle = None if data.R is None else angle_noise or _ANGLE_PER_METRE * noise
            study = fitted(model, data, Instrument(position=noise, angle=angle), joints_only)
        else:
            instrument = Instrument(position=noise, angle=angle_noise)
            study = simulated(model, instrument, simulate or 0, error, seed, joints_only)
        found = record(study, arm)
        write_study(folder, study, arm, found)
    if as_json:
        print(json.dumps({**found, "folder": str(folder)}))
    else:
        _print(found, folder)


def _require(option: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise ScenarioError(f"{option} (={value:g}): must be from {least:g} to {most:g}")


def _print(found: dict[str, Any], folder: Path) -> None:
    print(f"{found['arm']}, {found['poses']['fit']} poses  ->  {folder}")
    known = any(row["truth"] is not None for row in found["parameters"].values())
    print(f"\n{'coordinate':20}{'estimate':>12} {'95 % interval':^25}{'truth' if known else '':>12}")
    for name, row in found["parameters"].items():
        low, value, high = (1e3 * row[key] for key in ("low", "estimate", "high"))
        truth = "" if row["truth"] is None else f"{1e3 * row['truth']:12.4f}"
        print(f"{name:20}{value:12.4f} {low:11.4f} to {high:9.4f}{truth:>12} m{row['unit']}")
    for block in ([f"left at 0: {text}" for text in found["left_out"]], found["zeros"]):
        if block:
            print("\n" + "\n".join(block))
    rms = found["rms"]
    print("")
    for title, before, after in (("fitted", "before", "after"), ("unseen", "held_out_before", "held_out")):
        if rms[after] is not None:
            print(f"rms error of the tool, {title} poses: {1e3 * rms[before]:.4f} -> {1e3 * rms[after]:.4f} mm")
    for text in found["remarks"]:
        print(f"note: {text}")
