"""The commands as Hydra applications: command line, refusals before anything is written, and sweeps."""

import argparse
import hashlib
import logging
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from pickplace.common.errors import Parser, full_names, one_sentence, sentence, write_output
from pickplace.common.interrupts import import_quietly
from pickplace.common.validate import refuse_any, refuse_if, reword_errors
from pickplace.config import composition
from pickplace.config.help import help_text
from pickplace.config.own_values import own_values
from pickplace.config.words import conf_dir, config_files, parse, task_overrides

log = logging.getLogger(__name__)

#: The flags for folders of config files, and the others, as arguments of :class:`Parser`.
FOLDERS: dict[str, dict[str, Any]] = {"--config-dir/-cd": {"action": "append", "default": []}}
OPTIONS: dict[str, dict[str, Any]] = {
    "--cfg/-c": {"choices": ["job", "hydra", "all"]},
    "--package/-p": {},
    "--info/-i": {"nargs": "?", "const": "all"},
    **dict.fromkeys(
        ("--help/-h", "--multirun/-m", "--run/-r", "--resolve", "--hydra-help", "--version", "--shell-completion/-sc"),
        {"action": "store_true"},
    ),
}
FLAGS = [name for names in (*FOLDERS, *OPTIONS) for name in names.split("/")]

LONGEST_NAME = 150  # letters of the name of a run folder; file systems allow 255 bytes


@dataclass
class Command:
    """A Hydra application, which runs ``task(cfg, run_dir)``.

    Args:
        config_name: the file in ``conf/``.
        task: dotted path of the function. Its module, which may take seconds, is imported after all checks.
        folders: the module that refuses and cleans the folders of runs, :mod:`pickplace.runs.folder`.
        from_checkpoint: groups whose keys come from a checkpoint; ``check`` and ``task`` check them.
        check: called with the config; it may refuse it.
        after_sweep: called with the folder of a sweep, however it ends.
    """

    config_name: str
    task: str
    folders: Any
    from_checkpoint: tuple[str, ...] = ()
    check: Callable[[DictConfig], Any] = lambda cfg: None
    after_sweep: Callable[[Path], Any] | None = None

    def __call__(self) -> None:
        """Run the command line; a user's mistake ends in one sentence and exit code 2.

        The config of the run, or of the first run of a sweep, is composed and checked before anything is written.
        """
        with one_sentence():
            self._refuse_flags(sys.argv[1:])
            words, flags, options = read_command_line(sys.argv[1:])
            words = [f"++{word}" if self._is_of_checkpoint(word, words) else word for word in words]
            if options.info or options.hydra_help or options.version or options.shell_completion:
                return self._start(words, flags)
            with config_files():
                merged, cfg = composition.compose_job(self.config_name, words)
                if options.help:
                    return write_output(help_text(self.config_name, merged))
                if options.cfg == "job":
                    return show(cfg, options)
                if not options.cfg:
                    self._checked(cfg)
                    self.check(cfg)
            if options.cfg:
                return self._start(words, flags)
            is_sweep = options.multirun or merged.hydra.mode == RunMode.MULTIRUN
            return self._run(merged, None if is_sweep else cfg, words, flags)

    def _is_of_checkpoint(self, word: str, words: list[str]) -> bool:
        """Return whether a word of the command line overrides a key that a checkpoint brings."""
        group = word.partition(".")[0]
        is_given = any(re.fullmatch("[+]*checkpoint=(?!null$).+", each) for each in words)
        return group in self.from_checkpoint and (is_given or group not in composition.compose_plain(self.config_name))

    def _refuse_flags(self, arguments: list[str]) -> None:
        """Refuse words that begin with a dash and are no flags; the message suggests the flag or key that is meant."""
        for flag, following in zip(arguments, [*arguments[1:], ""], strict=False):
            name, _, value = flag.partition("=")
            if not name.startswith("-") or name in FLAGS:
                continue
            keys = full_names(name.lstrip("-"), composition.known_names(composition.compose_plain(self.config_name)))
            close = get_close_matches(name, FLAGS, 1, 0.8)
            if not value:
                value = "<value>" if not following or following.startswith("-") or "=" in following else following
            meant = close or [f"{key}={value}" for key in keys] or ["<key>=<value>"]
            raise ValueError(f"{name}: there is no such flag, and keys have no dashes; expected {' or '.join(meant)}.")

    def _checked(self, cfg: DictConfig) -> DictConfig:
        return composition.check_keys(cfg, self.config_name, self.from_checkpoint)

    def _start(self, words: list[str], flags: list[str], app: Callable[[DictConfig], Any] = lambda cfg: None) -> None:
        sys.argv[1:] = [*words, *flags]
        with reword_errors(HydraException, lambda error: composition.clearer_error(error, self.config_name, words)):
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=self.config_name)(app)()

    def _run(self, merged: DictConfig, checked: DictConfig | None, words: list[str], flags: list[str]) -> None:
        """Run the task with a checked config, or without one for each job of a sweep. The folder must not be in use.

        If one job fails, the others go on. A folder in which nothing was written is removed.
        """
        errors: list[Exception] = []
        is_sweep = checked is None

        def app(hydras: DictConfig) -> Any:
            running = HydraConfig.get()
            run_dir = Path(running.runtime.output_dir)
            try:
                self.folders.refuse_for_job(run_dir)
                cfg = checked or self._checked(own_values(hydras))
                if running.output_subdir is not None and cfg != hydras:  # correct Hydra's note on its merge
                    OmegaConf.save(cfg, run_dir / running.output_subdir / "config.yaml")
                return getattr(import_module(module), name)(cfg, run_dir)
            except Exception as error:
                if not is_sweep:  # raised after Hydra has ended: it would print its own lines
                    return errors.append(error)
                self.folders.note_failure(run_dir, error)
                log.error("run %s failed: %s", run_dir.name, sentence(error))
                # The error itself may not cross processes.
                raise ValueError(f"run {run_dir.name}: {sentence(error)}") from error

        if not is_sweep:
            composition.refuse_several_values(words)
        kind, other = ("sweep", "run") if is_sweep else ("run", "sweep")
        refuse_any(
            (word for word in words if word.lstrip("+").startswith(f"hydra.{other}.dir=")),
            lambda word: f"{word}: this is a {kind}; expected hydra.{kind}.dir=<folder>.",
        )
        settings = sweep_words(merged, words) if is_sweep else []
        path = merged.hydra[kind].dir  # fixed from here on: it may hold the time
        folder, notes, is_done = Path(path), [".hydra", f"{merged.hydra.job.name}.log"], False
        (self.folders.refuse_for_sweep if is_sweep else self.folders.refuse_for_run)(folder, notes)
        module, _, name = self.task.rpartition(".")
        import_quietly(module)
        try:
            self._start([*settings, *words, f"hydra.{kind}.dir={composition.quoted(path)}"], flags, app)
            if errors:
                raise errors[0]
            is_done = True
        except OSError as error:
            if error.filename or error.errno is None:
                raise
            raise OSError(error.errno, error.strerror, path) from error
        except ValueError as error:
            if isinstance(error.__cause__, OSError) and str(error).startswith("Unable to configure"):  # a log file
                raise error.__cause__ from None
            raise
        finally:
            if not is_done:
                self.folders.remove_empty(folder, notes, is_sweep)
            if is_sweep and self.after_sweep and folder.is_dir():
                try:
                    self.after_sweep(folder)
                except Exception as error:  # an error that ended the sweep matters more
                    log.error(sentence(error))


def read_command_line(arguments: list[str]) -> tuple[list[str], list[str], argparse.Namespace]:
    """Return the overrides of a command line, its flags for Hydra, and the values of these.

    Folders of ``--config-dir``, which may be given several times, are among the overrides, as Hydra's search path.
    A ``ValueError`` names a flag with a bad value, or a folder that does not exist.
    """
    settings: dict = {"add_help": False, "allow_abbrev": False}
    first = Parser(FOLDERS, **settings)
    folders, rest = first.parse_known_args(arguments)
    for folder in folders.config_dir:
        refuse_if(not Path(folder).is_dir(), f"--config-dir {folder}: no such folder; expected one with config files.")
    options = Parser({"words": {"nargs": "*"}, **OPTIONS}, **settings).parse_intermixed_args(rest)
    return (
        composition.merge_search_path(options.words, folders.config_dir),
        [word for word in rest if word not in options.words],
        options,
    )


def show(cfg: DictConfig, options: argparse.Namespace) -> None:
    """Print a config, as Hydra's ``--cfg job`` with ``--package`` and ``--resolve``."""
    if options.resolve:
        OmegaConf.resolve(cfg)
    part = cfg if options.package in (None, "_global_") else OmegaConf.select(cfg, options.package)
    refuse_if(part is None, f"--package {options.package}: there is no such part of the config.")
    header = f"# @package {options.package}\n" if options.package else ""
    write_output(header + (OmegaConf.to_yaml(part) if OmegaConf.is_config(part) else f"{part}\n"))


def sweep_words(merged: DictConfig, words: list[str]) -> list[str]:
    """Return Hydra's settings for a sweep, as overrides, from a command line and Hydra's merge of it."""
    logging.getLogger("alembic").setLevel(logging.WARNING)  # Optuna's database tool logs every migration
    keys = ",".join(map(composition.quoted, constant_keys(words)))
    direction = ["hydra.sweeper.direction=maximize"] if "direction" in merged.hydra.sweeper else []  # Optuna's
    return [f"hydra.job.config.override_dirname.exclude_keys=[{keys}]", *direction]


def constant_keys(words: list[str]) -> list[str]:
    """Return the keys that have the same value in all runs of a sweep's command line, except the seed."""
    constant = [each for each in parse(words) if not (each.is_hydra_override() or each.is_sweep_override())]
    return [key for each in constant if (key := each.get_key_element().lstrip("+~")) != "seed"]


def folder_name(overrides: list[str], constant: list[str]) -> str:
    """Return the folder name of a run in a sweep: its overrides except those of ``constant`` keys, the seed last.

    An override takes the name without quotes: it may have ``+`` and ``-``, but neither ``=`` nor ``,``. A name that
    leaves out characters, or would be too long, ends in a hash of the overrides.
    """
    pairs = sorted((word.lstrip("+~").partition("=")[::2] for word in overrides), key=lambda pair: pair[0] == "seed")
    pairs = [pair for pair in pairs if pair[0] not in constant] or pairs
    plain = "+".join(f"{key.replace('/', '.')}-{value}" for key, value in pairs) or "run"
    name = re.sub(r"[^\w.+-]+", "-", plain, flags=re.ASCII)
    if name == plain and len(name) <= LONGEST_NAME:
        return name
    name = re.sub(r"[-.]*([-+.])[-.]*", r"\1", name)[:LONGEST_NAME]
    return f"{name}-{hashlib.sha256(plain.encode()).hexdigest()[:8]}".lstrip("-.")


def _run_name(_root_: DictConfig) -> str:
    """Return the name of the folder of a sweep's run; its number where a sampler may draw the same values twice."""
    cfg = _root_.hydra
    name = folder_name(task_overrides(cfg), list(cfg.job.config.override_dirname.exclude_keys))
    return name if cfg.sweeper._target_.endswith(".BasicSweeper") else str(cfg.job.num)


OmegaConf.register_new_resolver("run_name", _run_name, replace=True)
