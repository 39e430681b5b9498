"""Fits plain data to the parameter classes and says, for what does not fit, which key is wrong and what would be right."""

import dataclasses
import difflib
import json
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any

from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from lwa4d_sim.controllers import CustomController
from lwa4d_sim.settings import CHOICES, Settings
from lwa4d_sim.yaml_text import Path


class Misfit(Exception):
    """A key that does not fit the schema.

    Args:
        path: of the key in the document.
        rule: what is wrong and what would be valid.
    """

    def __init__(self, path: Path, rule: str) -> None:
        super().__init__(rule)
        self.path, self.rule = path, rule


def fit(document: Any) -> Settings:
    """The typed settings in ``document``.

    Raises:
        Misfit: with the first thing wrong, from the top down.
    """
    chosen: dict[Path, str] = {}
    resolved = _resolve(Settings, document, (), chosen)
    try:
        return _adapter().validate_json(json.dumps(resolved), strict=True)
    except ValidationError as error:
        raise _explain(error.errors(include_url=False, include_context=False), resolved, chosen) from None


def json_schema() -> dict[str, Any]:
    """JSON schema of a scenario's settings, for editors."""
    return _adapter().json_schema()


@cache
def _adapter() -> TypeAdapter[Settings]:
    return TypeAdapter(Settings)


@cache
def _fields(cls: Any) -> dict[str, Any]:
    """Field names and resolved types of a parameter class."""
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _resolve(annotation: Any, node: Any, path: Path, chosen: dict[Path, str]) -> Any:
    """``node`` with left-out kinds filled in; notes which class each mapping belongs to."""
    alternatives = _alternatives(annotation)
    if isinstance(node, Mapping):
        classes = [a for a in alternatives if dataclasses.is_dataclass(a)]
        return _resolve_mapping(classes, dict(node), path, chosen) if classes else node
    if isinstance(node, list):
        for item in (typing.get_args(a)[0] for a in alternatives if typing.get_origin(a) is tuple):
            return [_resolve(item, value, (*path, i), chosen) for i, value in enumerate(node)]
    elif all(dataclasses.is_dataclass(a) for a in alternatives):
        raise Misfit(path, "must be a mapping of keys to values")
    return node


def _alternatives(annotation: Any) -> list[Any]:
    """The members of a union, unions inside unions and Annotated wrappers opened."""
    if typing.get_origin(annotation) is typing.Annotated:
        return _alternatives(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [inner for member in typing.get_args(annotation) for inner in _alternatives(member)]
    return [annotation]


def _resolve_mapping(classes: list[Any], node: dict[str, Any], path: Path, chosen: dict[Path, str]) -> Any:
    cls = _choose(classes, node, path)
    fields = _fields(cls)
    if cls is CustomController:
        extra = {key: node.pop(key) for key in list(node) if key not in fields or key == "options"}
        node["options"] = extra
    for key in node:
        if key not in fields:
            close = difflib.get_close_matches(key, fields, n=1)
            hint = f"did you mean '{close[0]}'? " if close else ""
            raise Misfit((*path, key), f"unknown key; {hint}valid here: {', '.join(fields)}")
    for field in dataclasses.fields(cls):
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and field.name not in node:
            raise Misfit((*path, field.name), "is missing")
    chosen[path] = cls.__name__
    return {key: _resolve(fields[key], value, (*path, key), chosen) for key, value in node.items()}


def _choose(classes: list[Any], node: dict[str, Any], path: Path) -> Any:
    """The class a mapping means: by its kind, else by its keys."""
    kinds = {kind: cls for cls in classes if "kind" in _fields(cls) for kind in typing.get_args(_fields(cls)["kind"])}
    if "kind" not in node and len(path) == 1 and path[0] in CHOICES:
        node["kind"] = CHOICES[str(path[0])]
    if kinds and ("kind" in node or len(kinds) == len(classes)):
        kind = node.get("kind")
        if len(kinds) == 1 and len(classes) == 1 and kind is None:
            return classes[0]
        if isinstance(kind, str) and kind in kinds:
            return kinds[kind]
        choices = list(kinds)
        if CustomController in classes:
            if isinstance(kind, str) and ":" in kind:
                return CustomController
            choices.append("package.module:Class")
        raise Misfit((*path, "kind"), f"must be one of {', '.join(choices)}" if "kind" in node else _missing(choices))
    plain = [cls for cls in classes if "kind" not in _fields(cls)]
    if not plain:
        raise Misfit((*path, "kind"), _missing(list(kinds)))
    return max(plain, key=lambda cls: len(_fields(cls).keys() & node.keys()))


def _missing(choices: list[str]) -> str:
    return f"is missing; one of {', '.join(choices)}"


def _explain(errors: list[ErrorDetails], document: Any, chosen: dict[Path, str]) -> Misfit:
    """The first error that belongs to the classes the document chose, with all rules for its key."""
    rules: dict[Path, list[str]] = {}
    for error in errors:
        path = _document_path(error["loc"], document, chosen)
        if path is not None:
            rule = error["msg"].removeprefix("Input ").removeprefix("Value error, ")
            rules.setdefault(path, []).append(rule)
    if not rules:  # every branch was another class's: name the shallowest
        first = errors[0]
        return Misfit(tuple(p for p in first["loc"][:1]), first["msg"])
    path, found = next(iter(rules.items()))
    return Misfit(path, " or ".join(dict.fromkeys(found)))


def _document_path(location: tuple[int | str, ...], document: Any, chosen: dict[Path, str]) -> Path | None:
    """The document's path in pydantic's location, or None when it runs through a class the document did not choose."""
    path: Path = ()
    node = document
    for part in location:
        inside = isinstance(node, Mapping) and part in node
        inside = inside or (isinstance(node, list) and isinstance(part, int) and part < len(node))
        if inside:
            node = node[part]
            path = (*path, part)
        elif path in chosen and part != chosen[path]:
            return None
    return path
