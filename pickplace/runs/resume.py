"""Stop and resume a training: stop requests, the checkpoint to resume from, and the settings that may change."""

import json
import logging
import os
import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from loky import cpu_count
from omegaconf import DictConfig, OmegaConf

from pickplace.common.errors import WorkerDied, sentence
from pickplace.common.validate import (
    MAX_COUNT,
    excerpt,
    is_name,
    is_whole,
    number,
    refuse_if,
    reword_errors,
    whole_number,
)
from pickplace.config.allowlist import modules_to_trust, own_modules, saved_form, trusted_config
from pickplace.config.composition import apply_overrides, compose_plain, refuse_unknown_keys
from pickplace.config.words import parse
from pickplace.runs.folder import refuse_occupied, refuse_training
from pickplace.runs.locate import CheckpointError, locate, read_facts

log = logging.getLogger(__name__)

#: Types of the facts in the checkpoint of a training, beside the config and the frames.
FACT_TYPES = {
    "iteration": int, "best": int | float, "latest": dict, "curriculum": dict, "callbacks": dict, "ended": str,
    "commit": str | None, "versions": dict,
}  # fmt: skip

#: Settings that may write outside the run folder or the machine, and their values that do not. The user must repeat
#: other values on resume.
LOCAL_VALUES = {
    "collector.address": ("local", None),
    "logger.uri": ("null", None),
    "logger.offline": ("true", True, None),
}

#: Settings that a resumed run cannot change, and so all of ``env``: the state of its episodes depends on them.
FIXED_KEYS = (
    "seed", "items", "model.mask_infeasible", "collector.workers", "curriculum.levels", "curriculum.start_height",
    "curriculum.end_height", "warm_start.weights",
)  # fmt: skip

#: Settings that a user may change without asking for more training.
SILENT_KEYS = ("quiet", "threads", "progress_interval", "checkpoint_interval", "logger")


def checkpoint_config(cfg: DictConfig) -> tuple[dict, str]:
    """Return the config as checkpoints store it, and the words to repeat on resume, such as `` trust=[my_models]``.

    Warn now, not after hours, if the config can be saved but not loaded again.
    """
    content = saved_form(cfg)
    own = modules_to_trust(OmegaConf.to_container(cfg, resolve=True))
    try:
        trusted_config(content, own, groups=None)
    except ValueError as error:
        log.warning("checkpoints of this run will not be loaded again: %s", error)
    words = [f" {key}={value}" for key, value in _remote_values(cfg)]
    return content, "".join([f" trust=[{','.join(own)}]" if own else "", *words])


def _remote_values(cfg: DictConfig) -> list[tuple]:
    return [(key, value) for key, local in LOCAL_VALUES.items() if (value := OmegaConf.select(cfg, key)) not in local]


def resumed_place(overrides: list[str]) -> tuple[str, list[str]]:
    """Return the value of ``resume=`` among the words of a command line, and the other words."""
    words = [word for word in overrides if not word.startswith("resume=")]
    return next(word.partition("=")[2] for word in overrides if word not in words), words


def resumed_config(place: str, facts: dict, overrides: list[str]) -> DictConfig:
    """Return a checkpoint's config with overrides of values applied.

    Args:
        place: the run folder or checkpoint that the user resumes, for messages.
        facts: as :func:`pickplace.runs.checkpoint.read` returns them.
        overrides: the command line without ``resume=``.

    Raises:
        ValueError: for a checkpoint that no training wrote, or a change that a resumed run cannot make.
    """
    _check_facts(place, facts)
    given = parse(overrides)
    trust = own_modules(next((word.value() for word in reversed(given) if word.key_or_group == "trust"), None))
    saved = trusted_config(facts["config"], trust, groups=None)
    saved["trust"] = list(trust)  # only the user says what to trust, never the checkpoint
    with reword_errors(ValueError, lambda error: ValueError(f"resume={place}: in the checkpoint's config, {error}")):
        refuse_unknown_keys(saved, compose_plain("train"))
    repeated = {word.key_or_group for word in given}
    for key, value in _remote_values(saved):
        refuse_if(
            key not in repeated,
            f"{key}={value}: the checkpoint would write outside this run's folder or this machine; expected "
            f"{key}={value} again on the command line, or {key}={LOCAL_VALUES[key][0]}.",
        )
    if "threads" not in repeated and is_whole(saved.get("threads")) and saved.threads > cpu_count():
        log.warning("threads=%s of the checkpoint: going on with %d, all of this machine", saved.threads, cpu_count())
        saved["threads"] = cpu_count()
    words = [str(word.input_line) for word in given if word.key_or_group != "trust"]
    new_run = f"a new run, such as one with warm_start.weights={place}"
    cfg = apply_overrides(saved, words, instead=f", or {new_run}")
    for key in (*FIXED_KEYS, *(f"env.{key}" for key in saved.env)):
        before, now = OmegaConf.select(saved, key), OmegaConf.select(cfg, key)
        refuse_if(
            before != now,
            f"{key}={now}: the run began with {before}, and a resumed run cannot change it; expected {new_run}.",
        )
    whole_number("total_frames", cfg.total_frames)
    refuse_if(
        cfg.total_frames != saved.total_frames and cfg.total_frames < facts["frames"],
        f"total_frames={cfg.total_frames}: the run has trained {facts['frames']} frames already; expected more.",
    )
    return cfg


def _check_facts(place: str, facts: dict) -> None:
    saved = f"resume={place}: the checkpoint's "
    for key, kind in FACT_TYPES.items():
        found = f"is {excerpt(facts[key])}" if key in facts else "is missing"
        refuse_if(
            key not in facts or not isinstance(facts[key], kind),
            f"{saved}{key} {found}; expected what a training wrote.",
        )
    latest, frames = facts["latest"], facts["frames"]
    whole_number(f"{saved}iteration", facts["iteration"], 0, frames)
    number(f"{saved}best", facts["best"], -1, 1)
    refuse_if(
        len(latest) > 100 or not all(map(is_name, latest)),
        f"{saved}latest is {excerpt(latest)}; expected a validation that a training wrote.",
    )
    for key, value in latest.items():
        shares = key in ("occupancy", "ci95_low", "ci95_high")
        number(f"{saved}{key}", value, 0 if shares else -MAX_COUNT, 1 if shares else MAX_COUNT)
    whole_number(f"{saved}curriculum|frames", facts["curriculum"].get("frames", 0), 0, frames)


def interrupted_run(cfg: DictConfig, run_dir: Path) -> tuple[dict, dict, Path] | None:
    """Return the checkpoint of an interrupted run with exactly this config in its folder; None for a new run.

    Such a run is a job of a sweep that a scheduler stopped and starts again.

    Returns:
        The checkpoint's state, facts and folder.

    Raises:
        OccupiedError: if the folder holds a run with another config.
    """
    from pickplace.runs.checkpoint import read  # here, so that a resume is checked before torch is imported

    try:
        state, facts = read(folder := locate(run_dir, prefer="last"))
    except CheckpointError:
        refuse_occupied(run_dir)
        return None
    refuse_training(not has_config(facts, saved_form(cfg)) or "curriculum" not in facts, run_dir)
    log.info("going on with %s at %s frames", run_dir, f"{facts['frames']:,}")
    return state, facts, folder


def stale_best_frames(run_dir: Path, frames: int, config: dict) -> int | None:
    """Return the frames of a run's ``best`` if it is later than ``frames`` and has another config; else None.

    A run that goes on from ``frames`` with this config may never reach the policy of that ``best``.

    Args:
        run_dir: the run folder.
        frames: frames trained so far.
        config: the settings from now on, in the form that checkpoints store.
    """
    facts = read_facts(run_dir)
    return facts["frames"] if facts and facts["frames"] > frames and not has_config(facts, config) else None


def has_config(facts: dict, config: dict) -> bool:
    """Return whether a checkpoint has this config, given in the form that checkpoints store."""
    return facts["config"] == json.loads(json.dumps(config))


def is_trained_alike(facts: dict, config: dict) -> bool:
    """Return whether a checkpoint has this config but for :data:`SILENT_KEYS`, in the form that checkpoints store."""
    before, now = ({**each, **dict.fromkeys(SILENT_KEYS)} for each in (facts["config"], config))
    return has_config({"config": before}, now)


def is_validated_alike(facts: dict, config: dict) -> bool:
    """Return whether a checkpoint's best was validated by the settings of a config, in the form of checkpoints."""
    now = json.loads(json.dumps(config))
    return all(facts["config"].get(group) == now.get(group) for group in ("evaluation", "planner"))


#: Signals after which a training saves and ends: from Ctrl-C, from a scheduler, and from a closed terminal.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """A request to stop, by a signal: the loop finishes its batch and saves. A later Ctrl-C ends the process at once.

    A closed terminal is ignored if it was ignored before, as under ``nohup``.

    Attributes:
        signal: number of the first signal; None: there was none.
    """

    def __init__(self):
        self.signal: int | None = None
        ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        numbers = [number for number in STOP_SIGNALS if number != signal.SIGHUP or not ignored]
        self._previous = {number: signal.signal(number, self._request) for number in numbers}

    def _request(self, number, frame):
        if self.signal and number == signal.SIGINT:
            os._exit(130)
        if not self.signal:  # a terminal may send several
            self.signal = number
            log.warning("stopping after this batch; Ctrl-C stops at once")

    def restore(self) -> None:
        """Restore the earlier signal handlers."""
        for each, handler in self._previous.items():
            signal.signal(each, handler)


def checkpoint_hint(
    latest: Callable[[], Path | None], arguments: str = "", errors: type[Exception] = Exception
) -> AbstractContextManager:
    """Add the command that resumes a training to the error that ends it.

    Args:
        latest: returns the folder of the latest whole checkpoint, or None.
        arguments: further words of this command, such as `` trust=[my_models]``.
        errors: type of the errors to which the command is added.
    """

    def hinted(error: Exception) -> Exception:
        is_kept = isinstance(error, (FloatingPointError, WorkerDied, CheckpointError))
        kind, folder = type(error) if is_kept else ValueError, latest()
        whole = f"What was saved before is whole: pickplace-train resume={folder}{arguments}"
        return kind(f"{sentence(error).rstrip('.')}. {whole if folder else 'Nothing had been saved before.'}")

    return reword_errors(errors, hinted)
