"""Sweeps: Hydra's settings for them, and the names of the folders of their runs."""

import hashlib
import logging
import re

from omegaconf import DictConfig, OmegaConf

from pickplace.config.composition import parse, quoted, task_overrides

LONGEST_NAME = 150  # letters of the name of a run folder; file systems allow 255 bytes


def sweep_words(merged: DictConfig, words: list[str]) -> list[str]:
    """Return settings of Hydra's for a sweep, as overrides; those of the user come later, and win.

    Args:
        merged: Hydra's merge of the command line, ``hydra`` included.
        words: the command line.
    """
    keys = ",".join(map(quoted, constant_keys(words)))
    settings = [f"hydra.job.config.override_dirname.exclude_keys=[{keys}]"]
    if "direction" in merged.hydra.sweeper:  # Optuna's; tasks return an occupancy
        logging.getLogger("alembic").setLevel(logging.WARNING)  # its database tool logs every migration
        settings.append("hydra.sweeper.direction=maximize")
    return settings


def constant_keys(words: list[str]) -> list[str]:
    """Return the keys that have the same value in all runs of a sweep's command line, but for the seed."""
    given = [override for override in parse(words) if not override.is_hydra_override()]
    constant = [override.get_key_element().lstrip("+~") for override in given if not override.is_sweep_override()]
    return [key for key in constant if key != "seed"]


def folder_name(overrides: list[str], constant: list[str]) -> str:
    """Return the name of the folder of a sweep's run: the overrides in which the runs differ, the seed last.

    The name needs no quotes in an override, which takes ``+`` and ``-``, but neither ``=`` nor ``,``. One that leaves
    out letters, or would be too long, ends in a hash of the overrides.

    Args:
        overrides: of the run.
        constant: keys that the sweep's runs have in common.
    """
    pairs = [word.lstrip("+~").partition("=")[::2] for word in overrides]
    pairs = [pair for pair in pairs if pair[0] not in constant] or pairs
    pairs.sort(key=lambda pair: pair[0] == "seed")
    plain = "+".join(f"{key.replace('/', '.')}-{value}" for key, value in pairs) or "run"
    name = re.sub(r"[^\w.+-]+", "-", plain, flags=re.ASCII)
    if name == plain and len(name) <= LONGEST_NAME:
        return name
    name = re.sub(r"[-.]*([-+.])[-.]*", r"\1", name)[:LONGEST_NAME]
    return f"{name}-{hashlib.sha256(plain.encode()).hexdigest()[:8]}".lstrip("-.")


def _run_name(_root_: DictConfig) -> str:
    """Return the name of the folder of a sweep's run; its number where a sampler may draw the same values twice."""
    cfg = _root_.hydra
    if not cfg.sweeper._target_.endswith(".BasicSweeper"):
        return str(cfg.job.num)
    return folder_name(task_overrides(cfg), list(cfg.job.config.override_dirname.exclude_keys))


OmegaConf.register_new_resolver("run_name", _run_name, replace=True)
