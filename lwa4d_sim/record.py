"""One run's record: what the arm did at every plant step, what the controller saw and asked at every tick; HDF5."""

import json
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lwa4d_sim import metrics as _metrics
from lwa4d_sim.errors import RecordError
from lwa4d_sim.frame_log import FrameLog
from lwa4d_sim.interfaces import NS_PER_S, Array, Ns, Trajectory

FORMAT = 1  # of the HDF5 file; raised when a reader of the old one would misread the new one


class ToolPoint(Protocol):
    """Forward kinematics as the record needs it."""

    def point(self, q: Array) -> Array:
        """Tool point (..., 3) [m] at ``q`` (..., n)."""
        ...


STOPPED = "stopped: "  # begins the event that says why the master stopped the arm


@dataclass(frozen=True, slots=True)
class TickLog:
    """What happened at the control ticks, (K, ...).

    Attributes:
        t: instants of computation [s].
        q, dq: what the controller saw [rad, rad/s]; NaN where it had nothing to go by.
        tau: what it asked for, before saturation [N m]; NaN likewise.
        age: age of the oldest datum it used [s].
        q_true, dq_true: the arm at these instants.
        q_ref: desired joint positions.
    """

    t: Array
    q: Array
    dq: Array
    tau: Array
    age: Array
    q_true: Array
    dq_true: Array
    q_ref: Array


@dataclass(frozen=True, kw_only=True)
class RunLog:
    """Record of one simulation; T plant samples (the start included) and n joints.

    Attributes:
        name, variant: of the scenario.
        timestep, period: plant step and control period [ns].
        q, dq: joint positions and speeds (T, n) [rad, rad/s].
        tau: torque applied from each sample on (T, n) [N m]; 0 while the brakes hold the arm.
        knots: end of each segment [s].
        tau_max: torque limits (n,) [N m].
        seed: of the random streams.
        diverged_at: instant [s] at which the motion left all bounds, or None.
        events: (time [s], text).
        scenario: the variant's settings as written, for the file and the report.
        versions: of the software.
        frames: what went over the simulated bus, or None.
    """

    name: str
    variant: str
    timestep: Ns
    period: Ns
    q: Array
    dq: Array
    tau: Array
    ticks: TickLog
    knots: Array
    tau_max: Array
    seed: int
    diverged_at: float | None
    events: tuple[tuple[float, str], ...] = ()
    scenario: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    paths: "Paths"
    frames: FrameLog | None = None

    @property
    def t(self) -> Array:
        """Instants of the plant samples (T,) [s]."""
        return np.asarray(np.arange(len(self.q)) * (self.timestep / NS_PER_S), float)

    @property
    def x(self) -> Array:
        """Tool point (T, 3) [m]."""
        return self.paths.x(self.q)

    @property
    def x_ref(self) -> Array:
        """Desired tool point (T, 3) [m]."""
        return self.paths.x_ref(self.t)

    @property
    def stopped(self) -> tuple[float, str] | None:
        """When [s] and why the master on a bus stopped the arm, or None."""
        said = [(t, text.removeprefix(STOPPED)) for t, text in self.events if text.startswith(STOPPED)]
        return said[0] if said else None

    def step_at(self, t: float) -> int:
        """Index of the plant sample at time ``t`` [s]."""
        return round(t * NS_PER_S / self.timestep)

    def metrics(self) -> dict[str, Any]:
        """Numbers of this run; see `lwa4d_sim.metrics.METRICS`."""
        return self._metrics

    @cached_property
    def _metrics(self) -> dict[str, Any]:
        return _metrics.metrics(self)

    def save(self, path: Path) -> None:
        """Write the HDF5 record, whole or not at all.

        Raises:
            RecordError: the file cannot be written.
        """
        partial = path.with_name(path.name + ".part")
        try:
            # made in memory, because HDF5 on a full disk crashes the program
            with _open(path, "w", driver="core", backing_store=False) as file:
                self._write(file)
                file.flush()
                image = file.id.get_file_image()
            partial.write_bytes(image)
            os.replace(partial, path)
        except (OSError, RuntimeError) as error:  # h5py raises either
            with suppress(OSError):
                partial.unlink()
            raise RecordError(f"{path}: cannot write the record ({error})") from error

    def _write(self, file: Any) -> None:
        file.attrs.update(format=FORMAT, name=self.name, variant=self.variant, seed=self.seed)
        file.attrs.update(timestep_ns=int(self.timestep), period_ns=int(self.period))
        if self.diverged_at is not None:
            file.attrs["diverged_at"] = self.diverged_at
        plant = {
            "t": (self.t, "s"),
            "q": (self.q, "rad"),
            "dq": (self.dq, "rad/s"),
            "tau": (self.tau, "N m"),
            "x": (self.x, "m"),
            "x_ref": (self.x_ref, "m"),
        }
        _write_group(file, "plant", plant)
        _write_group(file, "ticks", {key: (getattr(self.ticks, key), unit) for key, unit in _TICK_UNITS.items()})
        parameters = {"knots": (self.knots, "s"), "tau_max": (self.tau_max, "N m")}
        _write_group(file, "parameters", parameters)
        if self.frames is not None:
            _write_group(file, "frames", self.frames.columns())
            file["frames"].attrs["names"] = "\n".join(self.frames.names)
        for key, text in (("scenario", self.scenario), ("versions", self.versions)):
            # not attributes, which HDF5 limits to 64 kB
            file["parameters"].create_dataset(key, data=json.dumps(text), dtype=_text_type())
        events = file.create_group("events")
        events.create_dataset("t", data=np.array([t for t, _ in self.events])).attrs["unit"] = "s"
        events.create_dataset("text", data=[text for _, text in self.events], dtype=_text_type())

    @staticmethod
    def load(path: Path) -> "RunLog":
        """Read a record written by `save`.

        Raises:
            RecordError: no such file, or not a record of this format.
        """
        try:
            with _open(path, "r") as file:
                return _read(file)
        except (OSError, KeyError, ValueError, TypeError, AttributeError) as error:  # as many as ways to be wrong
            raise RecordError(f"{path}: not a readable run record ({error})") from error


class Paths(Protocol):
    """Where the tool was and should have been: computed for a fresh run, stored in a loaded one; always new arrays."""

    def x(self, q: Array) -> Array:
        """Tool points (T, 3) [m]."""
        ...

    def x_ref(self, t: Array) -> Array:
        """Desired tool points (T, 3) [m]."""
        ...


@dataclass(frozen=True, slots=True)
class ComputedPaths:
    """Tool paths from kinematics and trajectory, so that a run need not keep them."""

    kinematics: ToolPoint
    trajectory: Trajectory

    def x(self, q: Array) -> Array:
        """Tool points (T, 3) [m]."""
        return in_blocks(self.kinematics.point, q, 1500)

    def x_ref(self, t: Array) -> Array:
        """Desired tool points (T, 3) [m]."""
        return in_blocks(self.trajectory.tool_point, t)


def in_blocks(function: Callable[[Array], Array], samples: Array, size: int = 500) -> Array:
    """``function`` of many samples, a block at a time, so that its scratch arrays stay small beside the record."""
    out: Array | None = None
    for start in range(0, len(samples), size):
        block = function(samples[start : start + size])
        if out is None:
            out = np.empty((len(samples), *block.shape[1:]))
        out[start : start + size] = block
    return function(samples) if out is None else out


@dataclass(frozen=True, slots=True)
class StoredPaths:
    """Tool paths as a file holds them."""

    stored_x: Array
    stored_x_ref: Array

    def x(self, q: Array) -> Array:
        """Tool points (T, 3) [m]."""
        return self.stored_x.copy()

    def x_ref(self, t: Array) -> Array:
        """Desired tool points (T, 3) [m]."""
        return self.stored_x_ref.copy()


_TICK_UNITS = {
    "t": "s",
    "q": "rad",
    "dq": "rad/s",
    "tau": "N m",
    "age": "s",
    "q_true": "rad",
    "dq_true": "rad/s",
    "q_ref": "rad",
}


def _open(path: Path, mode: str, **driver: Any) -> Any:
    import h5py  # a fifth of a second; only files need it

    return h5py.File(path, mode, **driver)


def _text_type() -> Any:
    import h5py

    return h5py.string_dtype()


def _write_group(file: Any, name: str, columns: dict[str, tuple[Array, str]]) -> None:
    group = file.create_group(name)
    for key, (values, unit) in columns.items():
        group.create_dataset(key, data=values).attrs["unit"] = unit


def _read(file: Any) -> RunLog:
    if file.attrs.get("format") != FORMAT:
        raise ValueError(f"format {file.attrs.get('format')}, this version reads {FORMAT}")
    plant, parameters, events = file["plant"], file["parameters"], file["events"]
    return RunLog(
        name=str(file.attrs["name"]),
        variant=str(file.attrs["variant"]),
        timestep=Ns(int(file.attrs["timestep_ns"])),
        period=Ns(int(file.attrs["period_ns"])),
        q=plant["q"][:],
        dq=plant["dq"][:],
        tau=plant["tau"][:],
        ticks=TickLog(**{key: file["ticks"][key][:] for key in _TICK_UNITS}),
        knots=parameters["knots"][:],
        tau_max=parameters["tau_max"][:],
        seed=int(file.attrs["seed"]),
        diverged_at=float(file.attrs["diverged_at"]) if "diverged_at" in file.attrs else None,
        events=tuple(zip(events["t"][:].tolist(), [s.decode() for s in events["text"][:]], strict=True)),
        scenario=json.loads(parameters["scenario"][()]),
        versions=json.loads(parameters["versions"][()]),
        paths=StoredPaths(plant["x"][:], plant["x_ref"][:]),
        frames=FrameLog.read(file["frames"]) if "frames" in file else None,
    )
