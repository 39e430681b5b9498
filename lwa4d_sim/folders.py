"""A folder of results, claimed before any work is done and put in place whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from lwa4d_sim.errors import RecordError, ScenarioError


def claim(
    folder: Path, ours: Collection[str], inputs: Collection[Path] = (), names: Collection[str] | None = None
) -> Path:
    """The folder, after making sure that it may be written.

    Args:
        folder: where the results are to go.
        ours: endings of the files that an earlier result may have left there, and that the next one replaces.
        inputs: files that the result is made of, which must not lie there.
        names: of those files, but for pictures; default any with such an ending.

    Raises:
        ScenarioError: it cannot be written, or it holds something that is not such a result.
    """
    out = folder.parent
    try:
        # the nearest folder that is there already, so that bad input leaves not even an empty folder behind
        with tempfile.TemporaryFile(dir=next(place for place in (out, *out.absolute().parents) if place.exists())):
            pass
        entries = list(folder.iterdir()) if folder.exists() else []
        foreign = next((entry for entry in entries if not _is_ours(entry, ours, names)), None)
    except OSError as error:
        raise ScenarioError(
            f"{out}: cannot write results here: {error.strerror}; choose another folder with -o"
        ) from error
    for path in inputs:
        if folder.resolve() in path.resolve().parents:
            raise ScenarioError(f"{path}: lies in {folder}, which the result replaces; choose another folder with -o")
    if foreign is not None:
        raise ScenarioError(f"{folder}: holds '{foreign.name}', which no run wrote; choose another folder with -o")
    return folder


def _is_ours(entry: Path, ours: Collection[str], names: Collection[str] | None) -> bool:
    named = names is None or entry.name in names or entry.suffix == ".png"
    return entry.suffix in ours and named and not entry.is_dir()


@contextmanager
def written_whole(folder: Path) -> Iterator[Path]:
    """A temporary folder beside ``folder`` to write into, put in its place when the block ends well.

    Raises:
        RecordError: something cannot be written.
    """
    partial = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".part", dir=folder.parent))
        partial.chmod(0o755)
        yield partial
        if folder.exists():
            retired = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".old", dir=folder.parent))
            os.replace(folder, retired / folder.name)
            os.replace(partial, folder)
            shutil.rmtree(retired, ignore_errors=True)
        else:
            os.replace(partial, folder)
    except OSError as error:
        raise RecordError(f"{folder}: cannot write the results ({error})") from error
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
