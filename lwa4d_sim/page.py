"""A self-contained HTML page from a template, in the one style that all pages share."""

import base64
import math
import os
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from lwa4d_sim.errors import RecordError

NONE = "\u2013"  # an en dash stands for a number that does not exist


def write_page(
    path: Path, template: str, *, filters: Mapping[str, Callable[..., Any]] | None = None, **values: Any
) -> None:
    """Write a page, whole or not at all.

    Args:
        path: of the page.
        template: file in this package; it fills the blocks of `page.html.j2`, whose filters are `number` and `embed`.
        filters: more filters, by name.
        values: what the template shows.

    Raises:
        RecordError: a picture cannot be read or the page cannot be written.
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    def source(name: str) -> str:
        return files("lwa4d_sim").joinpath(name).read_text(encoding="utf-8")

    environment = Environment(
        loader=FunctionLoader(source),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=number, embed=embed, **(filters or {}))
    partial = path.with_name(path.name + ".part")
    try:
        text = environment.get_template(template).render(**values)
        partial.write_text(text, encoding="utf-8", errors="backslashreplace")
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise RecordError(f"{path}: cannot write the report ({error})") from error


def embed(figure: Any) -> str:
    """A picture as a data URI."""
    return "data:image/png;base64," + base64.b64encode(figure.path.read_bytes()).decode()


def number(value: Any) -> str:
    """A metric as a table shows it: three digits, lists with commas, a dash for what does not exist."""
    if value is None:
        return NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(number, value))
    if isinstance(value, (int, float)):
        if value == 0 or not math.isfinite(value):
            return f"{value:g}"
        # plain digits where they are few, powers of ten elsewhere
        return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    return str(value)
