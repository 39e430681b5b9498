"""How sure a share of runs is."""

import math

Z95 = 1.959963984540054  # quantile 0.975 of the normal law


def wilson(passed: int, runs: int, z: float = Z95) -> tuple[float, float]:
    """Confidence interval of a share, (low, high), by Wilson (1927), "Probable inference, the law of succession".

    Args:
        passed: number of successes.
        runs: number of trials; of none everything is possible.
        z: normal quantile of the confidence.
    """
    if runs == 0:
        return 0.0, 1.0
    share = passed / runs
    centre = (share + z**2 / (2 * runs)) / (1 + z**2 / runs)
    half = z / (1 + z**2 / runs) * math.sqrt(share * (1 - share) / runs + z**2 / (4 * runs**2))
    # the ends are exact where no rounding must spoil them
    return (0.0 if passed == 0 else centre - half), (1.0 if passed == runs else centre + half)
