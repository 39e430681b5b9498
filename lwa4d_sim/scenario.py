"""A scenario file: its text, its variants, and where in it every key stands."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lwa4d_sim.documents import Path as KeyPath
from lwa4d_sim.documents import dotted, merge, one_line, plain, put, short
from lwa4d_sim.errors import LwaError, ScenarioError
from lwa4d_sim.expect import check_expectations
from lwa4d_sim.schema import Misfit, fit, unknown_key
from lwa4d_sim.settings import CHOICES, Settings
from lwa4d_sim.yaml_text import parse

DEFAULT_VARIANT = "default"  # the one variant of a scenario that names none
_VARIANT_KEYS = ("arm", "initial", "plant", "trajectory", "controller", "compensation", "loop", "identify")
_TOP_KEYS = ("name", *_VARIANT_KEYS, "variants", "expect")
_LARGEST = 10_000_000  # [bytes]; no scenario is that long, but a device file is
_NAME_BYTES = 200  # file systems take 255, and a temporary name is a little longer than the name
#: what the name of a scenario, a variant or a sweep must be
NAME_RULE = f'must be text that can name a file: printable, at most {_NAME_BYTES} bytes, without / \\ : * ? " < > |'


@dataclass(frozen=True)
class Scenario:
    """One scenario file, with overrides applied, checked.

    Attributes:
        name: of the scenario.
        source: the file, as errors name it.
        folder: that relative paths in the file start from.
        text: the file's text.
        variants: settings of each variant, in the file's order.
        expect: expectations of each variant.
        document: the whole document with overrides.
        overrides: values by dotted key, as given.
    """

    name: str
    source: str
    folder: Path
    text: str
    variants: Mapping[str, Settings]
    expect: Mapping[str, Mapping[str, Any]]
    document: Mapping[str, Any]
    _lines: Mapping[KeyPath, int] = field(repr=False)
    overrides: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def load(path: str | Path, overrides: Mapping[str, Any] | None = None) -> "Scenario":
        """Read a scenario file.

        Args:
            path: the YAML file.
            overrides: values by dotted key, e.g. ``{"controller.kp": 2.0}``, applied to the file's own level; a key
                under ``variants.NAME.`` changes that variant alone.

        Raises:
            ScenarioError: the file cannot be read or is not a scenario; says file, line, key, value and rule.
        """
        path = Path(path)
        text = read_text(path, "scenario")
        return Scenario.parse(text, source=one_line(str(path)), folder=path.parent, overrides=overrides)

    @staticmethod
    def parse(
        text: str,
        *,
        source: str = "scenario",
        folder: Path | None = None,
        overrides: Mapping[str, Any] | None = None,
    ) -> "Scenario":
        """A scenario from its text; see `load`."""
        document, lines = parse(text, source)
        if not isinstance(document, dict):
            raise ScenarioError(f"{source}: must be a mapping with the keys {', '.join(_TOP_KEYS)}")
        document = _with_kinds(document)
        bare = Scenario(
            name=str(document.get("name", "")),
            source=source,
            folder=folder or Path(),
            text=text,
            variants={},
            expect={},
            document=document,
            _lines=lines,
        )
        made = bare._overridden(overrides or {})
        made._check_top()
        variants = {name: made._settings(name) for name in made._variant_names()}
        expect = made._expectations(variants)
        return replace(made, variants=variants, expect=expect)

    def changed(self, overrides: Mapping[str, Any], variant: str) -> "Scenario":
        """One variant of this scenario with further overrides; the file is not read again.

        Raises:
            ScenarioError: an override does not fit.
        """
        made = self._overridden(overrides)
        return replace(made, variants={variant: made._settings(variant)})

    def _overridden(self, overrides: Mapping[str, Any]) -> "Scenario":
        """The same with more overrides in its document; nothing else is looked at."""
        values = {key: plain(value, one_line(f"{self.source}: {key}")) for key, value in overrides.items()}
        document = self.document
        for key, value in values.items():
            try:
                document = put(document, key, value)
            except ScenarioError as error:
                raise ScenarioError(one_line(f"{self.source}: {error}")) from None
        document = _with_kinds(document)
        name = str(document.get("name", ""))
        return replace(self, name=name, document=document, overrides={**self.overrides, **values})

    def error(self, path: KeyPath, rule: str, variant: str | None = None) -> ScenarioError:
        """An error at a key: file, line, key, value, rule."""
        return ScenarioError(f"{self._place(path, variant)}: {rule}")

    def locate(self, error: LwaError, key: str, variant: str | None) -> LwaError:
        """``error`` with the place in this file that it is about, its class kept."""
        path = tuple((getattr(error, "key", None) or key).split("."))
        return type(error)(f"{self._place(path, variant, mapping='')}: {one_line(str(error))}")

    def _variant_names(self) -> list[str]:
        variants = self.document.get("variants")
        return list(variants) if variants else [DEFAULT_VARIANT]

    def _check_top(self) -> None:
        if "axes" in self.document and "scenario" in self.document:
            raise ScenarioError(f"{self.source}: is a sweep; it belongs to lwa4d-sim sweep")
        for key in self.document:
            if key not in _TOP_KEYS:
                raise self.error((key,), unknown_key(key, _TOP_KEYS))
        if not can_name_a_file(self.document.get("name")):
            raise self.error(("name",), NAME_RULE)
        for key in ("variants", "expect"):
            value = self.document.get(key)
            if value is not None and not isinstance(value, Mapping):
                raise self.error((key,), "must be a mapping of variant names")
        for variant, changes in (self.document.get("variants") or {}).items():
            if not can_name_a_file(variant):
                raise self.error(("variants", variant), f"a variant's name {NAME_RULE}")
            if changes is not None and not isinstance(changes, Mapping):
                raise self.error(("variants", variant), "must be a mapping of overrides, or {}")
            for key in changes or {}:
                if key not in _VARIANT_KEYS:
                    raise self.error(("variants", variant, key), unknown_key(key, _VARIANT_KEYS))

    def _settings(self, variant: str) -> Settings:
        try:
            return fit(self.resolved(variant), Settings)
        except Misfit as misfit:
            raise self.error(misfit.path, misfit.rule, variant) from None

    def resolved(self, variant: str) -> dict[str, Any]:
        """The document of one variant: overrides merged in, without `variants` and `expect`."""
        base = {key: value for key, value in self.document.items() if key not in ("variants", "expect")}
        changes = (self.document.get("variants") or {}).get(variant) or {}
        merged: dict[str, Any] = merge(base, changes)
        return merged

    def _expectations(self, variants: Mapping[str, Settings]) -> dict[str, Mapping[str, Any]]:
        expect = self.document.get("expect") or {}
        for variant, rules in expect.items():
            if variant not in variants:
                raise self.error(("expect", variant), f"no such variant; this scenario has {', '.join(variants)}")
            if not isinstance(rules, Mapping):
                raise self.error(("expect", variant), "must be a mapping of expectations")
            for key, value in rules.items():
                problem = check_expectations(key, value)
                if problem:
                    raise self.error(("expect", variant, key), problem)
        return dict(expect)

    def _place(self, path: KeyPath, variant: str | None, *, mapping: str = "a mapping") -> str:
        """File, line, key and value of a setting of a variant, or (without a variant) of the document."""
        origin = self._origin(path, variant)
        line = next(
            (self._lines[origin[:cut]] for cut in range(len(origin), 0, -1) if origin[:cut] in self._lines), None
        )
        names = [dotted(origin[:cut]) for cut in range(1, len(origin) + 1)]
        overridden = any(name in self.overrides for name in names)
        where = self.source if overridden or line is None else f"{self.source}:{line}"
        notes: list[str] = []
        if origin[-len(path) :] == path:
            value = self._at(origin)
            notes = [mapping if isinstance(value, Mapping) else f"={short(value)}", "overridden" if overridden else ""]
        of = f" of variant '{variant}'" if variant not in (None, DEFAULT_VARIANT) else ""
        noted = f" ({', '.join(filter(None, notes))})" if any(notes) else ""
        return one_line(f"{where}: {dotted(path)}{of}{noted}")

    def _origin(self, path: KeyPath, variant: str | None) -> KeyPath:
        """Where in the document the setting at ``path`` stands, or as much of it as is there; a variant's own first."""
        for cut in range(len(path), 0, -1):
            for origin in ([("variants", variant, *path[:cut])] if variant else []) + [path[:cut]]:
                if self._at(origin) is not _ABSENT:
                    return origin
        return ()

    def _at(self, path: KeyPath) -> Any:
        value: Any = self.document
        for part in path:
            try:
                value = value[part]
            except (KeyError, IndexError, TypeError):
                return _ABSENT
        return value


_ABSENT = object()


def _with_kinds(document: Mapping[str, Any]) -> dict[str, Any]:
    """The document with left-out kinds filled in, so that an override of another kind is seen to be one."""
    kinds = {key: kind for key, kind in CHOICES.items() if isinstance(document.get(key), Mapping)}
    return {**document, **{key: {"kind": kind, **document[key]} for key, kind in kinds.items()}}


def read_text(path: Path, what: str) -> str:
    """Text of a YAML file.

    Raises:
        ScenarioError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(_LARGEST).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a text file (UTF-8)"
        raise ScenarioError(f"{one_line(str(path))}: cannot read the {what}: {reason}") from error


def can_name_a_file(name: Any) -> bool:
    """Whether `NAME_RULE` holds."""
    return (
        isinstance(name, str)
        and 0 < len(name.encode("utf-8", "replace")) <= _NAME_BYTES
        and name.isprintable()
        and name == name.strip()
        and name[0] != "."
        and not set(name) & set('/\\:*?"<>|')
    )
