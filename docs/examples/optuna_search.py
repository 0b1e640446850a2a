"""Search settings with Optuna, by its ask-and-tell interface: python docs/examples/optuna_search.py outputs/search 20

The second word is the number of trainings. The same command again adds as many to the study in that folder.
"""

import logging
import sys
from pathlib import Path

from omegaconf import OmegaConf

from pickplace.config.composition import compose_training
from pickplace.runs.folder import note_failure
from pickplace.training.sweep import summarize
from pickplace.training.train import train

PRESET = ["experiment=quick", "threads=1", "quiet=true"]


def suggest(trial) -> list[str]:
    """Return the overrides of a trial: this is the space that is searched."""
    return [
        f"algo.lr={trial.suggest_float('algo.lr', 1e-4, 1e-2, log=True)}",
        f"algo.epochs={trial.suggest_categorical('algo.epochs', [1, 2, 4])}",
    ]


def train_once(words: list[str], folder: Path) -> float:
    """Train as pickplace-train does with these overrides; return the final validation occupancy."""
    (folder / ".hydra").mkdir(parents=True)
    OmegaConf.save(OmegaConf.create(words), folder / ".hydra" / "overrides.yaml")  # for the table of the sweep
    return train(compose_training(words), folder)


def search(study, folder: Path, trials: int, preset: list[str] = PRESET) -> None:
    """Train for each trial that the study asks for, and write the table and the figure of a sweep."""
    for _ in range(trials):
        trial = study.ask()
        run_dir = folder / f"trial-{trial.number}"
        try:
            occupancy = train_once([*preset, *suggest(trial)], run_dir)
        except (ValueError, FloatingPointError) as error:  # such as a learning rate that is too high
            note_failure(run_dir, error)
            occupancy = float("nan")  # Optuna notes a failed trial
        study.tell(trial, occupancy)
    summarize(folder)


if __name__ == "__main__":
    import optuna

    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    storage = f"sqlite:///{folder / 'study.db'}"
    study = optuna.create_study(storage=storage, study_name="search", direction="maximize", load_if_exists=True)
    search(study, folder, int(sys.argv[2]))
    logging.info("best: %.4f with %s", study.best_value, study.best_params)
