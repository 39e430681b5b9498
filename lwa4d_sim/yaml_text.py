"""Reads YAML into plain data with a line for every key, strictly: no dates, no yes/no, no NaN, no repeated keys."""

import re
from collections.abc import Callable
from typing import Any

import yaml

from lwa4d_sim.documents import DEPTH, NOT_FINITE, Path, dotted, finite, one_line
from lwa4d_sim.errors import ScenarioError

_LIMIT = 200_000  # nodes; a scenario has about a hundred, an alias bomb has more
_TAG = "tag:yaml.org,2002:"


class _Loader(yaml.CSafeLoader):
    """PyYAML's parser with the scalars of YAML 1.2: 1e-3 is a number; `on`, 1:30 and 2024-01-01 are text."""

    yaml_implicit_resolvers = {}  # noqa: RUF012  (PyYAML's own class attribute)


class _Dumper(yaml.SafeDumper):
    """PyYAML's writer; puts quotes around text that either YAML 1.1 or `parse` would take for something else."""


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(?:0|[1-9][0-9]*)", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+0123456789."),
    ),
):
    for _side in (_Loader, _Dumper):
        _side.add_implicit_resolver(_TAG + _tag, re.compile(f"^(?:{_pattern})$"), _first)


def dump(document: Any) -> str:
    """Plain data as YAML that `parse` reads back; short lists and mappings stand on one line."""
    text: str = yaml.dump(document, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120)
    return text


def parse(text: str, source: str, *, numbered: bool = True) -> tuple[Any, dict[Path, int]]:
    """Plain data (dict, list, str, int, float, bool, None) and the line of every path in it.

    Args:
        text: the YAML.
        source: what errors call it.
        numbered: errors give the line as well.

    Raises:
        ScenarioError: not YAML, or not the plain, finite, acyclic kind.
    """
    reader = _Reader(source, numbered)
    try:
        reader.check_depth(text)
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        where = source if mark is None else reader.where(mark)
        context, problem = (
            getattr(error, "context", None),
            getattr(error, "problem", None) or str(error).splitlines()[0],
        )
        reason = f"{context}, {problem}" if context else problem
        raise ScenarioError(one_line(f"{where}: not valid YAML: {reason}")) from error
    except UnicodeEncodeError as error:
        raise ScenarioError(f"{source}: not valid YAML: holds a character that is no Unicode text") from error
    return (None if node is None else reader.read(node, ())), reader.lines


class _Reader:
    """Turns YAML nodes into plain data and notes their lines."""

    def __init__(self, source: str, numbered: bool) -> None:
        self._source, self._numbered = source, numbered
        self._count = 0
        self.lines: dict[Path, int] = {}

    def where(self, mark: Any) -> str:
        """The source and, if wanted, the line of a mark."""
        return f"{self._source}:{mark.line + 1}" if self._numbered else self._source

    def check_depth(self, text: str) -> None:
        """Refuse deep nesting before the composer, which is recursive C code, meets it."""
        depth = 0
        for event in yaml.parse(text, _Loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEPTH:
                raise ScenarioError(f"{self.where(event.start_mark)}: nests deeper than {DEPTH} levels")

    def read(self, node: Any, path: Path) -> Any:
        """The data of a node at ``path``."""
        self.lines.setdefault(path, node.start_mark.line + 1)
        self._count += 1
        if self._count > _LIMIT or len(path) > DEPTH:
            raise ScenarioError(
                f"{self.where(node.start_mark)}: holds too much; do aliases (*name) contain each other?"
            )
        if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
            return [self.read(item, (*path, i)) for i, item in enumerate(node.value)]
        read = _SCALARS.get(node.tag.removeprefix(_TAG))
        if read is None or not isinstance(node, yaml.ScalarNode):
            raise self._error(node, path, f"the tag {node.tag.replace(_TAG, '!!')} does not fit here")
        try:
            return read(node.value)
        except ValueError as error:
            raise self._error(node, path, str(error)) from None

    def _mapping(self, node: Any, path: Path) -> dict[str, Any]:
        data: dict[str, Any] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != _TAG + "str":
                shown = f" {key.value!r}" if isinstance(key, yaml.ScalarNode) else ""
                raise ScenarioError(f"{self.where(key.start_mark)}: the key{shown} must be plain text")
            if key.value in data:
                raise ScenarioError(f"{self.where(key.start_mark)}: the key {key.value!r} is given twice")
            self.lines[(*path, key.value)] = key.start_mark.line + 1
            data[key.value] = self.read(value, (*path, key.value))
        return data

    def _error(self, node: Any, path: Path, rule: str) -> ScenarioError:
        place = f"{self.where(node.start_mark)}: {dotted(path)}" if path else self.where(node.start_mark)
        value = f" (={node.value[:60]})" if isinstance(node, yaml.ScalarNode) else ""
        return ScenarioError(one_line(f"{place}{value}: {rule}"))


def _bool(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError("must be true or false")
    return text.lower() == "true"


def _int(text: str) -> int:
    if len(text) > 400 or not re.fullmatch("[-+]?[0-9]+", text):  # Python refuses to read more than 4300 digits
        raise ValueError("must be a whole number below 1e308")
    return finite(int(text))


def _float(text: str) -> float:
    try:
        return finite(float(text))
    except ValueError:  # .nan and .inf are words of YAML, not of Python
        raise ValueError(NOT_FINITE) from None


_SCALARS: dict[str, Callable[[str], Any]] = {
    "str": str,
    "null": lambda _: None,
    "bool": _bool,
    "int": _int,
    "float": _float,
}
