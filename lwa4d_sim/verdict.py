"""Says in plain words what the numbers of a scenario's runs mean."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lwa4d_sim.expect import Outcome
from lwa4d_sim.interfaces import NS_PER_S
from lwa4d_sim.record import RunLog


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a report says of one variant.

    Attributes:
        metrics: see `lwa4d_sim.metrics.METRICS`.
        outcomes: of its expectations.
        events: (time [s], text).
        knots: end of each segment [s].
        period: control period [s].
        seed: of the random streams.
        settings: the variant's scenario, as recorded.
    """

    metrics: Mapping[str, Any]
    outcomes: Sequence[Outcome] = ()
    events: Sequence[tuple[float, str]] = ()
    knots: Sequence[float] = ()
    period: float = 0.0
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(log: RunLog, metrics: Mapping[str, Any], outcomes: Sequence[Outcome]) -> "Run":
        """The run that ``log`` records, with what was found in it."""
        return Run(
            metrics=metrics,
            outcomes=outcomes,
            events=log.events,
            knots=log.knots.tolist(),
            period=log.period / NS_PER_S,
            seed=log.seed,
            settings=log.scenario,
        )

    @property
    def stable(self) -> bool:
        """Whether it neither shook nor diverged."""
        return bool(self.metrics.get("stable"))

    @property
    def link(self) -> str:
        """What lies between controller and arm."""
        loop = self.settings.get("loop", {})
        kind = loop.get("kind", "sampled")
        if kind == "ideal":
            return "without the bus"
        late = ", commands acting at the next SYNC" if loop.get("actuation") == "next_sync" else ""
        name = "CANopen bus" if kind == "canopen" else "bus"
        return f"under the {1e3 * self.period:.4g} ms {name}{late}"

    @property
    def fate(self) -> str:
        """What became of an unstable run."""
        since, diverged = self.metrics.get("unstable_since"), self.metrics.get("diverged_at")
        if diverged is not None and since in (None, diverged):
            return f"runs away and leaves all bounds at {diverged:.1f} s{self._leg(diverged)}, where the run ends"
        if since is None:
            return "is unstable"
        end = "" if diverged is None else f" and leaves all bounds at {diverged:.1f} s, where the run ends"
        return f"shakes from {since:.1f} s on{self._leg(since)}{end}"

    def _leg(self, t: float) -> str:
        if len(self.knots) < 2:
            return ""
        k = min(int(np.searchsorted(self.knots, t, side="right")) + 1, len(self.knots))
        return f" ({segment_word(self.settings)} {k})"


def segment_word(settings: Mapping[str, Any]) -> str:
    """What a stretch of the motion between two knots leads to, in the words of the scenario."""
    kind = settings.get("trajectory", {}).get("kind", "waypoints")
    return "waypoint" if kind == "waypoints" else "segment"


def headline(runs: Mapping[str, Run]) -> str:
    """One sentence: under which conditions the arm shakes, and under which it does not."""
    shaking = [name for name, run in runs.items() if not run.stable]
    calm = [_place(name, runs) for name, run in runs.items() if run.stable]
    if not shaking:
        return f"{_upper(_and(calm))} the arm moves without lasting vibration."
    told = [f"{_place(name, runs)} {'it' if k else 'the arm'} {runs[name].fate}" for k, name in enumerate(shaking)]
    text = "; ".join([*told, *([f"{_and(calm)} it does not"] if calm else [])])
    return f"{_upper(text)}."


def remarks(runs: Mapping[str, Run]) -> list[str]:
    """Sentences on accuracy, on what the bus costs, and on saturation."""
    out = []
    ends = [(name, _largest(run.metrics.get("final_error"))) for name, run in runs.items()]
    listed = _listed([(name, _length(end)) for name, end in ends if end is not None])
    if listed:
        out.append(f"Largest distance of the tool from its goal at the end of a segment: {listed}.")
    apart = [(name, _largest(_calm_part(run))) for name, run in runs.items()]
    listed = _listed([(name, _length(distance)) for name, distance in apart if distance is not None])
    if listed:
        out.append(f"Largest distance of the tool from the ideal run before anything shakes: {listed}.")
    stuck = [(name, run.metrics.get("saturation_fraction") or 0) for name, run in runs.items()]
    listed = _listed([(name, f"{100 * share:.2g} %") for name, share in stuck if share > 0])
    if listed:
        out.append(f"Share of the time that the motors spend at their torque limits: {listed}.")
    return out


def _calm_part(run: Run) -> list[float | None]:
    """The deviation of those segments that end before any instability."""
    since = run.metrics.get("unstable_since")
    deviation = run.metrics.get("deviation") or []
    return [d for d, end in zip(deviation, run.knots, strict=False) if since is None or end <= since]


def _place(name: str, runs: Mapping[str, Run]) -> str:
    return runs[name].link + (f" ({name})" if len(runs) > 1 else "")


def _largest(values: Any) -> float | None:
    known = [value for value in values or [] if value is not None]
    return max(known) if known else None


def _length(metres: float) -> str:
    if metres < 1e-6:
        return "less than 0.001 mm"
    return f"{1e3 * metres:.3g} mm" if metres < 1 else f"{metres:.3g} m"


def _listed(values: Sequence[tuple[str, str]]) -> str:
    return ", ".join(f"{text} ({name})" for name, text in values)


def _and(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]
