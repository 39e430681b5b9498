"""What a controller believes about the arm: a model file with changes of its own, never the plant's."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from lwa4d_sim.dynamics import ClosedForm3, NominalModel
from lwa4d_sim.edits import ArmEdits
from lwa4d_sim.errors import ModelError, ScenarioError
from lwa4d_sim.interfaces import ArmModel
from lwa4d_sim.mjcf import load_model

_ARM = "controller.model.arm"


@dataclass(frozen=True, kw_only=True)
class Belief(ArmEdits):
    """The nominal arm: the model file plus these changes (the plant's own changes are not known here).

    Attributes:
        arm: name or path of another model of the same arm, as `identify` writes one; default the scenario's arm.
        dynamics: mujoco, or closed_form for the thesis's symbolic 3-DOF model with its errata corrected.
    """

    arm: str | None = None
    dynamics: Literal["mujoco", "closed_form"] = "mujoco"


def believed_model(belief: Belief, arm: str, base: Path | None) -> Any:
    """The compiled model of a belief.

    Args:
        belief: the controller's.
        arm: the scenario's.
        base: folder that a relative path starts from.

    Raises:
        ScenarioError: the belief's own arm cannot be loaded, or has not as many joints as the scenario's.
        ModelError: an edit does not fit the arm.
    """
    if belief.arm is None:
        return load_model(arm, belief, base=base)
    try:
        own, real = load_model(belief.arm, base=base).njnt, load_model(arm, base=base).njnt
    except ModelError as error:
        raise ScenarioError(str(error), key=_ARM) from error
    if own != real:
        raise ScenarioError(f"has {own} joints, the arm {arm} has {real}; name a model of the same arm", key=_ARM)
    return load_model(belief.arm, belief, base=base)


def build_beliefs(rows: Sequence[Belief], arm: str, base: Path | None, threads: int) -> ArmModel:
    """The model object of N controllers, one belief each.

    Raises:
        ModelError: an edit does not fit the arm, or the closed form does not describe it.
        ScenarioError: a belief's own arm does not fit (see `believed_model`), or closed-form controllers of one batch
            believe different things.
    """
    models = [believed_model(row, arm, base) for row in rows]
    shared = all(model is models[0] for model in models)
    if rows[0].dynamics == "mujoco":
        return NominalModel(models[0] if shared else models, len(rows), threads)
    if not shared:
        raise ScenarioError("controller.model: all runs of one batch must share a closed-form model")
    return ClosedForm3(models[0])
