"""A user's own control law: a class on `sys.path`, named in the scenario as `package.module:Class`."""

import importlib
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from lwa4d_sim.controllers.belief import Belief
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import STRICT, ArmModel, Array, Controller, JointState


@dataclass(frozen=True, kw_only=True)
class CustomController:
    """A class with a method `torque(state, ref, model)`; see docs/controllers.md.

    Attributes:
        kind: `package.module:Class`.
        space: which reference it gets: a JointReference or a TaskReference.
        model: what it believes about the arm.
        options: every other key of the scenario's controller block, passed to the class by name.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: str
    space: Literal["joint", "task"] = "joint"
    model: Belief = Belief()
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Leave every other kind to the shipped controllers (ValueError)."""
        if ":" not in self.kind:
            raise ValueError("kind must be package.module:Class")

    def create(self) -> Controller:
        """Import the class and make one.

        Raises:
            ScenarioError: no such module or class, wrong options, or no `torque` method.
        """
        law = load_object(self.kind, "controller.kind", self.options)
        if not callable(getattr(law, "torque", None)):
            raise ScenarioError(f"{self.kind} has no method torque(state, ref, model)", key="controller.kind")
        return _Checked(self.kind, law)


@dataclass(frozen=True, slots=True)
class _Checked:
    """A user's law with its answers checked and copied, for it may well return the same array every time."""

    kind: str
    law: Controller

    def torque(self, state: JointState, ref: Any, model: ArmModel) -> Array:
        try:
            tau = np.array(self.law.torque(state, ref, model), float)
        except Exception as error:  # it may raise anything; its author needs the line
            raise ScenarioError(f"torque() of {self.kind} raised {_told(error)}", key="controller.kind") from error
        if tau.shape != state.q.shape:
            rule = f"must be {state.q.shape}: a row for each simulation, a column for each joint"
            raise ScenarioError(f"torque() of {self.kind} returned shape {tau.shape}; {rule}", key="controller.kind")
        return tau


def _told(error: Exception) -> str:
    """What a user's own code raised, and where in it."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(last.filename).name}, line {last.lineno})"


def load_object(kind: str, key: str, options: Mapping[str, Any]) -> Any:
    """An instance of the class named ``package.module:Class``, made with ``options``.

    Raises:
        ScenarioError: it cannot be imported or made; the message names ``key``.
    """
    module_name, _, class_name = kind.partition(":")
    try:
        factory = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ScenarioError(f"{error}; give package.module:Class, importable from here", key=key) from error
    try:
        return factory(**options)
    except (TypeError, ValueError) as error:
        raise ScenarioError(f"cannot be made from {dict(options)}: {error}", key=key) from error
