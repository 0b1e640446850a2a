"""Run folders: each belongs to one process and one training, and holds Hydra's notes on the command of the run."""

import logging
import os
import shutil
import stat
from collections.abc import Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import yaml
from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

from pickplace.common.errors import sentence
from pickplace.common.files import read_file, replaced_file
from pickplace.common.validate import refuse_if
from pickplace.config.allowlist import REFERENCE, walk

LOCK = ".lock"  # held by the process that trains in the folder
FAILURE = "failure.txt"  # the error of a failed run of a sweep
EVALUATION = "evaluation.json"  # the result of an evaluation
REPORT = "report.html"  # the report of a finished training
CHECKPOINTS = ("best", "last", "previous")  # names of the folders in checkpoints/
MAX_NOTE = 2**20  # greatest size of a note of Hydra's, in bytes


class OccupiedError(ValueError):
    """A run folder holds a training or an evaluation already, finished or running."""


@contextmanager
def claim(run_dir: Path):
    """Hold a run folder for this process until the block or the process ends.

    Raises:
        OccupiedError: if another process holds it.
        ValueError: if its lock is a link.
    """
    _refuse_link(Path(run_dir) / LOCK)
    try:
        held = FileLock(Path(run_dir) / LOCK).acquire(timeout=0)
    except Timeout:
        raise OccupiedError(
            f"{run_dir}: another process is working there; expected another run folder, or to wait for it."
        ) from None
    with held:
        yield


def refuse_claimed(run_dir: Path) -> None:
    """Refuse a run folder in which another process trains or evaluates.

    Raises:
        OccupiedError: naming the folder.
    """
    if os.path.lexists(Path(run_dir) / LOCK):
        with claim(run_dir):
            pass


def is_claimed(run_dir: Path) -> bool:
    """Return whether another process trains or evaluates in a run folder."""
    try:
        refuse_claimed(run_dir)
    except OccupiedError:
        return True
    return False


def refuse_occupied(run_dir: Path) -> None:
    """Refuse a folder for a new run if it holds the results of another run: the files of both would be mixed.

    Raises:
        OccupiedError: naming the folder.
    """
    saved = run_dir / "checkpoints"
    refuse_training(saved.is_dir() and any(not entry.name.endswith(".new") for entry in saved.iterdir()), run_dir)
    for name, content in ((EVALUATION, "an evaluation"), (REPORT, "a report of a training")):
        refuse_if(
            (run_dir / name).exists(),
            f"{run_dir}: there is {content} already; expected another folder, hydra.run.dir=<folder>.",
            OccupiedError,
        )


def refuse_training(is_there: bool, run_dir: Path) -> None:
    """Refuse a folder if another training ``is_there``."""
    refuse_if(
        is_there,
        f"{run_dir}: there is a training already; expected another run folder, or resume={run_dir}.",
        OccupiedError,
    )


def refuse_parts(run_dir: Path) -> None:
    """Refuse, for a new run, the folder of another run's notes or checkpoints, and any folder in it.

    Raises:
        OccupiedError: naming the folder.
    """
    folder = run_dir.resolve()
    for part in (folder, *folder.parents[:2]):
        names = {"checkpoints": CHECKPOINTS, ".hydra": ("hydra.yaml",)}.get(part.name, ())
        is_checkpoint = part == folder and (part / "state.json").exists()
        refuse_if(
            is_checkpoint or any((part / name).exists() for name in names),
            f"{run_dir}: a part of another run; expected another folder, hydra.run.dir=<folder>.",
            OccupiedError,
        )


def refuse_links(run_dir: Path) -> None:
    """Refuse a run folder with links, which would redirect written files; the folder may come from strangers.

    Raises:
        ValueError: for a link, a file with a second name (a hard link), a pipe or a device in it, naming it.
    """
    for folder in (run_dir, run_dir / "checkpoints", run_dir / ".hydra"):
        for entry in os.scandir(folder) if folder.is_dir() else ():
            _refuse_link(Path(entry.path))


def refuse_for_run(run_dir: Path, notes: Sequence[str] = ()) -> None:
    """Refuse a folder that cannot hold a new run: it belongs to another run, is in use, or has links."""
    refuse_for_job(run_dir)
    refuse_claimed(run_dir)
    refuse_occupied(run_dir)


def refuse_for_job(run_dir: Path) -> None:
    """Refuse a part of another run's folder, or a folder with links; a sweep's run may go on in its own folder."""
    refuse_parts(run_dir)
    refuse_links(run_dir)


def refuse_for_sweep(sweep: Path, notes: Sequence[str]) -> None:
    """Refuse the folder of a sweep if it has links, or if a run folder in it, one with any of these notes, has."""
    refuse_links(sweep)
    for folder in sweep.iterdir() if sweep.is_dir() else ():
        if any(os.path.lexists(folder / name) for name in notes):
            refuse_links(folder)


def _refuse_link(path: Path) -> None:
    try:
        found = path.lstat()
    except FileNotFoundError:  # missing, or just removed by the process that works there
        return
    refuse_if(
        not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)),
        f"{path}: a link or no regular file; expected only files and folders in a run.",
    )
    refuse_if(
        stat.S_ISREG(found.st_mode) and found.st_nlink > 1,
        f"{path}: a hard link, a file with another name elsewhere; expected a run folder of its own, such as a "
        "copy (cp -r).",
    )


def note_failure(run_dir: Path, error: Exception) -> None:
    """Write the error of a sweep's run into its folder, unless another run occupies the folder."""
    if not isinstance(error, OccupiedError):
        with suppress(OSError), replaced_file(run_dir / FAILURE) as new:  # the disk may be full
            new.write_text(f"{sentence(error)}\n")


def remove_empty(folder: Path, notes: Sequence[str], is_sweep: bool) -> None:
    """Remove the folder of a run if it holds only notes, or the folder of a sweep if it holds only such runs.

    Args:
        folder: the folder.
        notes: names of Hydra's notes in the folder of a run.
        is_sweep: whether it is the folder of a sweep.
    """
    logging.shutdown()
    names = {LOCK, FAILURE, *notes}

    def is_empty(run_dir: Path) -> bool:
        return run_dir.is_dir() and set(os.listdir(run_dir)) <= names and not is_claimed(run_dir)

    runs = [entry for entry in folder.iterdir() if entry.name != "multirun.yaml"] if folder.is_dir() else []
    if all(map(is_empty, runs)) if is_sweep else is_empty(folder):
        shutil.rmtree(folder, ignore_errors=True)


def noted_command(run_dir: Path) -> list[str]:
    """Return the words of a run's command, the words with folders of configs first; empty if Hydra noted none."""
    try:
        words = read_note(run_dir, "hydra.yaml")["hydra"]["overrides"]["hydra"]
    except (KeyError, TypeError):
        words = []
    folders = [word for word in _texts(words) if "hydra.searchpath" in word]
    return folders + _texts(read_note(run_dir, "overrides.yaml"))


def _texts(values) -> list[str]:
    return [value for value in values if isinstance(value, str)] if isinstance(values, list) else []


def changed_values(run_dir: Path, cfg: DictConfig) -> list[str]:
    """Return the values of a config, as ``key=value``, that have changed since its run began.

    Nothing in Hydra's note is resolved. An interpolation that checkpoints do not keep, such as of an environment
    variable, counts as unchanged.
    """
    if not isinstance(began := read_note(run_dir, "config.yaml"), dict):
        return []

    def is_value(path: tuple, value) -> bool:
        return not isinstance(value, dict) and all(isinstance(key, str) for key in path)

    def is_unknown(value) -> bool:
        return isinstance(value, str) and "${" in value and not REFERENCE.fullmatch(value)

    nodes = walk(began), walk(OmegaConf.to_container(cfg, resolve=False))
    before, now = ({".".join(path): value for path, value in each if is_value(path, value)} for each in nodes)
    return [f"{key}={now[key]}" for key in now if now[key] != before.get(key) and not is_unknown(before.get(key))]


class _NoteLoader(yaml.SafeLoader):
    """A loader that refuses aliases. Hydra writes none, and a few of them can unfold to more than any memory holds."""

    def compose_node(self, parent, index):
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)


def read_note(run_dir: Path, name: str):
    """Return the unresolved content of one of Hydra's notes, such as ``config.yaml``; None if it cannot be read."""
    try:
        return yaml.load(read_file(Path(run_dir) / ".hydra" / name, MAX_NOTE), _NoteLoader)
    except Exception:  # any type, as PyYAML's constructors do not check what they read
        return None
