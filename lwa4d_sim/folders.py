"""A folder of results, claimed before any work is done and put in place whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from lwa4d_sim.errors import RecordError, ScenarioError


def claim(folder: Path, ours: Collection[str]) -> Path:
    """The folder, after making sure that it may be written.

    Args:
        folder: where the results are to go.
        ours: endings of the files that an earlier result may have left there, and that the next one replaces.

    Raises:
        ScenarioError: it cannot be written, or it holds something that is not such a result.
    """
    out = folder.parent
    try:
        # the nearest folder that is there already, so that bad input leaves not even an empty folder behind
        with tempfile.TemporaryFile(dir=next(place for place in (out, *out.absolute().parents) if place.exists())):
            pass
        foreign = (
            next((entry for entry in folder.iterdir() if entry.suffix not in ours), None) if folder.exists() else None
        )
    except OSError as error:
        raise ScenarioError(
            f"{out}: cannot write results here: {error.strerror}; choose another folder with -o"
        ) from error
    if foreign is not None:
        raise ScenarioError(f"{folder}: holds '{foreign.name}', which no run wrote; choose another folder with -o")
    return folder


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
