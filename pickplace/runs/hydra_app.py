"""The commands as Hydra applications: config files, overrides on saved configs, and refusals before a run begins."""

import logging
import os
import re
import sys
from contextlib import contextmanager, suppress
from pathlib import Path

import hydra
from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import ConfigCompositionException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, read_write
from omegaconf.errors import OmegaConfBaseException

from pickplace.common.files import replaced_file
from pickplace.config.composition import (
    compose_for_hint,
    conf_dir,
    constant_keys,
    drop_replaced_values,
    list_options,
    task_overrides,
)
from pickplace.config.errors import JobFailed, UsageError, one_sentence, sentence, unknown_key
from pickplace.config.registry import REGISTRY, names_at
from pickplace.runs.folder import (
    FAILURE,
    OccupiedError,
    refuse_claimed,
    refuse_links,
    refuse_occupied,
    refuse_parts,
    remove_empty_folders,
)

log = logging.getLogger(__name__)

#: Hydra's flags that take a value.
VALUE_FLAGS = {"--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn", "--cfg", "-c", "--package", "-p"}
VALUE_FLAGS |= {"--info", "-i"}


def command(config_name: str, task, from_checkpoint: tuple[str, ...] = ()) -> None:
    """Run ``task(cfg, run_dir)`` as a Hydra application; a user's mistake ends in one sentence and exit code 2.

    A run folder in which nothing was written is removed again.

    Args:
        config_name: the file in ``conf/``.
        task: the function.
        from_checkpoint: groups whose keys a checkpoint brings; overrides of them reach ``task`` unchecked.
    """
    full_error = os.environ.get("HYDRA_FULL_ERROR", "")
    overrides = overrides_first(sys.argv[1:])
    unchecked = tuple(f"{group}." for group in from_checkpoint)
    sys.argv[1:] = [f"++{word}" if word.startswith(unchecked) else word for word in overrides]

    def app(cfg: DictConfig):
        hydra_cfg = HydraConfig.get()
        os.environ["HYDRA_FULL_ERROR"] = full_error
        with _job_of_sweep() if hydra_cfg.mode == RunMode.MULTIRUN else _single_run():
            refuse_parts(Path(hydra_cfg.runtime.output_dir))
            refuse_links(Path(hydra_cfg.runtime.output_dir))
            cfg = drop_replaced_values(cfg)
            if missing := OmegaConf.missing_keys(cfg):
                raise ValueError(f"{min(missing)}: no value; expected {min(missing)}=<value>.")
            known = hydra.compose(hydra_cfg.job.config_name)
            checked = [str(key) for key in cfg if key not in from_checkpoint]
            refuse_unknown_keys(OmegaConf.masked_copy(cfg, checked), known)
            return task(cfg, Path(hydra_cfg.runtime.output_dir))

    app.__module__, app.__qualname__ = "__main__", "app"
    HydraConfig.instance().cfg = None
    with one_sentence(), _clearer_errors(config_name, overrides):
        os.environ["HYDRA_FULL_ERROR"] = "1"  # makes Hydra raise errors instead of printing them over many lines
        try:
            with _callbacks_at_end_of_sweep(), remove_empty_folders(), _final_config_shown():
                hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config_name)(app)()
        finally:
            os.environ["HYDRA_FULL_ERROR"] = full_error


def overrides_first(words: list[str]) -> list[str]:
    """Return a command line with its overrides before its flags: argparse takes overrides on one side of them only."""
    pairs = zip(["", *words], words, strict=False)
    is_flag = [word.startswith("-") or before in VALUE_FLAGS for before, word in pairs]
    return [word for _, word in sorted(zip(is_flag, words, strict=True), key=lambda pair: pair[0])]


@contextmanager
def _final_config_shown():
    """Let ``--cfg`` and ``--help`` print the config that is run, not the one that Hydra merged."""
    select = Hydra.get_sanitized_cfg
    Hydra.get_sanitized_cfg = lambda self, cfg, kind: select(self, drop_replaced_values(cfg), kind)  # type: ignore
    try:
        yield
    finally:
        Hydra.get_sanitized_cfg = select  # type: ignore[method-assign]


@contextmanager
def _job_of_sweep():
    """Note an error in the run's folder; the other runs of the sweep go on."""
    try:
        yield
    except Exception as error:
        folder = Path(HydraConfig.get().runtime.output_dir)
        if not isinstance(error, OccupiedError):  # the training in that folder has not failed
            with suppress(OSError), replaced_file(folder / FAILURE) as new:  # the disk may be full
                new.write_text(f"{sentence(error)}\n")
        log.error("run %s failed: %s", folder.name, sentence(error))
        raise JobFailed(f"run {folder.name}: {sentence(error)}") from error
    finally:
        os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra goes on in this process


@contextmanager
def _single_run():
    """End a run that is no part of a sweep in one sentence, without an empty folder."""
    with one_sentence(), remove_empty_folders():
        yield


@contextmanager
def _callbacks_at_end_of_sweep():
    """Call ``on_multirun_end`` where Hydra does not: after a job that failed or was stopped."""
    try:
        yield
    except BaseException:
        cfg = HydraConfig.get() if HydraConfig.initialized() else None
        if cfg and cfg.mode == RunMode.MULTIRUN and os.path.isdir(cfg.sweep.dir):
            for callback in cfg.callbacks.values():
                try:
                    hydra.utils.instantiate(callback).on_multirun_end(HydraConfig.instance().cfg)
                except Exception as error:  # the error that ended the sweep matters more
                    log.error(sentence(error))
        raise


@contextmanager
def _clearer_errors(config_name: str, overrides: list[str]):
    """Replace Hydra's errors about an override by sentences that name the key and what was expected."""
    try:
        yield
    except _Refusal as error:
        raise ValueError(str(error)) from None
    except OSError as error:
        if error.filename or error.errno is None or not HydraConfig.initialized():
            raise
        folder = HydraConfig.get().runtime.output_dir  # Hydra's notes are there, which a full disk does not name
        raise OSError(error.errno, error.strerror, folder) from error
    except ConfigCompositionException as error:
        if not (key := re.match("Could not override '(.*)'", str(error))):
            raise
        raise ValueError(unknown_key(key[1], compose_for_hint(config_name, overrides, key[1]))) from error
    except UsageError:
        raise
    except (ValueError, TypeError) as error:  # Hydra's own, which names no key
        if isinstance(error.__cause__, OSError):  # such as a log file that cannot be opened
            raise error.__cause__ from None
        for word in overrides:  # a group without an option, allowed for presets only
            group, _, option = word.lstrip("+").partition("=")
            is_empty = option in ("null", "") and group not in ("benchmark", "experiment")
            if is_empty and (names := list_options(group, config_name, overrides)):
                raise ValueError(f"{word}: expected {group}=<one of {', '.join(names)}>.") from error
        raise ValueError(f"{' '.join(overrides)}: {error}.") from error


class _Refusal(BaseException):
    """A run is refused before it begins. A BaseException, since Hydra only warns of an Exception in a callback."""


@contextmanager
def _refusal():
    """Turn an error about a folder into a refusal of the run, or sweep, that would begin there."""
    try:
        yield
    except (OSError, ValueError) as error:
        HydraConfig.instance().cfg = None  # nothing in that folder is ours
        raise _Refusal(sentence(error)) from None


class FreshFolder(Callback):
    """Refuses a folder of another run or with links, before Hydra writes its notes there."""

    def on_run_start(self, config: DictConfig, **kwargs) -> None:
        HydraConfig.instance().set_config(config)  # for references such as ${hydra:job.name}
        folder = Path(config.hydra.run.dir)
        with _refusal():
            refuse_parts(folder)
            refuse_links(folder)
            refuse_claimed(folder)
            refuse_occupied(folder)
        with read_write(config.hydra.runtime):  # :func:`command` needs it if Hydra cannot write its notes
            config.hydra.runtime.output_dir = str(folder.absolute())
        HydraConfig.instance().set_config(config)


class SweepCallback(Callback):
    """Tells :func:`command` the folder of a sweep before its jobs are composed, which may fail, and names theirs.

    A folder with links is refused, before Hydra writes its notes there.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs) -> None:
        HydraConfig.instance().set_config(config)
        sweep, notes = Path(config.hydra.sweep.dir), (".hydra", f"{config.hydra.job.name}.log")
        with _refusal():
            refuse_links(sweep)
            for folder in sweep.iterdir() if sweep.is_dir() else ():
                if any(os.path.lexists(folder / name) for name in notes):
                    refuse_links(folder)
        keys = ",".join(f"'{key}'" for key in constant_keys(task_overrides(config.hydra)))
        with read_write(config.hydra):  # the jobs are composed with these; the user's own come later, and win
            config.hydra.overrides.hydra.insert(0, f"hydra.job.config.override_dirname.exclude_keys=[{keys}]")


def refuse_unknown_keys(cfg: DictConfig, known: DictConfig, path: str = "") -> None:
    """Refuse misspelt keys: Hydra adds any key of a preset, or after a ``+``.

    Nodes with a ``_target_`` are left to :func:`pickplace.config.registry.build`, which knows their arguments.

    Raises:
        ValueError: naming the key, and the ones that there are.
    """
    for key, node in cfg.items():
        name = path + str(key)
        if f"{path}*" in REGISTRY:  # a dict of parts with names of the user's choice
            continue
        if key not in known:
            raise ValueError(unknown_key(name, known, path))
        if OmegaConf.is_dict(node) and OmegaConf.is_dict(known[key]) and "_target_" not in node:
            refuse_unknown_keys(node, known[key], f"{name}.")


def apply_overrides(saved: DictConfig, overrides: list[str], groups: dict[str, DictConfig] | None = None) -> DictConfig:
    """Return a saved config with command-line overrides on top.

    Args:
        saved: the config of a checkpoint.
        overrides: as on Hydra's command line, ``key=value``; a leading ``+`` changes nothing.
        groups: composed nodes of the config groups that may be exchanged as a whole.

    Raises:
        ValueError: for a group that cannot be exchanged, a key that the config does not have, or a bad value.
    """
    cfg = saved.copy()
    OmegaConf.set_struct(cfg, True)
    for override in OverridesParser.create().parse_overrides(overrides):
        key, line = override.key_or_group, override.input_line
        is_part = key.startswith("env.") and bool(names_at(key))  # a part of the cell, in its short or its long form
        if groups and key in groups:
            cfg[key] = groups[key]
        elif "/" in key or (isinstance(OmegaConf.select(cfg, key), DictConfig) and not is_part):
            raise ValueError(
                f"{line!r}: the checkpoint's config group {key!r} cannot be exchanged; expected overrides of its "
                f"values, such as {key.replace('/', '.')}.<key>=<value>."
            )
        elif override.is_delete() or override.is_sweep_override():
            raise ValueError(f"{line!r}: expected <key>=<value> with one value, on top of the checkpoint's config.")
        else:
            try:
                OmegaConf.update(cfg, key, override.value(), merge=not is_part)
            except OmegaConfBaseException as error:
                raise ValueError(unknown_key(key, cfg)) from error
    return cfg
