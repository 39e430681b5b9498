"""Run logs made by hand, for tests of what is drawn and written about them."""

from typing import Any

import numpy as np

from lwa4d_sim.interfaces import Array, Ns
from lwa4d_sim.record import RunLog, StoredPaths, TickLog


def made_log(
    variant: str = "can",
    *,
    name: str = "made",
    steps: int = 4001,
    n: int = 3,
    ideal: bool = False,
    shakes_from: float | None = None,
    diverged_at: float | None = None,
    limit: float = 50.0,
    **changes: Any,
) -> RunLog:
    """Four seconds at 1 ms in two segments; with ``shakes_from`` a 30 Hz vibration of every joint from then on."""
    t: Array = np.arange(steps, dtype=np.float64)[:, None] / 1000
    phase = np.arange(n)
    on = np.zeros_like(t) if shakes_from is None else np.maximum(t - shakes_from, 0)
    growth = 1.0 if diverged_at is None else np.exp(np.minimum(6 * on, 12))
    wave = growth * np.minimum(on, 1) * np.sin(2 * np.pi * 30 * t)
    q = np.sin(t + phase) + 0.01 * wave
    dq = np.cos(t + phase) + 3 * wave
    tau = np.clip(5 * np.cos(t + phase) + 20 * wave, -limit, limit)
    at = slice(0, steps - 1, 10)
    loop = {"kind": "ideal"} if ideal else {"kind": "sampled", "period": 0.01}
    values: dict[str, Any] = {
        "name": name,
        "variant": variant,
        "timestep": Ns(1_000_000),
        "period": Ns(1_000_000 if ideal else 10_000_000),
        "q": q,
        "dq": dq,
        "tau": tau,
        "ticks": TickLog(
            t=t[at, 0],
            q=q[at],
            dq=0.9 * dq[at],
            tau=tau[at],
            age=np.zeros(len(t[at])),
            q_true=q[at],
            dq_true=dq[at],
            q_ref=np.sin(t + phase)[at],
        ),
        "knots": np.array([2.0, 4.0]),
        "tau_max": np.full(n, limit),
        "seed": 7,
        "diverged_at": diverged_at,
        "events": ((0.25, "brakes released"),),
        "scenario": {"loop": loop, "trajectory": {"waypoints": {}}},
        "versions": {"lwa4d_sim": "0.1.0"},
        "paths": StoredPaths(q[:, np.arange(3) % n], np.sin(t + np.arange(3))),
    }
    return RunLog(**(values | changes))


def pair() -> dict[str, RunLog]:
    """A calm ideal run and one that shakes under the bus."""
    return {"ideal": made_log("ideal", ideal=True), "can": made_log("can", shakes_from=2.5)}
