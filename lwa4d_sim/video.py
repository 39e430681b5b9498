"""The arm in motion as an animated picture: one run, or two side by side."""

import os
import sys
from collections.abc import Generator, Iterator, Mapping
from contextlib import closing, contextmanager
from copy import copy
from ctypes.util import find_library
from importlib import import_module, reload
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.errors import RecordError
from lwa4d_sim.record import RunLog

TRAIL = 1.5  # [s] of the tool's path drawn behind it
TRAIL_PARTS = 60  # pieces of the trail
CAMERA = "overview"  # of the shipped models; any other model is seen from MuJoCo's default view
# Okabe and Ito's green and vermilion
_GOAL, _TOOL = np.array([0.0, 0.62, 0.45, 1.0], np.float32), np.array([0.84, 0.37, 0.0, 1.0], np.float32)
_HINT = "install the Debian package libegl1 or libosmesa6, or set MUJOCO_GL to egl, osmesa or glfw"

Image = NDArray[np.uint8]


def animate(
    logs: Mapping[str, RunLog],
    path: Path,
    model: Any,
    *,
    fps: float = 25.0,
    speed: float = 1.0,
    size: tuple[int, int] = (640, 480),
) -> None:
    """Render the first two of ``logs`` side by side, or the only one.

    The green ball is the reference of the tool; the line behind the tool is its path of the last `TRAIL` seconds.

    Args:
        logs: record of each variant.
        path: file to write: ``.gif``, or ``.mp4`` where imageio-ffmpeg is installed.
        model: the arm, a `mujoco.MjModel`.
        fps: pictures a second.
        speed: seconds of the run shown in one second; 0.1 for slow motion.
        size: width and height of each arm's picture [pixels].

    Raises:
        RecordError: no OpenGL, no encoder for the suffix, another arm than the record's, or the file cannot be written.
    """
    if not (0 < fps <= 50 and speed > 0):  # a GIF counts hundredths of a second and viewers slow down below two
        raise RecordError(f"fps (={fps}) must be in (0, 50] and speed (={speed}) positive")
    if path.suffix not in (".gif", ".mp4"):
        raise RecordError(f"{path}: the suffix must be .gif or .mp4")
    shown = dict(islice(logs.items(), 2))
    for name, log in shown.items():
        if log.q.shape[1] != model.nq:
            raise RecordError(f"run '{name}' has {log.q.shape[1]} joints, the model to show it with has {model.nq}")
    end = max(float(log.t[-1]) for log in shown.values())
    times = np.arange(0.0, end + 1e-9, speed / fps)
    partial = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        with closing(_frames(shown, model, times, size)) as frames:
            (_write_gif if path.suffix == ".gif" else _write_mp4)(partial, frames, fps)
        os.replace(partial, path)
    except OSError as error:
        if isinstance(error, RecordError):
            raise
        raise RecordError(f"{path}: cannot write the animation ({error})") from error
    finally:
        partial.unlink(missing_ok=True)


def _frames(logs: Mapping[str, RunLog], model: Any, times: Any, size: tuple[int, int]) -> Generator[Image, None, None]:
    """One picture for each of ``times`` [s], the runs beside each other."""
    import mujoco

    data = mujoco.MjData(model)
    camera = CAMERA if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, CAMERA) >= 0 else -1
    paths = {name: (log.x, log.x_ref) for name, log in logs.items()}
    with _renderer(model, size) as renderer:
        for flag in (mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SHADOW):
            renderer.scene.flags[flag] = False
        for t in times:
            views = []
            for name, log in logs.items():
                k = min(log.step_at(t), len(log.q) - 1)
                data.qpos[:] = log.q[k]
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                renderer.update_scene(data, camera)
                x, x_ref = paths[name]
                _add_goal(renderer.scene, x_ref[k])
                _add_trail(renderer.scene, x[max(0, log.step_at(t - TRAIL)) : k + 1])
                ended = log.diverged_at is not None and t >= log.t[-1]
                views.append(_titled(renderer.render(), f"{name}   {t:.2f} s" + ("   diverged" if ended else "")))
            yield np.concatenate(views, axis=1)


@contextmanager
def _renderer(model: Any, size: tuple[int, int]) -> Iterator[Any]:
    """MuJoCo's offscreen renderer.

    MuJoCo decides how to reach OpenGL when it is first imported. Where there is no display and the user has not chosen,
    the choice is made here, and made again if MuJoCo has been imported already.
    """
    import mujoco
    from mujoco.rendering.classic import gl_context

    if sys.platform == "linux" and not os.environ.get("DISPLAY") and not os.environ.get("MUJOCO_GL"):
        backend = next((name for name, library in _BACKENDS.items() if find_library(library)), None)
        if backend is None:
            raise RecordError(f"no OpenGL for rendering without a display: {_HINT}")
        os.environ["MUJOCO_GL"] = backend
        reload(gl_context)
    width, height = size
    model = copy(model)
    model.vis.quality.offsamples = 0  # with shadows and smooth edges a frame takes four times as long without a GPU
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except (ImportError, AttributeError, RuntimeError, OSError, mujoco.FatalError) as error:
        raise RecordError(f"no OpenGL for rendering ({' '.join(str(error).split())}): {_HINT}") from error
    with closing(renderer):
        yield renderer


_BACKENDS = {"egl": "EGL", "osmesa": "OSMesa"}


def _add_goal(scene: Any, x: Any) -> None:
    import mujoco

    kind = mujoco.mjtGeom.mjGEOM_SPHERE
    mujoco.mjv_initGeom(_next_geom(scene), kind, np.full(3, 0.018), x, np.eye(3).ravel(), _GOAL)


def _add_trail(scene: Any, x: Any) -> None:
    import mujoco

    points = x[:: max(1, len(x) // TRAIL_PARTS)]
    for start, end in pairwise(points):
        geom, kind = _next_geom(scene), mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), _TOOL)
        mujoco.mjv_connector(geom, kind, 0.004, start, end)


def _next_geom(scene: Any) -> Any:
    scene.ngeom += 1
    return scene.geoms[scene.ngeom - 1]


def _titled(pixels: Image, text: str) -> Image:
    from PIL import Image as Picture
    from PIL import ImageDraw, ImageFont

    picture = Picture.fromarray(pixels)
    font = ImageFont.load_default(max(12, picture.height // 24))
    ImageDraw.Draw(picture).text((10, 8), text, font=font, fill="black", stroke_width=2, stroke_fill="white")
    return np.asarray(picture)


def _write_gif(path: Path, frames: Iterator[Image], fps: float) -> None:
    from PIL import Image as Picture

    # one palette for all keeps colours steady and the file small; goal and trail need a share in it from the start
    start = next(frames)
    shades = np.linspace(0.3, 1.2, 16)[:, None] * np.stack([_GOAL, _TOOL])[:, None, :3]
    swatch = np.resize(np.clip(255 * shades, 0, 255).astype(np.uint8).reshape(-1, 3), (len(start), 64, 3))
    palette = Picture.fromarray(np.concatenate([start, swatch], axis=1)).quantize(256)
    first = Picture.fromarray(start).quantize(palette=palette, dither=Picture.Dither.NONE)
    rest = (Picture.fromarray(frame).quantize(palette=palette, dither=Picture.Dither.NONE) for frame in frames)
    first.save(path, save_all=True, append_images=rest, duration=10 * max(2, round(100 / fps)), loop=0)


def _write_mp4(path: Path, frames: Iterator[Image], fps: float) -> None:
    try:
        import_module("imageio_ffmpeg")  # imageio's own message does not name it
        from imageio.v2 import get_writer
    except ImportError as error:
        raise RecordError(f"{path}: MP4 needs the packages imageio and imageio-ffmpeg; or choose .gif") from error
    with closing(get_writer(path, fps=fps)) as writer:
        for frame in frames:
            writer.append_data(frame)
