"""The wheel holds the package and its config files, and its commands work from any directory, without the checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from configparser import ConfigParser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    # Built from a copy, so that the checkout is not changed.
    for name in ("pickplace", "conf"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(source)]
    subprocess.run(command, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


def test_wheel_holds_every_file(wheel):
    inside = set(zipfile.ZipFile(wheel).namelist())
    configs = {f"pickplace/conf/{path.relative_to(ROOT / 'conf')}" for path in (ROOT / "conf").rglob("*.yaml")}
    package = {str(path.relative_to(ROOT)) for path in (ROOT / "pickplace").rglob("*") if path.is_file()}
    package = {name for name in package if not name.endswith((".pyc", ".md", "three-entry.js"))}
    assert configs and package and configs | package <= inside


def test_commands_of_the_wheel_from_another_directory(wheel, tmp_path):
    """The commands import torch and matplotlib only when they need them, and play shipped weights."""
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    (listed,) = site.glob("*.dist-info/entry_points.txt")
    scripts = ConfigParser()
    scripts.read(listed)
    assert dict(scripts["console_scripts"]) == {
        f"pickplace-{name}": f"pickplace.cli:{name}"
        for name in ("train", "evaluate", "plan", "physics", "serve", "export", "pack")
    }
    words = ["checkpoint=pretrained/r1", "evaluation.episodes=2", "evaluation.latency_decisions=0", "hydra.run.dir=run"]
    code = (
        f"import sys; sys.path.insert(0, {str(site)!r}); import pickplace.cli as cli; "
        f"assert cli.__file__.startswith({str(site)!r}), cli.__file__; assert 'torch' not in sys.modules; "
        "assert cli.train and cli.plan; import pickplace.evaluation.evaluate, pickplace.views.scene; "
        f"assert 'matplotlib' not in sys.modules; sys.argv = ['', *{words}]; cli.evaluate()"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "run" / "replay.html").is_file()
