"""Settings of all tests, and fixtures that several files use."""

import importlib
import io
import logging
import multiprocessing
import shutil
import sys

import pytest
import yaml
from commands import composed
from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig
from hypothesis import HealthCheck, settings

from pickplace.training import train
from pickplace.training.trainer import Trainer

# A test must not fail because the machine is busy.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

# Workers of a collector are forked from a process that has imported torch, see commands.FORKSERVER.
multiprocessing.set_start_method("forkserver", force=True)

# Hydra's config files are read faster in C.
yaml.SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

#: The module of each command, whose ``main`` it runs.
COMMANDS = {
    "train": "training.command", "evaluate": "evaluation.command", "plan": "serve.json_lines",
    "export": "policies.export", "pack": "evaluation.pack_command",
}  # fmt: skip


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Run a command in this process, in an empty folder; returns exit code, standard output and standard error.

    ``lines``, bytes, are its standard input.
    """
    monkeypatch.chdir(tmp_path)
    # Hydra would compose the whole config again to know its mode; the command has composed it already.
    monkeypatch.setattr(Hydra, "get_mode", lambda hydra, **given: HydraConfig.get().mode)

    def call(command, *arguments, lines=None):
        monkeypatch.setattr(sys, "argv", [f"pickplace-{command}", *map(str, arguments)])
        if lines is not None:
            monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(lines)))
        code = 0
        try:
            importlib.import_module(f"pickplace.{COMMANDS[command]}").main()
        except SystemExit as exit:
            code = exit.code or 0
        finally:
            logging.root.handlers.clear()  # the next run must not log into this run's files
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture(scope="session")
def smoke():
    """A function that trains experiment=smoke in this process."""

    def run(run_dir, *overrides):
        run_dir.mkdir(exist_ok=True)
        return train.train(composed("experiment=smoke", "threads=1", *overrides), run_dir)

    return run


@pytest.fixture(scope="session")
def smoke_run(smoke, tmp_path_factory):
    """A finished run with a whole checkpoint under each name; tests that change it copy it."""
    run_dir = tmp_path_factory.mktemp("smoke") / "run"
    smoke(run_dir, "evaluation_interval=512")
    assert sorted(path.name for path in (run_dir / "checkpoints").iterdir()) == ["best", "last", "previous"]
    return run_dir


@pytest.fixture
def no_report(monkeypatch):
    """Skip figures and report in trainings of this process; they take more than half of a small training."""
    monkeypatch.setattr(Trainer, "report", lambda trainer, stopped: None)


@pytest.fixture(scope="module")
def browser():
    """A window of a real browser that reaches only this machine."""
    webdriver = pytest.importorskip("selenium.webdriver")
    from selenium.webdriver.chrome.service import Service

    driver, chrome = shutil.which("chromedriver"), shutil.which("chromium") or shutil.which("google-chrome")
    if not driver or not chrome:
        pytest.skip("needs chromium and chromedriver, such as Debian's packages chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chrome
    for argument in (
        "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1000,700",
        "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    ):  # fmt: skip
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    window = webdriver.Chrome(options=options, service=Service(driver))
    yield window
    window.quit()
