"""What a controller believes about the arm: the shipped model, with changes of its own, never the plant's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lwa4d_sim.dynamics import ClosedForm3, NominalModel
from lwa4d_sim.edits import ArmEdits
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import ArmModel
from lwa4d_sim.mjcf import load_model


@dataclass(frozen=True, kw_only=True)
class Belief(ArmEdits):
    """The nominal arm: the model file plus these changes (the plant's own changes are not known here).

    Attributes:
        dynamics: mujoco, or closed_form for the thesis's symbolic 3-DOF model with its errata corrected.
    """

    dynamics: Literal["mujoco", "closed_form"] = "mujoco"


def build_beliefs(rows: Sequence[Belief], arm: str, base: Path | None, threads: int) -> ArmModel:
    """The model object of N controllers, one belief each.

    Raises:
        ModelError: an edit does not fit the arm, or the closed form does not describe it.
        ScenarioError: closed-form controllers of one batch believe different things.
    """
    models = [load_model(arm, row, base=base) for row in rows]
    shared = all(model is models[0] for model in models)
    if rows[0].dynamics == "mujoco":
        return NominalModel(models[0] if shared else models, len(rows), threads)
    if not shared:
        raise ScenarioError("controller.model: all runs of one batch must share a closed-form model")
    return ClosedForm3(models[0])
