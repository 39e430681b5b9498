"""Joint motions read from files of samples, with every defect named by file and line."""

import csv
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from lwa4d_sim.errors import TrajectoryError
from lwa4d_sim.interfaces import Array

PREFIXES = ("q", "dq", "ddq")


def read_samples(path: Path, joints: int) -> tuple[Array, Array]:
    """Read a sampled joint motion.

    Args:
        path: .npy, .npz, or else CSV; columns as in `lwa4d_sim.trajectories.SampledMotion`.
        joints: number of joints of the arm.

    Returns:
        Times (K,) [s]; joint angles, then speeds and accelerations as far as given, (1 to 3, K, joints), in rad and s.

    Raises:
        TrajectoryError: the file cannot be read, or its columns or numbers are not valid.
    """
    try:
        if path.suffix in (".npy", ".npz"):
            table, lines = _read_numpy(path, joints), None
        else:
            table, lines = _read_csv(path, joints)
    except OSError as error:
        raise TrajectoryError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:  # a name with a NUL in it; what is wrong inside a file is already told
        raise error if isinstance(error, TrajectoryError) else TrajectoryError(f"{path}: {error}") from error
    derivatives, rest = divmod(table.shape[1] - 1, joints)
    if rest or not 1 <= derivatives <= len(PREFIXES):
        raise TrajectoryError(f"{path}: has {table.shape[1]} columns; valid: {_choices(joints)}")
    if len(table) < 2:
        raise TrajectoryError(f"{path}: has {len(table)} samples; a motion needs at least 2")

    def place(row: int) -> str:
        return f"{path}, row {row + 1}" if lines is None else f"{path}:{lines[row]}"

    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise TrajectoryError(f"{place(int(np.argmax(bad)))}: holds a number that is not finite")
    t = table[:, 0]
    back = np.diff(t) <= 0
    if back.any():
        k = int(np.argmax(back)) + 1
        raise TrajectoryError(f"{place(k)}: t (={t[k]:g} s) must be later than in the sample before (={t[k - 1]:g} s)")
    return t, table[:, 1:].reshape(len(t), derivatives, joints).swapaxes(0, 1)


def _headers(joints: int) -> list[list[str]]:
    """The valid column names: with positions only, with speeds, with accelerations."""
    names = [f"{prefix}{i + 1}" for prefix in PREFIXES for i in range(joints)]
    return [["t", *names[: k * joints]] for k in range(1, len(PREFIXES) + 1)]


def _choices(joints: int) -> str:
    return " or ".join(",".join(header) for header in _headers(joints))


def _read_csv(path: Path, joints: int) -> tuple[Array, list[int]]:
    """Table (K, columns) and the line number of each row."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader, [])]
        if header not in _headers(joints):
            raise TrajectoryError(f"{path}:1: header is {','.join(header)!r}; valid: {_choices(joints)}")
        rows, lines = [], []
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                raise TrajectoryError(f"{path}:{reader.line_num}: has {len(row)} columns; the header has {len(header)}")
            try:
                rows.append([float(cell) for cell in row])
            except ValueError as error:
                raise TrajectoryError(f"{path}:{reader.line_num}: {error}") from error
            lines.append(reader.line_num)
    return np.array(rows, dtype=float).reshape(len(rows), len(header)), lines


def _read_numpy(path: Path, joints: int) -> Array:
    """Table (K, columns) of an .npy array, or of the arrays t, q, dq, ddq of an .npz."""
    arrays = _load(path)
    if "" in arrays:
        table = arrays[""]
        if table.ndim != 2:
            raise TrajectoryError(f"{path}: has shape {table.shape}; it must have two axes (samples, columns)")
        return table
    names = ["t", *PREFIXES][: max(len(arrays), 2)]
    if set(arrays) != set(names):
        raise TrajectoryError(f"{path}: holds {', '.join(arrays)}; valid: t and q, then dq as well, then ddq as well")
    samples = arrays["t"].size
    for name, array in arrays.items():
        shape = (samples,) if name == "t" else (samples, joints)
        if array.shape != shape:
            raise TrajectoryError(f"{path}: {name} has shape {array.shape}; it must have {shape}")
    return np.column_stack([arrays[name] for name in names])


def _load(path: Path) -> dict[str, Array]:
    """Arrays of a NumPy file by name; the single array of an .npy has no name."""
    try:
        with path.open("rb") as file:
            content = np.load(file)  # refuses pickled objects
            named = {"": content} if isinstance(content, np.ndarray) else dict(content)
            return {name: np.asarray(array, dtype=float) for name, array in named.items()}
    except (ValueError, EOFError, BadZipFile) as error:
        raise TrajectoryError(f"{path}: is not a NumPy file of numbers ({error})") from error
