"""A scenario as plain data (what JSON can hold): paths into it, overrides laid over it, and how errors show it."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from lwa4d_sim.errors import ScenarioError

Path = tuple[str | int, ...]
DEPTH = 50  # levels of nesting; a scenario has about eight
NOT_FINITE = "must be a finite number"

_Number = TypeVar("_Number", int, float)


def finite(number: _Number) -> _Number:
    """The number itself.

    Raises:
        ValueError: it is NaN or infinite, or an integer beyond every float.
    """
    try:
        if math.isfinite(number):
            return number
    except OverflowError:
        pass
    raise ValueError(NOT_FINITE)


def plain(value: Any, where: str) -> Any:
    """A Python value (tuples and NumPy data included) as the data that YAML could have held.

    Raises:
        ScenarioError: it is something else; the message begins with ``where``.
    """
    return _plain(value, where, 0)


def _plain(value: Any, where: str, depth: int) -> Any:
    value = value.tolist() if hasattr(value, "tolist") else value  # NumPy's scalars and arrays
    if depth > DEPTH:
        raise ScenarioError(f"{where}: nests deeper than {DEPTH} levels")
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _plain(item, where, depth + 1) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, where, depth + 1) for item in value]
    if isinstance(value, (int, float)):
        try:
            return finite(value)
        except ValueError as error:
            raise ScenarioError(f"{where}: {error}") from None
    if value is None or isinstance(value, str):
        return value
    kind = f"a {type(value).__name__}" if not isinstance(value, Mapping) else "a mapping with keys that are not text"
    raise ScenarioError(f"{where}: {kind} cannot stand in a scenario; give text, numbers, lists or mappings")


def dotted(path: Path) -> str:
    """A path as people write it: controller.kp, points.2."""
    return ".".join(str(part) for part in path)


def short(value: Any) -> str:
    """A value as an error shows it."""
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=repr)
    return text if len(text) <= 60 else f"{text[:57]}..."


def one_line(text: str) -> str:
    """``text`` with line breaks and other unprintable characters escaped."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


@dataclass(frozen=True, slots=True)
class Place:
    """Where the keys of a document stand.

    Attributes:
        source: the file.
        document: as plain data.
        lines: of its paths.
    """

    source: str
    document: Any
    lines: Mapping[Path, int]

    def error(self, path: Path, rule: str) -> ScenarioError:
        """An error at a key: file, line, key, value, rule."""
        line = next((self.lines[path[:cut]] for cut in range(len(path), 0, -1) if path[:cut] in self.lines), None)
        value: Any = self.document
        for part in path:
            value = value[part] if isinstance(value, dict) and part in value else None
        shown = "" if value is None or isinstance(value, (dict, list)) else f" (={short(value)})"
        where = self.source if line is None else f"{self.source}:{line}"
        return ScenarioError(one_line(f"{where}: {dotted(path)}{shown}: {rule}"))


def merge(base: Any, override: Any) -> Any:
    """``override`` laid over ``base``: mappings merge key by key, anything else replaces.

    A mapping that names another `kind` than the base replaces it whole, for its keys are another block's.
    """
    if not (isinstance(base, Mapping) and isinstance(override, Mapping)):
        return override
    if "kind" in override and override["kind"] != base.get("kind", override["kind"]):
        return override
    merged = dict(base)
    for key, value in override.items():
        merged[key] = merge(base[key], value) if key in base else value
    return merged


def put(document: Any, path: str, value: Any) -> Any:
    """A copy of ``document`` with ``value`` at the dotted ``path``; list positions are numbers.

    Raises:
        ScenarioError: the path leads through something that is neither a mapping nor a list, or is absurdly long.
    """
    parts = path.split(".")
    if len(parts) > DEPTH:
        raise ScenarioError(f"{short(path)}: has more than {DEPTH} levels")
    return _put(document, parts, value, path)


def _put(node: Any, parts: list[str], value: Any, path: str) -> Any:
    if not parts:
        return merge(node, value)
    head, rest = parts[0], parts[1:]
    if isinstance(node, list):
        if head not in map(str, range(len(node))):
            positions = f"a position from 0 to {len(node) - 1}" if node else "gone: the list is empty"
            raise ScenarioError(f"{path}: '{head}' must be {positions}")
        return [_put(item, rest, value, path) if str(i) == head else item for i, item in enumerate(node)]
    if node is not None and not isinstance(node, Mapping):
        raise ScenarioError(f"{path}: '{head}' cannot be set inside the value {short(node)}")
    copy = dict(node or {})
    copy[head] = _put(copy.get(head), rest, value, path)
    return copy
