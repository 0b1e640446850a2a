"""How a training is stopped and taken up again: signals, the run folder's lock, what a resumed run may change."""

import json
import logging
import os
import reprlib
import signal
from contextlib import contextmanager
from pathlib import Path

import torch
from filelock import FileLock, Timeout
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
from pickplace.runs.allowlist import own_modules, saved_form, trusted

log = logging.getLogger(__name__)

#: What a checkpoint counts, and how a run begins: frames, iterations, best validation occupancy, latest validation.
COUNTERS = {"frames": 0, "iteration": 0, "best": -1.0, "latest": {}}

#: What no checkpoint may reach by itself, only who resumes it: other machines, and databases elsewhere.
AT_HOME = {"collector.address": ("local", None), "logger.uri": ("null", None), "logger.offline": ("true", True, None)}

#: What the state of running episodes is tied to.
RULES = ("bin_size", "tote_size", "effector_size", "rotations", "pick_rule", "min_support", "strict_support")
FIXED = ("seed", *(f"env.{key}" for key in RULES), "env.num_envs", "items", "algo.mask_infeasible", "collector.workers")


def resumed_config(place: str, facts: dict, overrides: list[str]) -> DictConfig:
    """A checkpoint's config with overrides of values on top.

    Raises:
        ValueError: for a checkpoint that no training wrote, or a change that a resumed run cannot follow.
    """
    if missing := [key for key in ("curriculum", *COUNTERS) if key not in facts]:
        raise ValueError(f"resume={place}: the checkpoint has no {missing[0]!r}; expected one that a training wrote.")
    told = f"resume={place}: the checkpoint's {{}} is {{}}; expected {{}} that a training wrote.".format
    if not isinstance(facts["latest"], dict):
        raise ValueError(told("latest", reprlib.repr(facts["latest"]), "a validation"))
    for key, value in {"iteration": facts["iteration"], "best": facts["best"], **facts["latest"]}.items():
        kind = int if key == "iteration" else (int, float)
        if isinstance(value, bool) or not isinstance(value, kind) or not -(2**63) < value < 2**63:
            raise ValueError(told(reprlib.repr(key)[1:-1], reprlib.repr(value), "a number"))
    # Only who resumes a run says what to trust, never the checkpoint.
    given = OverridesParser.create().parse_overrides(overrides)
    trust = own_modules(next((word.value() for word in reversed(given) if word.key_or_group == "trust"), None))
    saved = trusted(facts["config"], trust)
    saved["trust"] = list(trust)
    named = {word.key_or_group for word in given}
    for key, harmless in AT_HOME.items():
        value = OmegaConf.select(saved, key)
        if value not in harmless and key not in named:
            raise ValueError(
                f"{key}={value}: the checkpoint would reach out of this run's folder or this machine; expected that "
                f"you say so again, {key}={value}, or {key}={harmless[0]}."
            )
    cfg = config.apply_overrides(saved, [str(word.input_line) for word in given if word.key_or_group != "trust"])
    for key in FIXED:
        was, now = OmegaConf.select(saved, key), OmegaConf.select(cfg, key)
        if was != now:
            raise ValueError(
                f"{key}={now}: the run began with {was}, and a resumed run cannot change it; start a new one."
            )
    if type(cfg.total_frames) is not int:
        raise ValueError(f"total_frames={cfg.total_frames}: expected a whole number >= 1 and < 2**63.")
    if cfg.total_frames != saved.total_frames and cfg.total_frames < facts["frames"]:
        raise ValueError(
            f"total_frames={cfg.total_frames}: the run has trained {facts['frames']} frames already; expected more."
        )
    return cfg


def begun_already(cfg: DictConfig, run_dir: Path) -> tuple[dict, dict, Path] | None:
    """State, facts and folder of the checkpoint to go on from, if this very run was begun in its folder: a job of a
    sweep that a scheduler has preempted, and starts again.

    Raises:
        Occupied: if it was another run.
    """
    try:
        folder = checkpoint.locate(run_dir, prefer="last")
        state, facts = checkpoint.read(folder)
    except checkpoint.CheckpointError:
        config.refuse_occupied(run_dir)
        return None
    if facts["config"] != json.loads(json.dumps(saved_form(cfg))) or "curriculum" not in facts:
        raise config.Occupied(config.OCCUPIED.format(run_dir))
    log.info("going on with %s at %s frames", run_dir, f"{facts['frames']:,}")
    return state, facts, folder


def best_of_another_course(run_dir: Path, frames: int, content: dict) -> int | None:
    """The frames of a run's ``best`` if it may never come to it, going on from ``frames`` with other settings, or None.

    Args:
        content: the settings from now on, in the form that checkpoints hold.
    """
    facts = checkpoint.read_facts(run_dir)
    if not facts or facts["frames"] <= frames or facts["config"] == json.loads(json.dumps(content)):
        return None
    return facts["frames"]


def load_optimizer(optimizer: torch.optim.Adam, state: dict) -> None:
    """Give Adam the moments of a checkpoint; parameters without a gradient so far have none.

    Raises:
        CheckpointError: if they do not fit the parameters.
    """
    if not state or not isinstance(state, dict):
        raise checkpoint.CheckpointError("The checkpoint has no optimizer; expected one that a training wrote.")
    parameters = dict(enumerate(optimizer.param_groups[0]["params"]))
    if unknown := [key for key in state if key not in parameters]:
        raise checkpoint.CheckpointError(
            f"The checkpoint's optimizer has {reprlib.repr(unknown[0])}; expected numbers below {len(parameters)}."
        )
    mine = {n: {"step": torch.tensor(0.0), "exp_avg": p, "exp_avg_sq": p} for n, p in parameters.items() if n in state}
    moments = checkpoint.fitting(state, mine, "optimizer")
    optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})


class StopRequest:
    """Ctrl-C and SIGTERM ask the loop to finish its batch and save; a second Ctrl-C ends the process at once."""

    def __init__(self):
        self.requested = False
        self._previous = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}

    def _ask(self, number, frame):
        if self.requested:
            os._exit(130)
        self.requested = True
        log.info("stopping after this batch; press Ctrl-C again to stop at once")

    def restore(self) -> None:
        """Give the signals back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)


def refuse_links(run_dir: Path) -> None:
    """Refuse a run folder, which may come from others, that would make a resumed run write somewhere else.

    Raises:
        ValueError: for a link, a pipe or a device in it, naming it.
    """
    for folder in (run_dir, run_dir / "checkpoints", run_dir / ".hydra"):
        for entry in os.scandir(folder) if folder.is_dir() else ():
            if entry.is_symlink() or not (entry.is_file() or entry.is_dir()):
                raise ValueError(f"{entry.path}: a link or no regular file; expected only files and folders in a run.")


@contextmanager
def claim(run_dir: Path):
    """Hold a run folder for this process, until the end of the block or of the process, however it ends.

    Raises:
        ValueError: if another process holds it.
    """
    lock = FileLock(Path(run_dir) / config.LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise config.Occupied(config.TAKEN.format(run_dir)) from None
    try:
        yield
    finally:
        lock.release()


@contextmanager
def saying_what_is_safe(safe, trust: str = ""):
    """Add to what ends a training the checkpoint, ``safe()``, from which it can be taken up.

    Args:
        safe: gives its folder, or None.
        trust: what has to be said beside it, `` trust=[...]`` or nothing.
    """
    try:
        yield
    except Exception as error:
        hint = "Nothing had been saved before."
        if folder := safe():
            # The same batch would lead to the same numbers.
            other = " algo.lr=<a smaller one>" if isinstance(error, FloatingPointError) else ""
            hint = f"What was saved before is whole: pickplace-train resume={folder}{trust}{other}"
        kept = (FloatingPointError, config.WorkerDied, checkpoint.CheckpointError)
        kind = type(error) if isinstance(error, kept) else ValueError
        raise kind(f"{config.sentence(error).rstrip('.')}. {hint}") from error
