"""A testbed for robot-arm controllers that must live on a CAN bus."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lwa4d_sim.record import RunLog as RunLog
    from lwa4d_sim.runner import run as run
    from lwa4d_sim.scenario import Scenario as Scenario

__version__ = "0.1.0"
__all__ = ["RunLog", "Scenario", "run"]

_HOMES = {"RunLog": "lwa4d_sim.record", "Scenario": "lwa4d_sim.scenario", "run": "lwa4d_sim.runner"}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `import lwa4d_sim` itself does nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'lwa4d_sim' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
