"""Reads YAML into plain data with a line number for every key, strictly: no dates, no yes/no, no NaN, no repeated keys."""

import math
import re
from collections.abc import Mapping
from typing import Any

import yaml

from lwa4d_sim.errors import ScenarioError

Path = tuple[str | int, ...]
_LIMIT = 200_000  # nodes; a scenario has about a hundred, an alias bomb has more


class _Loader(yaml.CSafeLoader):
    """PyYAML's safe loader with the numbers and booleans of YAML 1.2: 1e-3 is a number, `on` and `no` are text."""

    yaml_implicit_resolvers = {  # noqa: RUF012  (PyYAML's own class attribute)
        first: [(tag, regexp) for tag, regexp in rules if tag.rsplit(":", 1)[1] not in ("bool", "timestamp", "float")]
        for first, rules in yaml.CSafeLoader.yaml_implicit_resolvers.items()
    }


_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), "tTfF")
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+|[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"),
    list("-+0123456789."),
)


def parse(text: str, source: str) -> tuple[Any, dict[Path, int]]:
    """Plain data (dict, list, str, int, float, bool, None) and the line of every path in it.

    Raises:
        ScenarioError: not YAML, or not the plain, finite, acyclic kind.
    """
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            lines: dict[Path, int] = {}
            _check(node, (), lines, source, [0], ())
            return (None if node is None else loader.construct_document(node)), lines
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        where = f"{source}:{mark.line + 1}" if mark is not None else source
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ScenarioError(f"{where}: not valid YAML: {problem}") from error
    except (RecursionError, ValueError, OverflowError) as error:
        if isinstance(error, ScenarioError):
            raise
        raise ScenarioError(f"{source}: not valid YAML: {error}") from error


def _check(node: Any, path: Path, lines: dict[Path, int], source: str, count: list[int], above: tuple[Any, ...]) -> None:
    """Record lines; refuse repeated and non-text keys, loops of aliases, NaN and infinity."""
    if node is None:
        return
    line = node.start_mark.line + 1
    lines.setdefault(path, line)
    count[0] += 1
    if count[0] > _LIMIT or node in above:
        raise ScenarioError(f"{source}:{line}: aliases (*name) nest too deeply")
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            where = f"{source}:{key.start_mark.line + 1}"
            if key.tag != "tag:yaml.org,2002:str":
                raise ScenarioError(f"{where}: key {key.value!r} must be plain text")
            if key.value in seen:
                raise ScenarioError(f"{where}: key '{key.value}' is given twice")
            seen.add(key.value)
            lines[(*path, key.value)] = key.start_mark.line + 1
            _check(value, (*path, key.value), lines, source, count, (*above, node))
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            _check(value, (*path, i), lines, source, count, (*above, node))
    elif node.tag == "tag:yaml.org,2002:float" and not _finite(node.value):
        raise ScenarioError(f"{source}:{line}: {dotted(path)} (={node.value}): must be a finite number")


def _finite(text: str) -> bool:
    try:
        return math.isfinite(float(text.replace("_", "")))
    except ValueError:
        return False  # .nan and .inf are YAML's, not Python's


def dotted(path: Path) -> str:
    """A path as people write it: controller.kp, points.2."""
    return ".".join(str(part) for part in path)


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
        ScenarioError: the path leads through something that is neither a mapping nor a list.
    """
    return _put(document, path.split("."), value, path)


def _put(node: Any, parts: list[str], value: Any, path: str) -> Any:
    if not parts:
        return merge(node, value)
    head, rest = parts[0], parts[1:]
    if isinstance(node, list):
        if not head.isdigit() or int(head) >= len(node):
            raise ScenarioError(f"{path}: '{head}' must be a position from 0 to {len(node) - 1}")
        return [_put(item, rest, value, path) if i == int(head) else item for i, item in enumerate(node)]
    if node is not None and not isinstance(node, Mapping):
        raise ScenarioError(f"{path}: '{head}' cannot be set inside the value {node!r}")
    copy = dict(node or {})
    copy[head] = _put(copy.get(head), rest, value, path)
    return copy
