"""Settings of all tests, and fixtures that several files use."""

import logging
import sys

import pytest
from hydra import compose, initialize_config_dir
from hypothesis import HealthCheck, settings

from pickplace.evaluation import evaluate
from pickplace.runs.hydra_app import conf_dir
from pickplace.training import train

# A busy machine is no fault of the code.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

MAINS = {"train": train.main, "evaluate": evaluate.main}


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Run a command in this process, in an empty folder; returns exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def call(command, *arguments):
        monkeypatch.setattr(sys, "argv", [f"pickplace-{command}", *arguments])
        code = 0
        try:
            MAINS[command]()
        except SystemExit as exit:
            code = exit.code or 0
        finally:
            logging.root.handlers.clear()  # the files of this run may be gone when the next one logs
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture(scope="session")
def smoke():
    """Trains experiment=smoke in this process."""

    def run(run_dir, *overrides):
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            cfg = compose("train", ["experiment=smoke", "threads=1", *overrides])
        run_dir.mkdir(exist_ok=True)
        return train.train(cfg, run_dir)

    return run
