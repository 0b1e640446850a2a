"""The commands as Hydra applications: their command line, and refusals before anything is written."""

import argparse
import logging
import os
import sys
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from pickplace.config import composition
from pickplace.config.errors import JobFailed, Parser, one_sentence, sentence, write_output
from pickplace.config.sweeps import sweep_words

log = logging.getLogger(__name__)


@dataclass
class Command:
    """A Hydra application, which runs ``task(cfg, run_dir)``.

    Args:
        config_name: the file in ``conf/``.
        task: the function.
        folders: refuses and cleans the folders of runs: :mod:`pickplace.runs.folder`; None: only help is asked for.
        from_checkpoint: groups whose keys a checkpoint brings; overrides of them reach ``task`` unchecked.
        after_sweep: called with the folder of a sweep, however it ends.
    """

    config_name: str
    task: Callable[[DictConfig, Path], Any] = lambda cfg, run_dir: None
    folders: Any = None
    from_checkpoint: tuple[str, ...] = ()
    after_sweep: Callable[[Path], Any] | None = None

    def __call__(self) -> None:
        """Run the command line; a user's mistake ends in one sentence and exit code 2.

        The config of the run, or of the first run of a sweep, is composed and checked before anything is written.
        """
        with one_sentence(), _errors_raised():
            words, flags, options = read_command_line(sys.argv[1:])
            unchecked = tuple(f"{group}." for group in self.from_checkpoint)
            words = [f"++{word}" if word.startswith(unchecked) else word for word in words]
            if options.is_about_hydra:
                return self._start(words, flags)
            with composition.config_files():
                merged = composition.compose_first_job(self.config_name, words)
                HydraConfig.instance().set_config(merged)
                cfg = composition.own_values(composition.without_hydra(merged))
                if options.cfg == "job":
                    return show(cfg, options)
                if not (options.help or options.cfg):
                    self._check(cfg)
            if options.help or options.cfg or self.folders is None:
                return self._start(words, flags)
            if options.multirun or merged.hydra.mode == RunMode.MULTIRUN:
                return self._sweep(merged, words, flags)
            return self._run(merged, cfg, words, flags)

    def _check(self, cfg: DictConfig) -> None:
        """Refuse a config without a value, or with an unknown key."""
        if missing := OmegaConf.missing_keys(cfg):
            raise ValueError(f"{min(missing)}: no value; expected {min(missing)}=<value>.")
        keys = [str(key) for key in cfg if key not in self.from_checkpoint]
        composition.refuse_unknown_keys(OmegaConf.masked_copy(cfg, keys), hydra.compose(self.config_name))

    def _start(self, words: list[str], flags: list[str], app: Callable[[DictConfig], Any] = lambda cfg: None) -> None:
        """Start Hydra."""
        sys.argv[1:] = [*words, *flags]
        try:
            hydra.main(version_base="1.3", config_path=str(composition.conf_dir()), config_name=self.config_name)(app)()
        except ConfigCompositionException as error:
            raise composition.clearer_error(error, self.config_name, words) from error

    def _run(self, merged: DictConfig, cfg: DictConfig, words: list[str], flags: list[str]) -> None:
        """Run the task once."""
        errors: list[Exception] = []

        def app(hydras: DictConfig) -> Any:
            try:
                composition.correct_note(cfg, hydras)
                return self.task(cfg, composition.output_dir())
            except Exception as error:  # raised when Hydra has ended, which would print lines of its own
                return errors.append(error)

        with self._folder(merged, merged.hydra.run.dir) as folder:
            self._start([*words, f"hydra.run.dir={folder}"], flags, app)
            if errors:
                raise errors[0]

    def _sweep(self, merged: DictConfig, words: list[str], flags: list[str]) -> None:
        """Run the task for each job of a sweep; if one fails, the others go on."""

        def app(hydras: DictConfig) -> Any:
            run_dir = composition.output_dir()
            try:
                self.folders.refuse_for_job(run_dir)
                cfg = composition.own_values(hydras)
                self._check(cfg)
                composition.correct_note(cfg, hydras)
                return self.task(cfg, run_dir)
            except Exception as error:
                self.folders.note_failure(run_dir, error)
                log.error("run %s failed: %s", run_dir.name, sentence(error))
                raise JobFailed(f"run {run_dir.name}: {sentence(error)}") from error

        with self._folder(merged, merged.hydra.sweep.dir, is_sweep=True) as folder:
            self._start([*sweep_words(merged, words), *words, f"hydra.sweep.dir={folder}"], flags, app)

    @contextmanager
    def _folder(self, merged: DictConfig, path: str, is_sweep: bool = False):
        """Yield the name of a folder for an override, unless it is in use; remove it if nothing is written there."""
        folder, notes, is_done = Path(path), [".hydra", f"{merged.hydra.job.name}.log"], False
        (self.folders.refuse_for_sweep if is_sweep else self.folders.refuse_for_run)(folder, notes)
        try:
            yield composition.quoted(path)  # fixed: it may hold the time
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


@contextmanager
def _errors_raised():
    """Let Hydra raise errors, which it would print over many lines."""
    before = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        del os.environ["HYDRA_FULL_ERROR"]
        if before is not None:
            os.environ["HYDRA_FULL_ERROR"] = before


def read_command_line(arguments: list[str]) -> tuple[list[str], list[str], argparse.Namespace]:
    """Return the overrides of a command line, its flags for Hydra, and the values of these.

    Folders of ``--config-dir``, which may be given several times, are among the overrides, as Hydra's search path.

    Raises:
        UsageError: for an unknown flag.
        ValueError: for a folder that does not exist.
    """
    parser = Parser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd", action="append", default=[])
    folders, rest = parser.parse_known_args(arguments)
    for folder in folders.config_dir:
        if not Path(folder).is_dir():
            raise ValueError(f"--config-dir {folder}: no such folder; expected one with config files.")
    parser = Parser(add_help=False, allow_abbrev=False)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--cfg", "-c", choices=["job", "hydra", "all"])
    parser.add_argument("--package", "-p")
    parser.add_argument("--info", "-i", nargs="?", const="all")
    for flags in (("--help", "-h"), ("--multirun", "-m"), ("--run", "-r"), ("--resolve",), ("--hydra-help",)):
        parser.add_argument(*flags, action="store_true")
    for flags in (("--version",), ("--shell-completion", "-sc")):
        parser.add_argument(*flags, action="store_true")
    options = parser.parse_intermixed_args(rest)
    options.is_about_hydra = any((options.info, options.hydra_help, options.version, options.shell_completion))
    flags_of_hydra = [word for word in rest if word not in options.words]
    return composition.merge_search_path(options.words, folders.config_dir), flags_of_hydra, options


def show(cfg: DictConfig, options: argparse.Namespace) -> None:
    """Print a config, as Hydra's ``--cfg job`` with ``--package`` and ``--resolve``.

    Raises:
        ValueError: for a package that is not there.
    """
    if options.resolve:
        OmegaConf.resolve(cfg)
    part = OmegaConf.select(cfg, options.package) if options.package not in (None, "_global_") else cfg
    if part is None:
        raise ValueError(f"--package {options.package}: there is no such part of the config.")
    header = f"# @package {options.package}\n" if options.package else ""
    write_output(header + (OmegaConf.to_yaml(part) if OmegaConf.is_config(part) else f"{part}\n"))
