"""Measured data, by the ending of the file: a table, the record of a run, or a CAN log."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.experiment import Experiment
from lwa4d_sim.mjcf import joint_facts
from lwa4d_sim.recordings.recording import Recording
from lwa4d_sim.settings import CanopenLoop

FAR_BEYOND = 10.0  # assumed: peak torques that no measurement exceeds
TABLES, RECORDS, SHEETS = (".csv", ".parquet"), (".h5", ".hdf5"), (".eds", ".dcf")


def read_data(path: Path, experiment: Experiment, sheets: Sequence[Path]) -> Recording:
    """Read a file of measured data.

    Args:
        path: of the file.
        experiment: whose arm and options say how it is to be read.
        sheets: data sheets of the drives in a CAN log, or folders of them.

    Raises:
        IdentificationError: it cannot be read, does not hold what is needed, or has torques far beyond the motors'.
        RecordError: it is no run record.
    """
    recording = _read(path, experiment, sheets)
    for name, (_, _, peak), tau in zip(
        recording.joints, joint_facts(experiment.problem.model), recording.tau.T, strict=True
    ):
        largest = float(np.nanmax(np.abs(tau)))
        if largest > FAR_BEYOND * peak:
            raise IdentificationError(
                f"{path}: the torque of {name} reaches {largest:.4g} N m, where its motor has {peak:g}; "
                "check the units (identify.table.torque, identify.can.torque_counts)"
            )
    return recording


def _read(path: Path, experiment: Experiment, sheets: Sequence[Path]) -> Recording:
    """What the file holds, whatever it says."""
    facts = joint_facts(experiment.problem.model)
    ending = path.suffix.lower()
    if sheets and ending in (*TABLES, *RECORDS):
        raise IdentificationError(f"{path}: is not a CAN log, so --eds says nothing about it")
    if ending in TABLES:
        from lwa4d_sim.recordings.table_file import read_table

        return read_table(path, facts, experiment.options.table)
    if ending in RECORDS:
        from lwa4d_sim.record import RunLog

        return experiment.recording_of(RunLog.load(path))
    from lwa4d_sim.bus.joints import joints_for
    from lwa4d_sim.recordings.can_log import read_can_log

    loop, reading, nodes = experiment.settings.loop, experiment.options.can, None
    if isinstance(loop, CanopenLoop):
        nodes = loop.nodes
        reading = replace(reading, profile=reading.profile or loop.profile)
    return read_can_log(path, _sheets(sheets, path), joints_for(experiment.settings.arm, facts, nodes), reading)


def _sheets(places: Sequence[Path], log: Path) -> list[Path]:
    found: list[Path] = []
    for place in places:
        inside = (
            sorted(file for file in place.glob("*") if file.suffix.lower() in SHEETS) if place.is_dir() else [place]
        )
        if not inside:
            raise IdentificationError(f"{place}: holds no data sheet (.eds, .dcf)")
        found += inside
    if not found:
        raise IdentificationError(f"{log}: a CAN log needs the data sheets of its drives; give them with --eds")
    return found
