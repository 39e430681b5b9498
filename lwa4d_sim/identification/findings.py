"""One identification from beginning to end: estimate, what it is worth, validation, and the model that is written."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.experiment import Experiment, held_out, noisy
from lwa4d_sim.identification.friction import friction_of
from lwa4d_sim.identification.options import MeasurementNoise
from lwa4d_sim.identification.problem import Problem
from lwa4d_sim.identification.refine import Refined, refine
from lwa4d_sim.identification.study import (
    Fit,
    convergence,
    covers,
    fit_recording,
    nrmse,
    possible,
    predicted,
    refitted,
    without_noise,
)
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import load_model
from lwa4d_sim.recordings.recording import Recording
from lwa4d_sim.scenario import Scenario

STEPS = 4  # of an identification that `identify` announces, beside its repeats
OTHER_DRAW = 2**63 - 1  # number of the noise on the second motion, out of the way of all repeats
AGAIN = 8  # assumed: draws of noise behind the mean that tells a bias


@dataclass(frozen=True)
class Validation:
    """What the estimate says about a motion that it has not seen.

    Attributes:
        source: of the motion.
        t: middle of each window (W,) [s].
        torque: measured, filtered (W, n) [N m].
        predictions: the same by estimate, by the identified model and by the nominal one.
        nrmse: of each prediction (n,): rms of what is wrong over the torque's standard deviation.
    """

    source: str
    t: Array
    torque: Array
    predictions: Mapping[str, Array]
    nrmse: Mapping[str, Array]


@dataclass(frozen=True)
class Findings:
    """What an identification found.

    Attributes:
        scenario, variant: where it comes from.
        problem: what was asked.
        recording: the data.
        fit: of the parameters.
        truth: the parameters (r,) of the simulated arm, or None for a real one.
        identified: unknowns (P,) of the arm that the MJCF describes.
        validation: on a second motion.
        convergence: instants (W,) [s] and recursive estimates (W, r).
        bias: by what is left out, how far the estimate moves (r,).
        coverage: share of repeats whose interval holds the truth (r,), or None.
        repeats: number of them.
        tried: metrics of a controller with the nominal and with the identified model.
        refined: what the motion itself says about delay and friction, or None.
        remarks: what a reader should know.
    """

    scenario: Scenario
    variant: str
    problem: Problem
    recording: Recording
    fit: Fit
    truth: Array | None
    identified: Array
    validation: Validation
    convergence: tuple[Array, Array]
    bias: Mapping[str, Array]
    coverage: Array | None = None
    repeats: int = 0
    tried: Mapping[str, Mapping[str, Any]] | None = None
    refined: Refined | None = None
    remarks: tuple[str, ...] = ()


def bias(problem: Problem, recording: Recording, found: Fit) -> dict[str, Array]:
    """How far the estimate (r,) moves when something that a bus does to the data is not allowed for."""
    x, made = refitted(problem, recording, found), dict[str, Array]()
    period = recording.period
    lags = recording.since - recording.t
    if (lags > 1e-9).any():
        delayed = replace(recording, since=recording.t.copy())
        made["command latency ignored"] = refitted(problem, delayed, found) - x
    sampled = replace(recording, since=recording.since - 0.5 * period, end=recording.end - 0.5 * period)
    made["torque taken as sampled, not held"] = refitted(problem, sampled, found) - x
    if np.ptp(recording.t, axis=1).max() > 1e-9:
        together = replace(recording, t=np.repeat(recording.t.min(axis=1, keepdims=True), recording.n, axis=1))
        made["time stamps of the joints ignored"] = refitted(problem, together, found) - x
    if (found.equations.noise > 0).any():
        # noise once more: what it does to the mean, it has done once already (simulation extrapolation, Cook 1994)
        rng = np.random.default_rng(0)
        shifts = []
        for _ in range(AGAIN):
            again = replace(recording, q=recording.q + found.equations.noise * rng.normal(size=recording.q.shape))
            shifts.append(refitted(problem, again, found) - x)
        made["noise and quantisation of the positions"] = np.mean(shifts, axis=0)
    return made


def _acting(problem: Problem, recording: Recording, found: Fit) -> Recording:
    """The recording with the torques that acted, where the drives' gains were found."""
    if "gain" not in problem.unknowns.kinds:
        return recording
    gains = problem.all_unknowns(found.estimate.nearest)[problem.unknowns.columns("gain")]
    return replace(recording, tau=recording.tau * (1.0 + gains))


def validate(problem: Problem, recording: Recording, found: Fit, identified: Array, model: Any) -> Validation:
    """Predict the torque of a second recording.

    Args:
        problem: what was asked.
        recording: the second motion.
        found: the estimate.
        identified: unknowns (P,) of the identified arm.
        model: that arm, compiled.
    """
    there = replace(problem, friction=friction_of(model))
    made = there.equations(recording, problem.coulomb(identified))
    before = problem.equations(recording, problem.coulomb(problem.nominal))
    if "gain" in problem.unknowns.kinds:
        x = problem.all_unknowns(found.estimate.nearest)
        made, before = without_noise(there, made, x), without_noise(problem, before, problem.nominal)
    predictions = {
        "estimate": predicted(problem, made, found.estimate.nearest),
        "identified": made.Y @ identified,
        "nominal": before.Y @ problem.nominal,
    }
    return Validation(
        recording.source, made.t, made.b, predictions, {k: nrmse(problem, made, v) for k, v in predictions.items()}
    )


def identify(
    experiment: Experiment,
    destination: Path,
    *,
    data: tuple[Recording, Recording | None] | None = None,
    repeats: int = 0,
    advance: Callable[[], None] = lambda: None,
) -> Findings:
    """Do it all, and write the MJCF.

    Args:
        experiment: what is asked.
        destination: of the MJCF.
        data: measured recordings in place of simulated ones; the second is for validation.
        repeats: simulate the measurement's noise so many times, to see how often the intervals hold the truth.
        advance: called after each of `STEPS` and of the repeats.

    Raises:
        IdentificationError: the data do not serve.
    """
    problem, options = experiment.problem, experiment.options
    clean = None
    if data is None:
        clean = experiment.simulated()
        first = noisy(clean, options.noise)
        second = (
            None
            if options.validation is None
            else noisy(experiment.simulated(options.validation), options.noise, OTHER_DRAW)
        )
    else:
        first, second = data
    if second is None:
        first, second = held_out(first)
        clean = None if clean is None else held_out(clean)[0]
    advance()
    try:
        found = fit_recording(problem, first)
    except IdentificationError as error:
        where = experiment.scenario
        raise error if error.key is None else where.locate(error, error.key, experiment.variant) from error
    identified = possible(problem, found)
    advance()
    experiment.write(identified, destination)
    model = load_model(str(destination))
    truth = problem.value(experiment.truth()) if data is None else None
    coverage = None
    if repeats and clean is not None and truth is not None:
        coverage = covered(problem, clean, options.noise, found, truth, repeats, advance)
    moved = bias(problem, first, found)
    advance()
    refined = refine(destination, _acting(problem, first, found)) if options.refine else None
    tried = None if options.control is None or data is not None else experiment.tried(options.control, destination)
    advance()
    return Findings(
        scenario=experiment.scenario,
        variant=experiment.variant,
        problem=problem,
        recording=first,
        fit=found,
        truth=truth,
        identified=identified,
        validation=validate(problem, second, found, identified, model),
        convergence=convergence(problem, found),
        bias=moved,
        coverage=coverage,
        repeats=repeats,
        tried=tried,
        refined=refined,
        remarks=first.remarks,
    )


def covered(
    problem: Problem,
    clean: Recording,
    noise: MeasurementNoise,
    found: Fit,
    truth: Array,
    repeats: int,
    advance: Callable[[], None] = lambda: None,
) -> Array:
    """Share (r,) of seeded repeats of the noise in which each 95 % interval holds the truth.

    Every repeat estimates its noise anew; how noise spreads into the parameters is taken from the first fit, for it
    depends on the motion alone.

    Raises:
        IdentificationError: there is no noise to repeat.
    """
    if not (np.any(noise.position) or np.any(noise.torque)):
        raise IdentificationError("repeats need noise to draw; set identify.noise.position or identify.noise.torque")
    held = np.zeros(len(truth))
    for repeat in range(1, repeats + 1):
        again = fit_recording(problem, noisy(clean, noise, repeat), found)
        held += covers(again.estimate.x, again.std_error, truth)
        advance()
    return held / repeats
