"""How late a loop is, from its settings: when samples arrive, when commands act, what the whole delay comes to."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lwa4d_sim.channels import Gate
from lwa4d_sim.compensation import Compensator, MomentumObserver
from lwa4d_sim.delays import ExponentialLatency, NormalLatency, TraceLatency, UniformLatency
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.estimators import BackwardDifferenceVelocity, FilteredDerivative, TustinVelocity
from lwa4d_sim.forecast import Forecast, Schedule
from lwa4d_sim.interfaces import NS_PER_S, ArmModel, Array, Estimator, IntArray, Ns, to_ns
from lwa4d_sim.lockstep import natural_phase
from lwa4d_sim.observers import Observer
from lwa4d_sim.settings import CanopenLoop, IdealLoop, SampledLoop, Settings


def computing_phase(loop: SampledLoop, period: Ns, timestep: Ns) -> int:
    """From sample to computation [ns], on the plant's grid and within one period.

    Raises:
        ScenarioError: the phase given is no shorter than the period.
    """
    phase = natural_phase(loop, timestep)
    if loop.phase is not None and phase >= period:
        raise ScenarioError(f"phase {loop.phase} s must be shorter than the period {loop.period} s", key="loop.phase")
    return phase % period


def schedule_of(members: Sequence[Settings]) -> Schedule:
    """When the loop of these settings usually does what; a random latency counts with its mean."""
    period, _ = _grid(members[0])
    latency = np.array([[_measurement(member)] for member in members])
    acts = [each for each in map(_acts, members) if each is not None]
    if not acts:
        return Schedule(period, _alike(latency), None)
    return Schedule(period, _alike(latency), _alike(np.stack(np.broadcast_arrays(*acts))))


def horizons(members: Sequence[Settings]) -> IntArray | None:
    """How far ahead of the sample that is due each predictor looks [ns], (N, 1) or (1, 1); None without predictors.

    Raises:
        ScenarioError: nobody can know when commands act.
    """
    if members[0].compensation is None or members[0].compensation.predictor is None:
        return None
    return _alike(np.array([[_horizon(member)] for member in members]))


def reference_instants(members: Sequence[Settings]) -> list[float]:
    """From a tick to the instant the reference is taken [s], one for all where they are alike.

    That of the computation, or with a predictor the predicted one; half a plant step ahead in the ideal loop.

    Raises:
        ScenarioError: nobody can know when commands act.
    """
    if isinstance(members[0].loop, IdealLoop):
        return [0.5 * to_ns(members[0].plant.timestep) / NS_PER_S]
    ahead = horizons(members)
    if ahead is None:
        return [_phase(members[0]) / NS_PER_S]
    due = np.array([[_due(member)] for member in members])
    instants: list[float] = (_alike(due + ahead)[:, 0] / NS_PER_S).tolist()
    return instants


def loop_delay(settings: Settings) -> float:
    """The delay T_d [s] from the motion of a joint to the torque that answers its speed.

    From the sample to the instant its command acts, less what a predictor makes up for; half a period, the mean delay
    of the hold; and the lag of the speed estimate on a ramp. 0 for the ideal loop.
    """
    loop = settings.loop
    if isinstance(loop, IdealLoop):
        return 0.0
    lag = 0.0
    match loop.velocity:
        case FilteredDerivative(time_constant=T, runs_on=where):
            lag = 2.0 * T + (0.5 * loop.period if where == "held" else 0.0)
        case TustinVelocity(time_constant=T):
            lag = 2.0 * T
        case BackwardDifferenceVelocity():
            lag = 0.5 * loop.period
    acts = _acts(settings)
    waiting = 0.0 if acts is None else float((acts - _due(settings)).max()) / NS_PER_S
    if settings.compensation is not None and settings.compensation.predictor is not None:
        waiting = max(0.0, waiting - _horizon(settings) / NS_PER_S)
    return waiting + 0.5 * loop.period + lag


def compensator(
    members: Sequence[Settings], estimator: Estimator, model: ArmModel, tau_max: Array
) -> Compensator | None:
    """What sits between estimator, law and link of these members, or None; all have the same blocks."""
    observer = estimator if isinstance(estimator, Observer) else None
    ahead = horizons(members)
    rates = [
        block.disturbance_observer.bandwidth
        for block in (member.compensation for member in members)
        if block is not None and block.disturbance_observer is not None
    ]
    if observer is None and ahead is None and not rates:
        return None
    forecast = Forecast(model, tau_max, schedule_of(members), (len(members), len(tau_max)))
    disturbance = MomentumObserver(forecast, np.array(rates)[:, None]) if rates else None
    return Compensator(forecast, observer=observer, horizon=ahead, disturbance=disturbance)


def _grid(settings: Settings) -> tuple[Ns, Ns]:
    timestep = to_ns(settings.plant.timestep)
    loop = settings.loop
    return (timestep if isinstance(loop, IdealLoop) else to_ns(loop.period)), timestep


def _phase(settings: Settings) -> int:
    loop = settings.loop
    return computing_phase(loop, *_grid(settings)) if isinstance(loop, SampledLoop) else 0


def _measurement(settings: Settings) -> int:
    loop = settings.loop
    return to_ns(loop.transports[0].usual_longest) if isinstance(loop, SampledLoop) else 0


def _due(settings: Settings) -> int:
    """Stamp of the sample that tick 0 works on."""
    period, _ = _grid(settings)
    return (_phase(settings) - _measurement(settings)) // period * period


def _acts(settings: Settings) -> IntArray | None:
    """From a tick to when its command acts [ns], (1,) or (n,); None for when it arrives, over a real bus."""
    loop, (period, timestep) = settings.loop, _grid(settings)
    match loop:
        case IdealLoop():
            return np.zeros(1, np.int64)
        case CanopenLoop():
            return np.array([int(period)]) if loop.actuation == "next_sync" else None
    down = loop.transports[1]
    match down.latency:
        case UniformLatency(low=low, high=high):
            mean: Any = 0.5 * (low + high)
        case NormalLatency(mean=mean):
            pass
        case ExponentialLatency(minimum=minimum, tail=tail):
            mean = minimum + tail
        case TraceLatency(values=values):
            mean = float(np.mean(values))
        case constant:
            mean = constant
    seconds = np.atleast_1d(np.asarray(mean, float)) + 0.5 * down.jitter
    arrival = _phase(settings) + np.rint(seconds * NS_PER_S).astype(np.int64)
    opens: IntArray = Gate(timestep, period if loop.actuation == "next_sync" else 0).opens(arrival)
    return opens


def _horizon(settings: Settings) -> int:
    """How far ahead of the due sample the predictor looks [ns]; joints with latencies of their own count with the mean.

    Raises:
        ScenarioError: nobody can know when commands act.
    """
    assert settings.compensation is not None
    assert settings.compensation.predictor is not None
    given = settings.compensation.predictor.horizon
    if given is not None:
        return to_ns(given)
    acts = _acts(settings)
    if acts is None:
        raise ScenarioError(
            "horizon is needed where a command acts when it arrives on a real or simulated bus; give seconds from the "
            "sample to then, or loop.actuation next_sync",
            key="compensation.predictor",
        )
    return round(float(acts.mean())) - _due(settings)


def _alike(rows: IntArray) -> IntArray:
    """One row in place of many equal ones, which costs less."""
    return rows[:1] if (rows == rows[0]).all() else rows
