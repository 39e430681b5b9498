"""A scenario that a command has made, as a file: its place, its paths, and written whole or not at all."""

import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from lwa4d_sim.arm import ARMS
from lwa4d_sim.errors import RecordError
from lwa4d_sim.yaml_text import dump


def place_for(path: Path, made: str) -> Path:
    """The same path, after making sure that it may be written.

    Args:
        path: where the scenario is to go.
        made: what a file says that the same command wrote earlier and that may be replaced.

    Raises:
        RecordError: a folder cannot be there, or there is a file that says nothing like it.
    """
    try:
        ours = not path.exists() or made in path.read_text(encoding="utf-8", errors="replace")
        # the nearest folder that is there already, so that bad input leaves not even an empty folder behind
        with tempfile.TemporaryFile(dir=next(place for place in path.absolute().parents if place.exists())):
            pass
    except OSError as error:
        raise RecordError(f"{path}: cannot write the scenario ({error.strerror})") from error
    if not ours:
        raise RecordError(f"{path}: is there already and was not made by this command; choose another folder with -o")
    return path


def make_absolute(block: dict[str, Any], folder: Path) -> None:
    """Paths that began at the old file's folder begin at the root, for the new file stands elsewhere."""
    asked = block.get("identify") or {}
    models = [(law or {}).get("model") for law in (block.get("controller"), asked.get("control"))]
    for holder in (block, *models, asked.get("nominal")):
        if isinstance(holder, dict) and isinstance(holder.get("arm"), str) and holder["arm"] not in ARMS:
            holder["arm"] = str((folder / holder["arm"]).resolve())
    for motion in (block.get("trajectory"), asked.get("validation")):
        if isinstance(motion, dict) and isinstance(motion.get("file"), str):
            motion["file"] = str((folder / motion["file"]).resolve())


def write_scenario(path: Path, remarks: Sequence[str], document: Mapping[str, Any]) -> None:
    """Write the scenario under ``remarks``, each a line, whole or not at all.

    Raises:
        RecordError: it cannot be written.
    """
    partial = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = "".join(f"# {' '.join(line.split())}\n" for line in remarks)
        partial.write_text(text + dump(dict(document)), encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise RecordError(f"{path}: cannot write the scenario ({error.strerror})") from error
