"""The wheel holds the config files and works from any directory, without the checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    # Built from a copy, so that the checkout stays as it is.
    for name in ("pickplace", "conf"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(source)]
    subprocess.run(command, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


def test_wheel_holds_every_config_file(wheel):
    inside = set(zipfile.ZipFile(wheel).namelist())
    expected = {f"pickplace/conf/{path.relative_to(ROOT / 'conf')}" for path in (ROOT / "conf").rglob("*.yaml")}
    assert expected and expected <= inside
    assert {"pickplace/py.typed", "pickplace/models/conv4d.py", "pickplace/planners/policy.py"} <= inside
    assert {"pickplace/assets/replay.html", "pickplace/assets/three.min.js"} <= inside
    assert {f"pickplace/pretrained/r4/{name}" for name in ("card.json", "state.json", "state.safetensors")} <= inside


def test_wheel_trains_from_another_directory(wheel, tmp_path):
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    code = (
        f"import sys; sys.path.insert(0, {str(site)!r}); import pickplace.runs.hydra_app as c; "
        f"assert str(c.conf_dir()).startswith({str(site)!r}), c.conf_dir(); import pickplace.training.train as t; "
        "sys.argv = ['pickplace-train', 'experiment=smoke', 'hydra.run.dir=run']; t.main()"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "run" / "checkpoints" / "last" / "state.json").is_file()
