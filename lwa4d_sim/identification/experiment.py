"""What a scenario says of an identification: its nominal arm, runs that excite it, and what is tried afterwards."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.controllers import ControllerParameters
from lwa4d_sim.controllers.belief import Belief, believed_model
from lwa4d_sim.errors import IdentificationError, ModelError, ScenarioError
from lwa4d_sim.identification.model_file import write_unknowns
from lwa4d_sim.identification.options import Identify, MeasurementNoise
from lwa4d_sim.identification.problem import Problem
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import joint_facts, load_model, model_path
from lwa4d_sim.record import RunLog
from lwa4d_sim.recordings.plausible import FASTEST
from lwa4d_sim.recordings.recording import Recording
from lwa4d_sim.recordings.run_data import Signals, from_run
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.settings import Settings

HELD_OUT = 0.25  # assumed: share of a recording that is kept for validation where there is no second one


@dataclass(frozen=True)
class Experiment:
    """A scenario's variant and what is asked of it.

    Attributes:
        scenario: with its key `identify`, or without for the defaults.
        variant: of it.
        options: of the identification.
        belief: the arm as it is known before.
        problem: set for that arm.
    """

    scenario: Scenario
    variant: str
    options: Identify
    belief: Belief
    problem: Problem

    @staticmethod
    def of(scenario: Scenario, variant: str | None) -> "Experiment":
        """The experiment; by default with the first variant.

        Raises:
            ScenarioError: no such variant, or the key `identify` does not fit the arm.
        """
        name = variant or next(iter(scenario.variants))
        if name not in scenario.variants:
            raise ScenarioError(f"{scenario.source}: no variant '{name}'; there are {', '.join(scenario.variants)}")
        settings = scenario.variants[name]
        options = settings.identify or Identify()
        believed: Belief = getattr(settings.controller, "model", Belief())
        # how the arm stands is known, whatever a controller is told of it
        belief = replace(options.nominal or believed, gravity=settings.plant.gravity)
        try:
            if options.nominal is not None and options.nominal.gravity not in (None, belief.gravity):
                raise IdentificationError("is that of the plant; set plant.gravity", "identify.nominal.gravity")
            problem = Problem.of(options, believed_model(belief, settings.arm, scenario.folder))
            for what in ("position", "torque"):
                given = getattr(options.noise, what)
                if isinstance(given, tuple) and len(given) != problem.unknowns.n:
                    raise IdentificationError(
                        f"has {len(given)} values for {problem.unknowns.n} joints; give one number or as many",
                        f"identify.noise.{what}",
                    )
            return Experiment(scenario, name, options, belief, problem)
        except (IdentificationError, ModelError, ScenarioError) as error:
            raise scenario.locate(error, "identify", name) from error

    @property
    def settings(self) -> Settings:
        """Of the variant."""
        return self.scenario.variants[self.variant]

    def simulated(self, motion: Any = None) -> Recording:
        """A run's recording, with the noise asked for; of the scenario's motion or of another.

        Raises:
            IdentificationError: the arm did not stay on its motion.
        """
        log = self._run({} if motion is None else {"trajectory": asdict(motion)})
        return self.recording_of(log)

    def recording_of(self, log: RunLog) -> Recording:
        """What a run leaves to identification.

        Raises:
            IdentificationError: the arm did not stay on its motion.
        """
        _check(log)
        ideal = log.scenario.get("loop", {}).get("kind") == "ideal"
        signals: Signals = "plant" if ideal else "bus"
        recording = from_run(log, signals, joint_facts(self.problem.model))
        return replace(recording, shook=not log.metrics()["stable"])

    def truth(self) -> Array:
        """Unknowns (P,) of the simulated arm."""
        s = self.settings
        plant = load_model(s.arm, s.plant, timestep=s.plant.timestep, base=self.scenario.folder)
        return self.problem.unknowns.values(plant)

    def write(self, identified: Array, destination: Path) -> None:
        """Write the arm with the unknowns (P,) as an MJCF.

        Raises:
            ModelError: it cannot be written.
        """
        source = model_path(self.belief.arm or self.settings.arm, self.scenario.folder)
        about = f"identified from {self.scenario.name}, variant {self.variant}"
        write_unknowns(self.problem.unknowns, identified, source, destination, about)

    def tried(self, control: ControllerParameters, model: Path) -> dict[str, dict[str, Any]]:
        """Metrics of a control law on the second motion, with the nominal and with the identified model.

        Args:
            control: the law.
            model: MJCF of the identified arm.
        """
        motion = self.options.validation
        change: dict[str, Any] = {} if motion is None else {"trajectory": asdict(motion)}
        made = {}
        for name, belief in (("nominal", self.belief), ("identified", Belief(arm=str(model.resolve())))):
            law = {**asdict(control), "model": asdict(belief)}
            made[name] = self._run({**change, "controller": law}).metrics()
        return made

    def _run(self, changes: Mapping[str, Any]) -> RunLog:
        inside = f"variants.{self.variant}." if self.variant in (self.scenario.document.get("variants") or {}) else ""
        overrides = {f"{inside}{key}": value for key, value in changes.items()}
        return run(self.scenario.changed(overrides, self.variant) if overrides else self.scenario, self.variant)


def _check(log: RunLog) -> None:
    where = f"run {log.name}, {log.variant}"
    if log.diverged_at is not None:
        raise IdentificationError(f"{where}: diverged at {log.diverged_at:.2f} s; its data tell nothing")
    fastest = float(np.abs(log.dq).max())
    if fastest > FASTEST:
        raise IdentificationError(
            f"{where}: a joint moves at {fastest:.4g} rad/s, more than {FASTEST:g}; the loop does not hold the arm"
        )
    if log.stopped is not None:
        raise IdentificationError(f"{where}: stopped at {log.stopped[0]:.2f} s: {log.stopped[1]}")


def noisy(recording: Recording, noise: MeasurementNoise, repeat: int = 0) -> Recording:
    """The recording with white noise on positions and torques; each ``repeat`` draws anew."""
    rng = np.random.default_rng((noise.seed, repeat))
    n = recording.n
    position, torque = (np.broadcast_to(np.asarray(s, float), n) for s in (noise.position, noise.torque))
    if not (position.any() or torque.any()):
        return recording
    q = recording.q + position * rng.normal(size=recording.q.shape)
    tau = recording.tau + torque * rng.normal(size=recording.tau.shape)
    return replace(recording, q=q, tau=tau)


def held_out(recording: Recording) -> tuple[Recording, Recording]:
    """A recording's first part, and its last for validation."""
    cut = round(len(recording.t) * (1.0 - HELD_OUT))
    first = replace(
        recording, t=recording.t[:cut], q=recording.q[:cut], since=recording.since[:cut], tau=recording.tau[:cut]
    )
    first = replace(first, end=float(recording.since[cut].max()))
    last = replace(
        recording, t=recording.t[cut:], q=recording.q[cut:], since=recording.since[cut:], tau=recording.tau[cut:]
    )
    return first, replace(last, source=f"{recording.source}, last {100 * HELD_OUT:.0f} %")
