"""A sweep file: read, checked against its scenario, and turned into points with the overrides of each."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

from annotated_types import Ge, MinLen

from lwa4d_sim.assembly import build_blocks
from lwa4d_sim.documents import Path as KeyPath
from lwa4d_sim.documents import Place, one_line
from lwa4d_sim.errors import LwaError, ScenarioError
from lwa4d_sim.interfaces import STRICT
from lwa4d_sim.metrics import METRICS
from lwa4d_sim.mjcf import model_path
from lwa4d_sim.scenario import NAME_RULE, Scenario, can_name_a_file, read_text
from lwa4d_sim.schema import Misfit, fit
from lwa4d_sim.settings import CanopenLoop
from lwa4d_sim.sweep.design import Axis, Design, Grid, RangeAxis, WorstCase
from lwa4d_sim.trajectories import SampledMotion
from lwa4d_sim.yaml_text import parse

#: what a run of a sweep can be measured by: `deviation` would need a second run beside each
MEASURED = tuple(name for name in METRICS if name != "deviation")
RESERVED = ("run", "status", "message")  # columns of the table that no axis may be called like
SEED = "plant.seed"


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """The keys of a sweep file.

    Attributes:
        name: of the sweep; names its folder of results.
        scenario: a shipped scenario's name, or a path relative to this file.
        variant: of that scenario; default its first.
        set: overrides for all runs, by dotted key.
        design: which points.
        axes: by name, what varies.
        seeds: runs of every point, each with another `plant.seed`.
        metrics: columns of the table; default all.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    name: str
    scenario: str
    variant: str | None = None
    set: Mapping[str, Any] = field(default_factory=dict)
    design: Design = Grid()
    axes: Mapping[str, Axis]
    seeds: Annotated[int, Ge(1)] = 1
    metrics: Annotated[tuple[str, ...], MinLen(1)] | None = None


_KEYS = tuple(field.name for field in fields(SweepSettings))


class Point(NamedTuple):
    """One run of a sweep: its number, its values by axis, and what it overrides in the scenario."""

    run: int
    values: Mapping[str, Any]
    overrides: Mapping[str, Any]


@dataclass(frozen=True)
class Sweep:
    """A sweep file and its scenario, checked.

    Attributes:
        settings: of the file.
        source: the file, as errors name it.
        text: of the file.
        scenario: with the overrides that all runs share.
        variant: which of its variants runs.
    """

    settings: SweepSettings
    source: str
    text: str
    scenario: Scenario
    variant: str
    _document: Any = field(repr=False)
    _lines: Mapping[KeyPath, int] = field(repr=False)

    @staticmethod
    def load(path: Path, shipped: Path) -> "Sweep":
        """Read a sweep file and its scenario.

        Args:
            path: the YAML file.
            shipped: folder of the shipped scenarios.

        Raises:
            ScenarioError: it cannot be read, is not a sweep, or does not fit its scenario.
        """
        source = one_line(str(path))
        text = read_text(path, "sweep")
        document, lines = parse(text, source)
        if not isinstance(document, dict):
            raise ScenarioError(f"{source}: must be a mapping with the keys {', '.join(_KEYS)}")
        place = Place(source, document, lines)
        if "axes" not in document and "trajectory" in document:
            raise ScenarioError(
                f"{source}: is a scenario; a sweep names one under 'scenario' and what varies under 'axes'"
            )
        try:
            settings = fit(document, SweepSettings)
        except Misfit as misfit:
            raise place.error(misfit.path, misfit.rule) from None
        _check(settings, place)
        file = shipped / f"{settings.scenario}.yaml"
        if not file.is_file() or (path.parent / settings.scenario).is_file():
            file = path.parent / settings.scenario
        try:
            scenario = Scenario.load(file, settings.set)
        except ScenarioError as error:
            at_fault = "set" if settings.set and _loads(file) else "scenario"
            raise place.error((at_fault,), str(error)) from error
        variant = settings.variant or next(iter(scenario.variants))
        if variant not in scenario.variants:
            names = ", ".join(scenario.variants)
            raise place.error(("variant",), f"no such variant; {settings.scenario} has {names}")
        return Sweep(settings, source, text, scenario, variant, document, lines)

    @property
    def name(self) -> str:
        """Of the sweep."""
        return self.settings.name

    @property
    def axes(self) -> Mapping[str, Axis]:
        """By name."""
        return self.settings.axes

    @property
    def metrics(self) -> tuple[str, ...]:
        """Columns asked for, in the order of all metrics; `stable` is always one of them."""
        asked = self.settings.metrics or MEASURED
        return tuple(name for name in MEASURED if name in asked or name == "stable")

    @property
    def count(self) -> int:
        """Number of runs."""
        return self.settings.design.count(self.axes) * self.settings.seeds

    def points(self, limit: int | None = None) -> Iterator[Point]:
        """The runs in order, or the first ``limit``. Of a search, some points of its region."""
        count = self.count if limit is None else limit
        seeds = self.settings.seeds
        rows = self.settings.design.points(self.axes, -(-count // seeds))
        runs = ((row, repeat) for row in rows for repeat in range(seeds))
        for run, (row, repeat) in enumerate(islice(runs, count)):
            yield self.point(run, row, repeat)

    def point(self, run: int, row: tuple[Any, ...], repeat: int = 0) -> Point:
        """The run with the axis values ``row``."""
        values = dict(zip(self.axes, row, strict=True))
        overrides: dict[str, Any] = {}
        for name in self.axes:
            overrides.update(self._overrides(name, values[name]))
        if self.settings.seeds > 1:
            overrides[SEED] = self.scenario.variants[self.variant].plant.seed + repeat
        return Point(run, values, overrides)

    def _overrides(self, name: str, value: Any) -> dict[str, Any]:
        keys = self.axes[name].keys or {name: 1.0}
        return {key: value if factor == 1 else value * factor for key, factor in keys.items()}

    def check_point(self, point: Point) -> Scenario:
        """The point's scenario.

        Raises:
            ScenarioError: its values do not fit; names the axis at fault and its line.
        """
        try:
            return self.scenario.changed(point.overrides, self.variant)
        except ScenarioError as error:
            for name, value in point.values.items():
                try:
                    self.scenario.changed(self._overrides(name, value), self.variant)
                except ScenarioError as own:
                    raise self.error(("axes", name), str(own)) from None
            raise self.error(("axes",), str(error)) from None

    def check_first(self) -> None:
        """Build the first run's blocks, which finds what is wrong with all runs before any is made.

        Raises:
            LwaError: it cannot be built, or an axis moves nothing.
        """
        first = next(self.points(1))
        made = self.check_point(first)
        document = made.resolved(self.variant)
        for name, value in first.values.items():
            for key, asked in self._overrides(name, value).items():
                top, *rest = key.split(".")
                if top in ("name", "expect") or (top == "variants" and rest[:1] != [self.variant]):
                    rule = f"moves nothing in variant '{self.variant}', which is what runs"
                elif top == "variants" or _holds(document, key, asked):
                    continue
                else:
                    rule = f"variant '{self.variant}' sets {key} itself; name variants.{self.variant}.{key}"
                    rule = f"moves nothing: {rule}"
                raise self.error(("axes", name), rule)
        try:
            build_blocks([made], self.variant, 1)
        except LwaError as error:
            raise type(error)(f"{self.source}: run 0: {error}") from error

    def error(self, path: KeyPath, rule: str) -> ScenarioError:
        """An error at a key of this file: file, line, key, rule."""
        return Place(self.source, self._document, self._lines).error(path, rule)

    def identity(self) -> str:
        """A hash of all that the table depends on, but for the versions of the software."""
        settings = self.scenario.variants[self.variant]
        made = hashlib.sha256()
        document = {key: value for key, value in self._document.items() if key not in ("name", "metrics")}
        for part in (document, self.metrics, self.scenario.document, self.variant):
            made.update(json.dumps(part, sort_keys=True).encode())
        for arm in (settings.arm, settings.controller.model.arm):
            if arm is not None:
                made.update(model_path(arm, self.scenario.folder).read_bytes())
        if isinstance(settings.trajectory, SampledMotion):
            made.update((self.scenario.folder / settings.trajectory.file).read_bytes())
        return made.hexdigest()

    @property
    def alone(self) -> bool:
        """Whether its runs cannot be stepped together: each has a bus of its own."""
        return isinstance(self.scenario.variants[self.variant].loop, CanopenLoop)


def _check(settings: SweepSettings, place: Place) -> None:
    """What the classes cannot say.

    Raises:
        ScenarioError: with the first thing wrong.
    """
    if not can_name_a_file(settings.name):
        raise place.error(("name",), NAME_RULE)
    if not settings.axes:
        raise place.error(("axes",), "is empty; name at least one axis")
    for asked in settings.metrics or ():
        if asked not in MEASURED:
            raise place.error(("metrics",), f"no metric '{asked}'; there are {', '.join(MEASURED)}")
    design = settings.design
    if isinstance(design, WorstCase):
        if design.objective not in MEASURED or design.objective in ("stable", "stopped"):
            choices = ", ".join(name for name in MEASURED if name not in ("stable", "stopped"))
            raise place.error(("design", "objective"), f"must be one of {choices}")
        if settings.seeds > 1:
            raise place.error(("seeds",), "must be 1 for a search")
    taken: dict[str, str] = {SEED: "seeds"} if settings.seeds > 1 else {}
    for name, axis in settings.axes.items():
        at = ("axes", name)
        if not name.strip():
            raise place.error(at, "an axis needs a name")
        if name in RESERVED or name in METRICS:
            raise place.error(at, "cannot be an axis: the table has a column of its own of this name")
        if isinstance(design, Grid) and not axis.grid():
            rule = "a grid needs values, or from, to and count; laws belong to random, latin_hypercube and sobol"
            raise place.error(at, rule)
        if isinstance(design, WorstCase) and not isinstance(axis, RangeAxis):
            raise place.error(at, "a search needs from and to")
        if not isinstance(design, Grid) and isinstance(axis, RangeAxis) and axis.count is not None:
            raise place.error((*at, "count"), "belongs to a grid; here the design says how many points there are")
        for key in axis.keys if axis.keys is not None else (name,):
            if key in taken:
                raise place.error(at, f"moves {key}, which {taken[key]} moves too")
            taken[key] = f"axis {name}"
        if axis.keys is not None and not axis.keys:
            raise place.error((*at, "keys"), "is empty; name at least one key of the scenario")


def _loads(file: Path) -> bool:
    """Whether the scenario is fine by itself."""
    try:
        Scenario.load(file)
    except ScenarioError:
        return False
    return True


def _holds(document: Any, key: str, asked: Any) -> bool:
    """Whether the document has the value at the dotted key; a mapping may have been laid over another."""
    value = document
    for part in key.split("."):
        if isinstance(value, list) and part.isdigit() and int(part) < len(value):
            value = value[int(part)]
        elif isinstance(value, Mapping) and part in value:
            value = value[part]
        else:
            return False
    return isinstance(asked, Mapping) or bool(value == asked)
