"""The folder that the command `calibrate` writes: arm, parameters, poses and picture, whole or not at all."""

from pathlib import Path
from typing import Any

from lwa4d_sim.calibration.arm_file import write_arm
from lwa4d_sim.calibration.plots import draw_errors
from lwa4d_sim.calibration.pose_files import write_poses
from lwa4d_sim.calibration.study import Study
from lwa4d_sim.folders import claim, written_whole
from lwa4d_sim.yaml_text import dump

_OURS = (".csv", ".png", ".xml", ".yaml")  # what such a folder may hold, and what the next one replaces


def claim_for(arm: str, out: Path, poses: Path | None = None) -> Path:
    """The folder for an arm's calibration in ``out``, see `folders.claim`; the file of poses must not lie in it."""
    name = Path(arm).stem
    names = (f"{name}_calibrated.xml", "parameters.yaml", "poses.csv", "poses_held_out.csv")
    return claim(out / f"{name}-calibration", _OURS, () if poses is None else (poses,), names)


def write_study(folder: Path, study: Study, arm: str, found: dict[str, Any]) -> None:
    """Write everything.

    Args:
        folder: where, see `claim_for`.
        study: the calibration.
        arm: name of a shipped arm, or path of its MJCF file.
        found: plain data of the study, see `words.record`.

    Raises:
        RecordError: something cannot be written.
        ModelError: the arm cannot be written as MJCF.
    """
    with written_whole(folder) as partial:
        write_arm(partial / f"{Path(arm).stem}_calibrated.xml", arm, study.model, study.fit.xi)
        write_poses(partial / "poses.csv", study.data)
        write_poses(partial / "poses_held_out.csv", study.unseen)
        draw_errors(study, Path(arm).stem, partial)
        head = "# Made by lwa4d-sim calibrate. Metres and radians; docs/calibration.md says what each coordinate is.\n"
        (partial / "parameters.yaml").write_text(head + dump(found), encoding="utf-8")
