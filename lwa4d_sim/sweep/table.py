"""A sweep's runs as Parquet: parts as they come, and one table in the end; each written whole or not at all."""

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from lwa4d_sim.errors import RecordError
from lwa4d_sim.metrics import FLAGS, METRICS
from lwa4d_sim.sweep.file import Point

Row = Mapping[str, Any]
_GROUP = 65_536  # rows of a row group; fixed, so that a table's bytes do not depend on how it came about
_AT_ONCE = 32  # parts held open before they are put together (assumed)
_OUTCOME = ("status", "message")


def part(points: Sequence[Point], rows: Sequence[Row]) -> Any:
    """An Arrow table of some runs: number, what tells the run from others, metrics, outcome.

    Lists are opened into columns: final_error becomes final_error_1, final_error_2, ... (segments or joints from 1).
    """
    opened = [_flat(row) for row in rows]
    names = _ordered({"stable", *(key for row in opened for key in row)} - {"run", *_OUTCOME})
    columns = {name: _column(name, [row.get(name) for row in opened]) for name in ("run", *names, *_OUTCOME)}
    return _joined(columns, points)


def merge(paths: Iterable[Path], points: Sequence[Point]) -> Any:
    """All parts as one Arrow table, a row for each of ``points`` that is in some part, sorted by run.

    The same runs give the same table whatever the parts were. Where a run that failed was made again, the better row
    counts.

    Raises:
        RecordError: a part cannot be read.
    """
    import pyarrow as pa

    runs = {point.run for point in points}
    asked = set(_described(points))
    table = pa.concat_tables(_gathered(map(read, paths), asked), promote_options="default").combine_chunks()
    table = table.sort_by([("run", "ascending"), ("status", "descending"), ("message", "ascending")])
    number = table["run"].to_pylist()
    keep = [run in runs and (k == 0 or number[k - 1] != run) for k, run in enumerate(number)]
    table = table.filter(pa.array(keep, pa.bool_()))
    present = set(table["run"].to_pylist())
    names = _ordered(set(table.column_names) - {"run", *_OUTCOME})
    columns = {name: table[name].combine_chunks() for name in ("run", *names, *_OUTCOME)}
    return _joined(columns, sorted((point for point in points if point.run in present), key=lambda point: point.run))


def _gathered(tables: Iterable[Any], asked: set[str]) -> list[Any]:
    """The tables without the columns ``asked``, some together at a time: many small ones take much room."""
    import pyarrow as pa

    made: list[Any] = []
    for table in tables:
        made.append(table.drop_columns([name for name in table.column_names if name in asked]))
        if len(made) > _AT_ONCE:
            made = [pa.concat_tables(made, promote_options="default").combine_chunks()]
    return made


def _joined(columns: Mapping[str, Any], points: Sequence[Point]) -> Any:
    import pyarrow as pa

    first = {"run": columns["run"], **_described(points)}
    return pa.table({**first, **{name: column for name, column in columns.items() if name != "run"}})


def _described(points: Sequence[Point]) -> dict[str, Any]:
    """Columns of the axes, then of the scenario keys that they move under another name."""
    names = dict.fromkeys([*points[0].values, *points[0].overrides]) if points else {}
    return {name: _column(name, [_cell({**p.overrides, **p.values}[name]) for p in points]) for name in names}


def _cell(value: Any) -> Any:
    """An axis value as one cell: what is neither number nor text becomes JSON text."""
    return json.dumps(value) if value is None or isinstance(value, (list, Mapping)) else value


def _flat(row: Row) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, list):
            out.update({f"{key}_{k}": item for k, item in enumerate(value, start=1)})
        else:
            out[key] = value
    return out


def metric_of(column: str) -> str:
    """The metric that a column belongs to: final_error of final_error_2."""
    return column if column in METRICS else column.rpartition("_")[0]


def _ordered(names: Iterable[str]) -> list[str]:
    """Columns of metrics in the order of the metrics, then of their numbers."""
    order = list(METRICS)
    return sorted(names, key=lambda name: (order.index(metric_of(name)), len(name), name))


def _column(name: str, values: Sequence[Any]) -> Any:
    import pyarrow as pa

    kind, arrow = _kind(name, values)
    return pa.array([None if value is None else kind(value) for value in values], arrow)


def _kind(name: str, values: Sequence[Any]) -> tuple[Callable[[Any], Any], Any]:
    """The type of a column: of the table's own columns by name, of an axis by all its values."""
    import pyarrow as pa

    if name == "run":
        return int, pa.int64()
    if metric_of(name) in METRICS:
        return (bool, pa.bool_()) if name in FLAGS else (float, pa.float64())
    kinds = {type(value) for value in values}
    if name in _OUTCOME or not kinds <= {int, float, bool} or (bool in kinds and len(kinds) > 1):
        return str, pa.string()
    return (bool, pa.bool_()) if bool in kinds else (float, pa.float64()) if float in kinds else (int, pa.int64())


def write(path: Path, table: Any) -> None:
    """Write a Parquet file, whole or not at all.

    Raises:
        RecordError: it cannot be written.
    """
    import pyarrow.parquet as pq

    partial = path.with_name(path.name + ".part")
    try:
        pq.write_table(table, partial, compression="zstd", row_group_size=_GROUP)
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise RecordError(f"{path}: cannot write the table ({error}); what was finished before is kept") from error


def read(path: Path, columns: Sequence[str] | None = None) -> Any:
    """The Arrow table that `write` has written, or some columns of it.

    Raises:
        RecordError: it cannot be read.
    """
    try:
        # threads would each keep some memory, and the tables are small
        return _opened(path).read(None if columns is None else list(columns), use_threads=False)
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def _opened(path: Path) -> Any:
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(path)  # a file, not a data set: folders called key=value must not become columns
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> RecordError:
    return RecordError(f"{path}: not a readable table ({error}); delete it and run the sweep again")


def columns(path: Path) -> list[str]:
    """Names of the columns of a table.

    Raises:
        RecordError: it cannot be read.
    """
    names: list[str] = _opened(path).schema_arrow.names
    return names


def made(table: Any) -> Any:
    """The rows of an Arrow table whose runs could be made."""
    import pyarrow.compute as pc

    return table.filter(pc.equal(table["status"], "ok"))
