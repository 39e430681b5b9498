"""Fits plain data to the parameter classes; of what does not fit it says which key is wrong and what would be right."""

import dataclasses
import difflib
import json
import types
import typing
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, TypeVar

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from lwa4d_sim.controllers import CustomController
from lwa4d_sim.documents import Path
from lwa4d_sim.interfaces import bare_key
from lwa4d_sim.metrics import FLAGS, METRICS
from lwa4d_sim.settings import CHOICES, Settings

# Beyond this a number in SI units (three years, a hundred thousand tons) is a mistake, and its square may overflow;
# below the other a time constant is. Assumed.
_LARGEST, _SMALLEST = 1e8, 1e-12

_T = TypeVar("_T")


class Misfit(Exception):
    """A key that does not fit the schema.

    Args:
        path: of the key in the document.
        rule: what is wrong and what would be valid.
    """

    def __init__(self, path: Path, rule: str) -> None:
        super().__init__(rule)
        self.path, self.rule = path, rule


def fit(document: Any, cls: type[_T]) -> _T:
    """The parameter class ``cls`` filled from ``document``.

    Raises:
        Misfit: with the first thing wrong, from the top down.
    """
    reading = _Reading()
    resolved = reading.resolve((cls,), document, ())
    try:
        made: _T = _adapter(typing.cast(Any, cls)).validate_json(json.dumps(resolved), strict=True)
    except ValidationError as error:
        raise reading.explain(error.errors(include_url=False, include_context=False), resolved) from None
    return made


def json_schema() -> dict[str, Any]:
    """JSON schema of a scenario file, for editors.

    A variant's overrides are checked by name only: what they must hold depends on what they are merged into.
    """
    schema = _adapter(Settings).json_schema()
    settings: dict[str, Any] = schema["properties"]
    override: dict[str, Any] = {key: {} for key in settings if key != "name"}
    variant = {"type": ["object", "null"], "properties": override, "additionalProperties": False}
    bound = {"type": ["number", "null"]}
    numbers = {"anyOf": [bound, {"type": "array", "items": bound, "minItems": 1}]}
    names = "|".join(METRICS)
    checks = {
        "type": "object",
        "properties": {flag: {"type": "boolean"} for flag in FLAGS},
        "patternProperties": {f"^({names})_(max|min)$": numbers},
        "additionalProperties": False,
    }
    settings["variants"] = {"type": ["object", "null"], "additionalProperties": variant}
    settings["expect"] = {"type": ["object", "null"], "additionalProperties": checks}
    own = schema["$defs"]["CustomController"]
    del own["properties"]["options"]
    own["properties"]["kind"]["pattern"] = ":"
    own["additionalProperties"] = True
    return {**schema, "required": ["name"]}


@cache
def _adapter(cls: Any) -> TypeAdapter[Any]:
    return TypeAdapter(cls)


@cache
def _fields(cls: Any) -> dict[str, Any]:
    """Keys and resolved types of a parameter class."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return {bare_key(field.name): hints[field.name] for field in dataclasses.fields(cls)}


@cache
def _members(annotation: Any, rules: tuple[Any, ...] = ()) -> tuple[Any, ...]:
    """The types a value may have, unions opened; a type with rules stays wrapped in Annotated."""
    if typing.get_origin(annotation) is typing.Annotated:
        inner, *more = typing.get_args(annotation)
        return _members(inner, (*rules, *more))
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return tuple(member for part in typing.get_args(annotation) for member in _members(part, rules))
    return (typing.Annotated[annotation, *rules] if rules else annotation,)


def _bare(member: Any) -> Any:
    return typing.get_args(member)[0] if typing.get_origin(member) is typing.Annotated else member


def _rules(member: Any) -> tuple[Any, ...]:
    return typing.get_args(member)[1:] if typing.get_origin(member) is typing.Annotated else ()


@cache
def _items(members: tuple[Any, ...], i: int) -> tuple[Any, ...]:
    """What the item ``i`` of a list may be."""
    tuples = [typing.get_args(_bare(m)) for m in members if typing.get_origin(_bare(m)) is tuple]
    return tuple(
        inner for args in tuples for inner in _members(args[0 if args[-1] is Ellipsis else min(i, len(args) - 1)])
    )


@cache
def _values(members: tuple[Any, ...]) -> tuple[Any, ...]:
    """What the values of a mapping with free keys may be."""
    mappings = [typing.get_args(_bare(m)) for m in members if typing.get_origin(_bare(m)) is Mapping]
    return tuple(inner for args in mappings for inner in _members(args[1]))


class _Reading:
    """What each place of one document may hold, and which class each of its mappings means."""

    def __init__(self) -> None:
        self._valid: dict[Path, tuple[Any, ...]] = {}
        self._chosen: dict[Path, str] = {}

    def resolve(self, members: tuple[Any, ...], node: Any, path: Path) -> Any:
        """``node`` with left-out kinds filled in."""
        self._valid[path] = members
        if isinstance(node, Mapping):
            classes = [member for member in members if dataclasses.is_dataclass(member)]
            if classes:
                return self._resolve_mapping(classes, dict(node), path)
            return {key: self.resolve(_values(members), value, (*path, key)) for key, value in node.items()}
        if isinstance(node, list):
            return [self.resolve(_items(members, i), value, (*path, i)) for i, value in enumerate(node)]
        if isinstance(node, (int, float)) and float in map(_bare, members):
            if abs(node) > _LARGEST:
                raise Misfit(path, f"must lie within {-_LARGEST:g} and {_LARGEST:g}")
            if 0 < node < _SMALLEST and any(isinstance(rule, Gt) for member in members for rule in _rules(member)):
                raise Misfit(path, f"must be at least {_SMALLEST:g}")
        return node

    def _resolve_mapping(self, classes: list[Any], node: dict[str, Any], path: Path) -> Any:
        cls = _choose(classes, node, path)
        fields = _fields(cls)
        if cls is CustomController:
            node["options"] = {key: node.pop(key) for key in list(node) if key not in fields or key == "options"}
        for key in node:
            if key not in fields:
                raise Misfit((*path, key), unknown_key(key, fields))
        for field in dataclasses.fields(cls):
            required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            key = bare_key(field.name)
            if required and key not in node:
                raise Misfit((*path, key), f"is missing; it must be {_wanted(_members(fields[key]))}")
        self._chosen[path] = cls.__name__
        return {key: self.resolve(_members(fields[key]), value, (*path, key)) for key, value in node.items()}

    def explain(self, errors: list[ErrorDetails], document: Any) -> Misfit:
        """The first error that belongs to the classes the document chose."""
        found = [(path, error) for error in errors if (path := self._path(error["loc"], document)) is not None]
        first = found[0][0] if found else ()
        # of a union's branches the one that got furthest into the value knows best what is wrong
        path, error = max(
            (pair for pair in found if pair[0][: len(first)] == first),
            key=lambda pair: len(pair[0]),
            default=((), errors[0]),
        )
        if error["type"] == "value_error":
            return Misfit(path, error["msg"].removeprefix("Value error, "))
        return Misfit(path, f"must be {_wanted(self._valid[path])}")

    def _path(self, location: tuple[int | str, ...], document: Any) -> Path | None:
        """The document's path in pydantic's, or None when that runs through a class the document did not choose."""
        path: Path = ()
        node = document
        for part in location:
            inside = isinstance(node, Mapping) and part in node
            inside = inside or (isinstance(node, list) and isinstance(part, int) and part < len(node))
            if inside:
                node = node[part]
                path = (*path, part)
            elif path in self._chosen and part != self._chosen[path]:
                return None
        return path


def unknown_key(key: str, valid: Mapping[str, Any] | Sequence[str]) -> str:
    """The rule that an unknown key breaks."""
    close = difflib.get_close_matches(key.lower(), valid, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"unknown key; {hint}valid here: {', '.join(valid)}"


def _choose(classes: list[Any], node: dict[str, Any], path: Path) -> Any:
    """The class a mapping means: by its kind, else by its keys."""
    plain = [cls for cls in classes if "kind" not in _fields(cls)]
    if "kind" not in node and len(path) == 1 and path[0] in CHOICES:
        node["kind"] = CHOICES[str(path[0])]
    if plain and not ("kind" in node and len(plain) < len(classes)):
        return max(plain, key=lambda cls: len(_fields(cls).keys() & node.keys()))
    kinds = _kinds(classes)
    if "kind" not in node:
        raise Misfit((*path, "kind"), f"is missing; give one of {', '.join(kinds)}")
    if node["kind"] is True and "true" in kinds:  # what YAML makes of `kind: true`
        node["kind"] = "true"
    kind = node["kind"]
    if not isinstance(kind, str) or (kind not in kinds and not (_OWN in kinds and ":" in kind)):
        raise Misfit((*path, "kind"), f"must be one of {', '.join(kinds)}")
    return kinds.get(kind, CustomController)


_OWN = "package.module:Class"  # stands for the kind of a user's own class


def _kinds(classes: Sequence[Any]) -> dict[str, Any]:
    """The classes by the kinds that choose them."""
    with_kind = [cls for cls in classes if "kind" in _fields(cls)]
    return {kind: cls for cls in with_kind for kind in typing.get_args(_fields(cls)["kind"]) or [_OWN]}


def _wanted(members: Sequence[Any]) -> str:
    """What would be valid, in words."""
    classes: list[Any] = [member for member in members if dataclasses.is_dataclass(member)]
    phrases = [_phrase(member) for member in members if member is not types.NoneType and member not in classes]
    if kinds := _kinds(classes):
        phrases.append(f"a mapping of kind {' or '.join(kinds)}")
    phrases += [f"a mapping (keys: {', '.join(_fields(cls))})" for cls in classes if "kind" not in _fields(cls)]
    return ", or ".join(dict.fromkeys(phrases))


def _phrase(member: Any, plural: bool = False) -> str:
    bare, rules = _bare(member), _rules(member)
    if bare in _NOUNS:
        bounds = " and ".join(filter(None, map(_bound, rules)))
        return f"{_NOUNS[bare][plural]} {bounds}".strip()
    if typing.get_origin(bare) is typing.Literal:
        values = typing.get_args(bare)
        return f"one of {', '.join(values)}" if len(values) > 1 else repr(values[0])
    if typing.get_origin(bare) is tuple:
        args = typing.get_args(bare)
        items = " or ".join(_phrase(item, plural=True) for item in _members(args[0]))
        if args[-1] is not Ellipsis:
            return f"{'lists' if plural else 'a list'} of {len(args)} {items}"
        some = "one or more " if any(isinstance(rule, MinLen) for rule in rules) else ""
        return f"{'lists' if plural else 'a list'} of {some}{items}"
    if bare is Any:
        return "values of any kind" if plural else "anything"
    return "mappings" if plural else "a mapping"


_NOUNS: Mapping[Any, tuple[str, str]] = {
    bool: ("true or false", "true or false"),
    float: ("a number", "numbers"),
    int: ("a whole number", "whole numbers"),
    str: ("text", "texts"),
}


def _bound(rule: Any) -> str:
    """A limit in words, or nothing for a rule that is none."""
    words = {Gt: "above", Ge: "of at least", Lt: "below", Le: "of at most"}
    return f"{words[type(rule)]} {getattr(rule, type(rule).__name__.lower())}" if type(rule) in words else ""
