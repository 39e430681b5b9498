"""A recording from a table of a real arm: CSV or Parquet, every defect named by file, row and column.

Columns: t [s], q1..qn and tau1..taun; others are passed over. t1..tn in place of t give each joint its own time stamps.
"""

import csv
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.recordings.plausible import MISSING, check_plausible
from lwa4d_sim.recordings.reading import Units
from lwa4d_sim.recordings.recording import Recording

ANGLES = {"rad": 1.0, "deg": np.pi / 180, "mdeg": np.pi / 180_000}  # [rad]
GAP = 1.5  # periods from one row to the next, from which on rows are missing between them
SAME = 1e-9  # of the range: values that differ by less differ by rounding
OFF_GRID = 0.1  # steps that values may stray from even ones (assumed)

Facts = Sequence[tuple[str, tuple[float, float] | None, float]]


SI = Units()


def read_table(path: Path, facts: Facts, units: Units = SI) -> Recording:
    """Read a table.

    Args:
        path: Parquet, or else CSV with a header.
        facts: name, position limits [rad] or None, and peak torque [N m] of each joint
            (`lwa4d_sim.mjcf.joint_facts`).
        units: of its numbers.

    Raises:
        IdentificationError: the file cannot be read, or its columns, times or numbers cannot be right.
    """
    n, scale, factors = len(facts), ANGLES[units.angle], _torque_factors(units, facts)
    columns, values, place = _read(path, n)
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, column = bad[0]
        raise IdentificationError(f"{place(row)}: {columns[column]} is {values[row, column]}; it must be a number")
    stamps = len(columns) - 2 * n
    back = np.argwhere(np.diff(values[:, :stamps], axis=0) <= 0)
    if len(back):
        row, column = back[0]
        late, early = values[row + 1, column], values[row, column]
        raise IdentificationError(
            f"{place(row + 1)}: {columns[column]} (={late:.9g} s) must be later than in the row before (={early:.9g} s)"
        )
    counts, given = values[:, stamps : stamps + n], values[:, stamps + n :]
    stamped = np.broadcast_to(values[:, :stamps], counts.shape)
    t, q, tau, gaps = _with_gaps(stamped - stamped.min(initial=np.inf), counts * scale, given * factors)
    remarks = [f"{len(gaps)} gaps of up to {max(gaps):.3g} s; nothing is known of them"] if gaps else []
    period = float(np.median(np.diff(t[:, 0]))) if len(t) > 1 else 0.0
    missing = sum(gaps) - len(gaps) * period
    if gaps and missing > MISSING * (t[-1, 0] + period):
        raise IdentificationError(f"{path}: {missing:.4g} s of {t[-1, 0]:.4g} s are missing in gaps; more than half")
    recording = Recording(
        joints=tuple(name for name, _, _ in facts),
        t=t,
        q=q,
        since=t + units.delay,
        tau=tau,
        position_step=np.array([resolution(column) for column in counts.T]) * scale,
        torque_step=np.array([resolution(column) for column in given.T]) * factors,
        end=float(t[-1].max(initial=0.0) + period + units.delay) if len(t) else 0.0,
        source=str(path),
        remarks=tuple(remarks),
    )
    check_plausible(recording, [limits for _, limits, _ in facts])
    return recording


def resolution(values: Array) -> float:
    """Step of a quantised signal (K,), in its unit; 0 where its values lie on no even steps.

    The smallest distance of two different values, then a straight line through all of them over their number of steps,
    since written numbers are rounded.
    """
    levels = np.unique(values)
    levels = levels[np.diff(levels, prepend=-np.inf) > SAME * np.ptp(levels)] if len(levels) else levels
    if len(levels) < 2:
        return 0.0
    distances = np.diff(levels)
    unit = distances[distances < GAP * distances.min()].mean()
    steps = np.concatenate([[0.0], np.cumsum(np.rint(distances / unit))])
    step = float(np.dot(steps, levels - levels[0]) / np.dot(steps, steps))
    return step if np.abs((levels - levels[0]) / step - steps).max() < OFF_GRID else 0.0


def _torque_factors(units: Units, facts: Facts) -> Array:
    """Newton metres in one unit of each joint's torque column (n,)."""
    if units.torque == "N m":
        return np.ones(len(facts))
    name = "constant" if units.torque == "mA" else "rated"
    given = getattr(units, name)
    if given is None and units.torque == "mA":
        raise IdentificationError("torque in mA needs constant, the torque of a current at each joint [N m/A]")
    factors = np.array([peak for _, _, peak in facts] if given is None else given) / 1000.0
    if len(factors) != len(facts) or not np.isfinite(factors).all():
        raise IdentificationError(
            f"torque in {units.torque} needs {name} with a number for each of {len(facts)} joints"
        )
    return factors


def _with_gaps(t: Array, q: Array, tau: Array) -> tuple[Array, Array, Array, list[float]]:
    """The rows, with one of which nothing is known at the beginning of each gap; and the gaps' lengths [s].

    Without it the last torque before a gap would seem to act until its end.
    """
    steps = np.diff(t[:, 0])
    before = np.flatnonzero(steps > GAP * np.median(steps)) if len(steps) else np.empty(0, int)
    if not len(before):
        return t, q, tau, []
    nothing = np.full((len(before), t.shape[1]), np.nan)
    extra = (t[before] + np.median(steps), nothing, nothing)
    t, q, tau = (np.insert(rows, before + 1, more, axis=0) for rows, more in zip((t, q, tau), extra, strict=True))
    return t, q, tau, steps[before].tolist()


_Place = Callable[[int], str]


def _read(path: Path, n: int) -> tuple[list[str], Array, _Place]:
    """Names and values (K, columns) of time, position and torque, and where each row stands in the file."""
    try:
        return _read_parquet(path, n) if path.suffix == ".parquet" else _read_csv(path, n)
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())
        raise IdentificationError(f"{path}: cannot be read ({reason})") from error
    except (ValueError, csv.Error) as error:  # a name with a NUL in it, bytes that are no text, nonsense in Parquet
        if isinstance(error, IdentificationError):
            raise
        raise IdentificationError(f"{path}: is no table of numbers ({' '.join(str(error).split())})") from error


def _wanted(header: Sequence[str], where: str, n: int) -> list[str]:
    """The columns that are read, in order."""
    signals = [f"{name}{j + 1}" for name in ("q", "tau") for j in range(n)]
    choices = [["t", *signals], [*(f"t{j + 1}" for j in range(n)), *signals]]
    valid = " or ".join(",".join(names) for names in choices)
    fitting = [names for names in choices if set(names) <= set(header)]
    if f"q{n + 1}" in header or f"tau{n + 1}" in header:
        raise IdentificationError(f"{where}: has columns of more than {n} joints, which the arm has; valid: {valid}")
    if not fitting:
        missing = [name for name in choices["t" not in header and "t1" in header] if name not in header]
        raise IdentificationError(f"{where}: has no column {', '.join(missing)}; the header must have {valid}")
    twice = [name for name in fitting[0] if header.count(name) > 1]
    if twice:
        raise IdentificationError(f"{where}: has the column {twice[0]} more than once")
    return fitting[0]


def _read_csv(path: Path, n: int) -> tuple[list[str], Array, _Place]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader, [])]
        names = _wanted(header, f"{path}:1", n)
        places = [header.index(name) for name in names]
        rows: list[list[float]] = []
        lines: list[int] = []
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                raise IdentificationError(
                    f"{path}:{reader.line_num}: has {len(row)} columns; the header has {len(header)}"
                )
            try:
                rows.append([float(row[k]) for k in places])
            except ValueError:
                name, text = next((a, row[k]) for a, k in zip(names, places, strict=True) if not _is_number(row[k]))
                raise IdentificationError(
                    f"{path}:{reader.line_num}: {name} is {text[:40]!r}; it must be a number"
                ) from None
            lines.append(reader.line_num)
    return names, np.array(rows, float).reshape(len(rows), len(names)), lambda row: f"{path}:{lines[row]}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_parquet(path: Path, n: int) -> tuple[list[str], Array, _Place]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            names = _wanted(file.schema_arrow.names, str(path), n)
            table = file.read(columns=names)
        columns = [table.column(name).cast(pa.float64()).to_numpy() for name in names]  # an empty cell becomes NaN
    except (pa.ArrowException, NotImplementedError, KeyError) as error:
        raise IdentificationError(f"{path}: is no table of numbers ({' '.join(str(error).split())})") from error
    return names, np.column_stack(columns), lambda row: f"{path}, row {row + 1}"
