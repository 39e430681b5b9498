"""What ships: the built wheel carries models, scenarios and sweeps and runs from an empty folder."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_the_wheel_runs_from_an_empty_folder(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(tmp_path), str(ROOT)], check=True)
    wheel = next(tmp_path.glob("lwa4d_sim-*.whl"))
    site, empty = tmp_path / "site", tmp_path / "empty"
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True)
    empty.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(site)}

    def call(*arguments: str) -> str:
        command = [sys.executable, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, cwd=empty, env=environment).stdout

    assert call("-c", "import lwa4d_sim; print(lwa4d_sim.__file__)").startswith(str(site))
    shipped = json.loads(call("-m", "lwa4d_sim", "scenarios", "--json"))["scenarios"]
    assert set(shipped) == {file.stem for file in (ROOT / "scenarios").glob("*.yaml")}
    assert all(file.startswith(str(site)) for file in shipped.values())
    assert {file.stem for file in (site / "lwa4d_sim" / "sweeps").iterdir()} == {
        file.stem for file in (ROOT / "sweeps").iterdir()
    }
    result = json.loads(call("-m", "lwa4d_sim", "run", "ct_joint_T1.5", "--json"))
    assert result["variants"]["can"]["expect"]["passed"]
    assert (empty / result["folder"] / "report.html").is_file()
    assert json.loads((empty / result["folder"] / "summary.json").read_text())["hashes"]["models"]
