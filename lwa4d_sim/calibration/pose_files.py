"""Measured poses as CSV: read with every defect named by file, row and column, and written."""

import csv
from pathlib import Path

import numpy as np

from lwa4d_sim.calibration.error_model import ErrorModel
from lwa4d_sim.calibration.measured import Measured
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.rotations import from_rpy, to_rpy

POINT, TURN = ("x", "y", "z"), ("roll", "pitch", "yaw")
_SLACK = 0.1  # [rad or m] a reading may lie so far outside the limits, whose zero may be off (assumed)
_TURNS = 4.0 * np.pi  # [rad] largest reading of a joint without limits; more looks like degrees (assumed)
_REACHES = 2.0  # a tool farther away than so many lengths of the arm looks like millimetres (assumed)


def headers(n: int) -> tuple[list[str], list[str]]:
    """Column names of a file for ``n`` joints: with positions, and with poses."""
    points = [*(f"q{i + 1}" for i in range(n)), *POINT]
    return points, [*points, *TURN]


def read_poses(path: Path, model: ErrorModel) -> Measured:
    """Poses of a CSV with columns q1, ..., qn [rad or m], x, y, z [m] and, if measured, roll, pitch, yaw [rad].

    The orientation is Rz(yaw) Ry(pitch) Rx(roll), as in `rotations.from_rpy`.

    Raises:
        IdentificationError: it cannot be read, or holds something that is no such pose.
    """
    try:
        table, rows = _read(path, headers(model.n))
    except OSError as error:
        raise IdentificationError(f"{path}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error, ValueError) as error:
        if isinstance(error, IdentificationError):
            raise
        raise IdentificationError(f"{path}: is not a CSV file ({error})") from error
    n = model.n
    _check_units(path, model, table, rows)
    R = from_rpy(table[:, n + 3 :]) if table.shape[1] == n + 6 else None
    labels = tuple(f"row {row}" for row in rows)
    return Measured(q=table[:, :n], x=table[:, n : n + 3], R=R, labels=labels, source=str(path))


def write_poses(path: Path, data: Measured) -> None:
    """Write poses as `read_poses` reads them, with all digits."""
    columns = [data.q, data.x] + ([] if data.R is None else [to_rpy(data.R)])
    header = headers(data.q.shape[1])[data.R is not None]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([repr(float(v)) for v in row] for row in np.hstack(columns))


def _read(path: Path, valid: tuple[list[str], list[str]]) -> tuple[Array, list[int]]:
    """Table (K, columns) and the line of each row."""
    values, lines = [], []
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader, [])]
        if header not in valid:
            choices = " or ".join(",".join(names) for names in valid)
            raise IdentificationError(f"{path}, row 1: the header is {','.join(header)[:200]!r}; valid: {choices}")
        for row in reader:
            if not row:
                continue
            place = f"{path}, row {reader.line_num}"
            if len(row) != len(header):
                raise IdentificationError(f"{place}: has {len(row)} columns; the header has {len(header)}")
            values.append([_number(place, name, cell) for name, cell in zip(header, row, strict=True)])
            lines.append(reader.line_num)
    if not values:
        raise IdentificationError(f"{path}: holds no poses; give one a row below the header")
    return np.array(values), lines


def _number(place: str, name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise IdentificationError(f"{place}, column {name} (={cell.strip()[:40]!r}): must be a finite number")
    return value


def _check_units(path: Path, model: ErrorModel, table: Array, rows: list[int]) -> None:
    """Refuse readings that the joints cannot have, and tools that are out of sight."""
    n, chain = model.n, model.nominal
    slide = np.asarray(chain.slide)
    free = np.where(slide, np.inf, _TURNS)
    far = _REACHES * (model.length + float(np.linalg.norm(model.base)))
    low = np.concatenate([np.where(np.isfinite(chain.lower), chain.lower - _SLACK, -free), np.full(3, -far)])
    high = np.concatenate([np.where(np.isfinite(chain.upper), chain.upper + _SLACK, free), np.full(3, far)])
    if table.shape[1] == n + 6:
        low, high = np.append(low, np.full(3, -_TURNS)), np.append(high, np.full(3, _TURNS))
    bad = (table < low) | (table > high)
    if bad.any():
        k, j = np.argwhere(bad)[0]
        name, metres = headers(n)[1][j], n <= j < n + 3 or (j < n and slide[j])
        unit, other = ("m", "millimetres") if metres else ("rad", "degrees")
        place = f"{path}, row {rows[k]}, column {name} (={table[k, j]:g})"
        raise IdentificationError(f"{place}: must be from {low[j]:.6g} to {high[j]:.6g} {unit}; is it in {other}?")
