import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_logs import made_log
from PIL import Image

from lwa4d_sim import video
from lwa4d_sim.errors import RecordError
from lwa4d_sim.mjcf import load_model
from lwa4d_sim.video import animate


@pytest.fixture(scope="module")
def model() -> Any:
    return load_model("lwa4d_3dof")


def _animate(path: Path, model: Any, variants: tuple[str, ...], **options: Any) -> None:
    try:
        animate({name: made_log(name, steps=401) for name in variants}, path, model, size=(160, 120), **options)
    except RecordError as error:
        if "no OpenGL" in str(error):
            pytest.skip(str(error))
        raise


@pytest.mark.parametrize("variants", [("can",), ("ideal", "can"), ("ideal", "can", "late")])
def test_a_gif_shows_up_to_two_runs_in_true_time(tmp_path: Path, model: Any, variants: tuple[str, ...]) -> None:
    path = tmp_path / "arm.gif"
    _animate(path, model, variants, fps=10)
    with Image.open(path) as image:
        assert image.size == (160 * min(2, len(variants)), 120)
        assert getattr(image, "n_frames", 1) == 5  # 0 to 0.4 s
        assert image.info["duration"] == 100
        first = np.asarray(image.convert("RGB"), float)
        image.seek(4)
        last = np.asarray(image.convert("RGB"), float)
    assert (np.abs(first - last).max(axis=2) > 30).mean() > 0.01  # the arm moved
    assert [p.name for p in tmp_path.iterdir()] == ["arm.gif"]


def test_slow_motion_has_more_frames(tmp_path: Path, model: Any) -> None:
    _animate(tmp_path / "arm.gif", model, ("can",), fps=10, speed=0.5)
    with Image.open(tmp_path / "arm.gif") as image:
        assert getattr(image, "n_frames", 1) == 9


def test_mp4_is_written_or_says_what_it_needs(tmp_path: Path, model: Any) -> None:
    path = tmp_path / "arm.mp4"
    if find_spec("imageio_ffmpeg") and find_spec("imageio"):
        _animate(path, model, ("can",), fps=10)
        assert path.read_bytes()[4:8] == b"ftyp"
    else:
        with pytest.raises(RecordError, match="needs the packages imageio and imageio-ffmpeg"):
            _animate(path, model, ("can",), fps=10)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("arm.avi", {}, r"must be \.gif or \.mp4"),
        ("arm.gif", {"fps": 0}, r"fps \(=0\) must be in"),
        ("arm.gif", {"fps": 60}, r"fps \(=60\)"),
        ("arm.gif", {"speed": 0}, r"speed \(=0\) positive"),
        ("absent/arm.gif", {}, "cannot write the animation"),
    ],
)
def test_what_cannot_be_animated(tmp_path: Path, model: Any, name: str, options: Any, message: str) -> None:
    with pytest.raises(RecordError, match=message):
        _animate(tmp_path / name, model, ("can",), **options)
    assert list(tmp_path.iterdir()) == []


def test_another_arm_than_the_records(tmp_path: Path, model: Any) -> None:
    with pytest.raises(RecordError, match="run 'can' has 7 joints, the model to show it with has 3"):
        animate({"can": made_log(n=7)}, tmp_path / "arm.gif", model)


def test_without_opengl_one_line_says_what_to_install(
    tmp_path: Path, model: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for key in ("DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(key, raising=False)
    monkeypatch.setattr(video, "find_library", lambda name: None)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(RecordError, match="libegl1 or libosmesa6") as caught:
        animate({"can": made_log(steps=50)}, tmp_path / "arm.gif", model)
    assert "\n" not in str(caught.value)
    assert "MUJOCO_GL" not in os.environ
    assert list(tmp_path.iterdir()) == []
