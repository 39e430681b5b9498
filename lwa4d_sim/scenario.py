"""A scenario file: its text, its variants, and where in it every key stands."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lwa4d_sim.errors import LwaError, ScenarioError
from lwa4d_sim.expect import check_expectations
from lwa4d_sim.schema import Misfit, fit
from lwa4d_sim.settings import Settings
from lwa4d_sim.yaml_text import Path as KeyPath
from lwa4d_sim.yaml_text import dotted, merge, parse, put

DEFAULT_VARIANT = "default"  # the one variant of a scenario that names none
_TOP_KEYS = ("name", "arm", "initial", "plant", "trajectory", "controller", "loop", "variants", "expect")


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
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not a text file (UTF-8)"
            raise ScenarioError(f"{path}: cannot read the scenario: {reason}") from error
        return Scenario.parse(text, source=str(path), folder=path.parent, overrides=overrides)

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
        if not isinstance(document, Mapping):
            raise ScenarioError(f"{source}: a scenario is a mapping with the keys {', '.join(_TOP_KEYS)}")
        for key, value in (overrides or {}).items():
            document = put(document, key, value)
        made = Scenario(
            name=str(document.get("name", "")),
            source=source,
            folder=folder or Path(),
            text=text,
            variants={},
            expect={},
            document=document,
            _lines=lines,
            overrides=dict(overrides or {}),
        )
        made._check_top()
        variants = {name: made._settings(name) for name in made._variant_names()}
        expect = made._expectations(variants)
        return Scenario(**{**made.__dict__, "variants": variants, "expect": expect})

    def error(self, path: KeyPath, rule: str, variant: str | None = None) -> ScenarioError:
        """An error at a key: file, line, key, value, rule."""
        key = dotted(path)
        value = self._value(path, variant)
        shown = "" if value is None or isinstance(value, Mapping) else f" (={_short(value)})"
        where = self._where(path, variant)
        note = f" in variant '{variant}'" if variant not in (None, DEFAULT_VARIANT) else ""
        return ScenarioError(f"{where}: {key}{shown}{note}: {rule}" if key else f"{where}: {rule}")

    def locate(self, error: LwaError, key: str, variant: str | None) -> LwaError:
        """``error`` with the place in this file that it is about, its class kept."""
        at = getattr(error, "key", None) or key
        where = self._where(tuple(at.split(".")), variant)
        return type(error)(f"{where}: {at}: {error}")

    def _variant_names(self) -> list[str]:
        variants = self.document.get("variants")
        return list(variants) if variants else [DEFAULT_VARIANT]

    def _check_top(self) -> None:
        for key in self.document:
            if key not in _TOP_KEYS:
                close = difflib.get_close_matches(key, _TOP_KEYS, n=1)
                hint = f"did you mean '{close[0]}'? " if close else ""
                raise self.error((key,), f"unknown key; {hint}valid here: {', '.join(_TOP_KEYS)}")
        name = self.document.get("name")
        if not isinstance(name, str) or not name.strip() or any(c in name for c in '/\\\0:*?"<>|') or name[0] == ".":
            raise self.error(("name",), "must be text that can name a folder")
        for key in ("variants", "expect"):
            value = self.document.get(key)
            if value is not None and not isinstance(value, Mapping):
                raise self.error((key,), "must be a mapping of variant names")
        for variant, changes in (self.document.get("variants") or {}).items():
            if any(c in variant for c in '/\\\0:*?"<>|') or not variant or variant[0] == ".":
                raise self.error(("variants", variant), "a variant's name must be able to name a file")
            if changes is not None and not isinstance(changes, Mapping):
                raise self.error(("variants", variant), "must be a mapping of overrides, or {}")
            for key in changes or {}:
                if key in ("name", "variants", "expect") or key not in _TOP_KEYS:
                    allowed = ", ".join(k for k in _TOP_KEYS if k not in ("name", "variants", "expect"))
                    raise self.error(("variants", variant, key), f"a variant can override {allowed}")

    def _settings(self, variant: str) -> Settings:
        try:
            return fit(self.resolved(variant))
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

    def _value(self, path: KeyPath, variant: str | None) -> Any:
        value: Any = self.document if variant is None else self.resolved(variant)
        for part in path:
            try:
                value = value[part]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def _where(self, path: KeyPath, variant: str | None) -> str:
        """File and line of a key, or of the nearest key above it; overrides have no line."""
        key = dotted(path)
        if any(key == o or key.startswith(o + ".") for o in self.overrides):
            return f"{self.source} with {key} overridden"
        full = [("variants", variant, *path[:cut]) for cut in range(len(path), 0, -1)] if variant else []
        plain = [path[:cut] for cut in range(len(path), 0, -1)]
        # the longest match wins; a variant's own line before the base's of the same length
        for candidate in sorted([*full, *plain], key=lambda p: -(len(p) - 2 * (p[:1] == ("variants",)))):
            if candidate in self._lines:
                return f"{self.source}:{self._lines[candidate]}"
        return self.source


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
