"""Whether a recording from outside can be what it says it is: long enough, in the right units, with some life in it."""

from collections.abc import Sequence

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.recordings.recording import Recording

FEWEST = 50  # samples; the ten parameters of one link have no meaning from less (assumed)
TURNS = 4 * np.pi  # [rad]; no joint with end stops goes as far (assumed)
SLOWEST = 0.5  # [s] from one sample to the next; what moves in between is lost (assumed)
FASTEST = 20.0  # [rad/s]; ten times what the quickest of SCHUNK's modules does (assumed)
MISSING = 0.5  # share of the positions or torques of a joint that may be missing (assumed)

Limits = Sequence[tuple[float, float] | None]


def check_plausible(recording: Recording, limits: Limits) -> None:
    """Refuse what no arm can have done.

    Args:
        recording: from a table or a log.
        limits: position limits of each joint [rad], None for a joint without.

    Raises:
        IdentificationError: too few samples, too many missing, wrong units, or a torque that never changes.
    """
    where = recording.source
    if len(recording.q) < FEWEST:
        raise IdentificationError(f"{where}: has {len(recording.q)} samples; at least {FEWEST} are needed")
    if not recording.period <= SLOWEST:
        raise IdentificationError(
            f"{where}: samples are {recording.period:.4g} s apart, more than {SLOWEST:g} s; time must be in seconds"
        )
    for j, name in enumerate(recording.joints):
        t, q, tau = recording.t[:, j], recording.q[:, j], recording.tau[:, j]
        for what, values in (("positions", q), ("torques", tau)):
            share = float(np.isnan(values).mean())
            if share > MISSING:
                raise IdentificationError(f"{where}: {share:.0%} of the {what} of {name} are missing; more than half")
        seen = ~np.isnan(q)
        furthest = float(np.abs(q[seen]).max())
        if limits[j] is not None and furthest > TURNS:
            raise IdentificationError(
                f"{where}: {name} goes to {furthest:.4g} rad, twice around; looks like degrees; give units (deg, mdeg)"
            )
        with np.errstate(divide="ignore", invalid="ignore"):  # two frames may have one stamp
            fastest = float(np.abs(np.diff(q[seen]) / np.diff(t[seen])).max())
        if not fastest <= FASTEST:
            raise IdentificationError(
                f"{where}: {name} moves at {fastest:.4g} rad/s, more than {FASTEST:g}; looks like degrees; "
                "give units (deg, mdeg)"
            )
        known = tau[~np.isnan(tau)]
        if (known == known[0]).all():
            raise IdentificationError(f"{where}: the torque of {name} is {known[0]:g} N m throughout; it must change")
