"""Hydra around the commands: where the config files are, overrides on saved configs, and errors in one sentence."""

import errno
import inspect
import logging
import os
import re
import shutil
import sys
from contextlib import contextmanager, nullcontext, suppress
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
    OverrideParseException,
)
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

if TYPE_CHECKING:
    import torch

log = logging.getLogger(__name__)

PACKAGE = Path(__file__).resolve().parent.parent
LOCK = ".lock"  # in a run folder, held by the process that trains there
OCCUPIED = "{0}: there is a training already; expected another run folder, or resume={0}."
TAKEN = "{}: another process is training there; expected another run folder, or to wait for it."
FAILURE = "failure.txt"  # in a sweep's run folder, why the run failed


def conf_dir() -> Path:
    """The config files: inside the package in a wheel, beside it in a checkout."""
    inside = PACKAGE / "conf"
    return inside if inside.is_dir() else PACKAGE.parent / "conf"


def instantiate(node: DictConfig, **kwargs):
    """``hydra.utils.instantiate`` with ``kwargs`` handed over as they are, and constructors' errors as themselves."""
    try:
        # A partial, since Hydra would turn dataclasses among the arguments into configs.
        make = hydra.utils.instantiate(node, _partial_=True, _convert_="all")
        _refuse_unknown_arguments(node, make, kwargs)
        return make(**kwargs)
    except TypeError as error:
        raise ValueError(f"{node.get('_target_')}: {error}.") from error
    except InstantiationException as error:
        if isinstance(error.__cause__, (ValueError, OSError)):
            raise error.__cause__ from None
        if error.__cause__ is None:
            raise
        what = str(error).splitlines()[0].partition(", set env var")[0].rstrip(":")
        raise ValueError(f"{what}: {error.__cause__}.") from error


def _refuse_unknown_arguments(node: DictConfig, make: partial, given: dict) -> None:
    """Refuse keys of a node that what is made from it does not take, as :func:`refuse_unknown_keys` does elsewhere."""
    try:
        taken = inspect.signature(make.func).parameters
    except (AttributeError, TypeError, ValueError):  # nothing of Python's own making
        return
    if any(parameter.kind == parameter.VAR_KEYWORD for parameter in taken.values()):
        return
    if unknown := [key for key in make.keywords if key not in taken]:
        prefix = f"{node._get_full_key(None)}." if node._get_full_key(None) else ""
        theirs = OmegaConf.create({key: None for key in taken if key not in given})
        raise ValueError(_unknown_key(prefix + unknown[0], theirs, prefix))


def missing_extra(group: str, extra: str) -> ValueError:
    """The error of a choice in a config group whose optional extra is not installed."""
    return ValueError(f"{group}={extra}: {extra} is missing; pip install 'pickplace[{extra}]'.")


def use_machine(cfg: DictConfig) -> "torch.device":
    """Set the number of threads, and return the device, of a config.

    Raises:
        ValueError: for a device that this machine lacks, or a bad number of threads.
    """
    import torch  # here, so that --help need not wait for it

    if cfg.threads is not None:
        if not isinstance(cfg.threads, int) or isinstance(cfg.threads, bool) or not 1 <= cfg.threads <= 1024:
            raise ValueError(f"threads={cfg.threads}: expected a whole number >= 1 and <= 1024, or null.")
        torch.set_num_threads(cfg.threads)
    return usable_device(cfg.device)


def usable_device(name: str) -> "torch.device":
    """The device of that name.

    Raises:
        ValueError: if this machine lacks it.
    """
    import torch

    try:
        device = torch.device(name)
        torch.empty(0, device=device)
        usable = device.type in ("cpu", "cuda")
    except (RuntimeError, TypeError, AssertionError):
        usable = False
    if not usable:
        raise ValueError(f"device={name}: expected cpu, or cuda on a machine that has it.")
    return device


def apply_overrides(saved: DictConfig, overrides: list[str], groups: dict[str, DictConfig] | None = None) -> DictConfig:
    """A saved config with command-line overrides on top.

    Args:
        saved: the config of a checkpoint.
        overrides: as on Hydra's command line, ``key=value``; a leading ``+`` changes nothing.
        groups: for a config group that may be exchanged as a whole, its composed node.

    Raises:
        ValueError: for a group that cannot be exchanged, a key that the config does not have, or a bad value.
    """
    cfg = saved.copy()
    OmegaConf.set_struct(cfg, True)
    for override in OverridesParser.create().parse_overrides(overrides):
        key, line = override.key_or_group, override.input_line
        if groups and key in groups:
            cfg[key] = groups[key]
        elif "/" in key or isinstance(OmegaConf.select(cfg, key), DictConfig):
            raise ValueError(
                f"{line!r}: the checkpoint's config group {key!r} cannot be exchanged; expected overrides of its "
                f"values, such as {key.replace('/', '.')}.<key>=<value>."
            )
        elif override.is_delete() or override.is_sweep_override():
            raise ValueError(f"{line!r}: expected <key>=<value> with one value, on top of the checkpoint's config.")
        else:
            try:
                OmegaConf.update(cfg, key, override.value())
            except OmegaConfBaseException as error:
                raise ValueError(_unknown_key(key, cfg)) from error
    return cfg


def begun_with(run_dir: Path) -> list[str]:
    """The overrides of the command that began a run, as Hydra noted them; empty where it did not."""
    words = _noted(run_dir, "overrides.yaml")
    return [word for word in words if isinstance(word, str)] if isinstance(words, list) else []


def own_configs(run_dir: Path) -> list[str]:
    """The words of the command that began a run which say where its config files were found, as Hydra noted them."""
    notes = _noted(run_dir, "hydra.yaml")
    try:
        sources = notes["hydra"]["runtime"]["config_sources"]
        folders = [source["path"] for source in sources if source["provider"] == "command-line"]
        said = [word for word in notes["hydra"]["overrides"]["hydra"] if "hydra.searchpath" in word]
    except (KeyError, TypeError):
        return []
    return [*(word for folder in folders for word in ("--config-dir", folder)), *said]


def changed_since(run_dir: Path, cfg: DictConfig) -> list[str]:
    """The values, ``key=value``, in which a config is no longer that with which its run began."""
    began = _noted(run_dir, "config.yaml")
    if not isinstance(began, dict):
        return []

    def values(node, path: str = "") -> dict:
        if not isinstance(node, dict):
            return {path.removeprefix("."): node}
        return {key: value for name in node for key, value in values(node[name], f"{path}.{name}").items()}

    try:
        before, now = (values(OmegaConf.to_container(OmegaConf.create(c), resolve=True)) for c in (began, cfg))
    except OmegaConfBaseException:  # a reference that leads nowhere any more
        return []
    return [f"{key}={value}" for key, value in now.items() if value != before.get(key)]


def _noted(run_dir: Path, name: str):
    path = Path(run_dir) / ".hydra" / name
    return yaml.safe_load(path.read_text()) if path.is_file() else None


def refuse_unknown_keys(cfg: DictConfig, known: DictConfig, path: str = "") -> None:
    """Refuse keys that nothing reads: Hydra adds what it finds in a preset, or after a ``+``, misspelt or not.

    Nodes with a ``_target_`` are left alone: what is made from them knows its own arguments.

    Raises:
        ValueError: naming the key, and the ones that there are.
    """
    for key, node in cfg.items():
        name = path + str(key)
        if key not in known:
            raise ValueError(_unknown_key(name, known, path))
        if OmegaConf.is_dict(node) and OmegaConf.is_dict(known[key]) and "_target_" not in node:
            refuse_unknown_keys(node, known[key], f"{name}.")


def _unknown_key(key: str, cfg: DictConfig, prefix: str = "") -> str:
    """A sentence on a key that is not in the config, with what is; ``cfg`` is the node at ``prefix``."""
    at, node = prefix, cfg
    *parents, leaf = key.removeprefix(prefix).split(".")
    for parent in parents:
        child = node.get(parent) if parent in node else None
        if not isinstance(child, DictConfig):
            leaf = parent
            break
        at, node = f"{at}{parent}.", child
    known = [str(name) for name in node if name not in ("_target_", "hydra")]
    close = get_close_matches(leaf, known, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(known) or 'none'}."
    return f"{key}: there is no key {leaf!r} in {at[:-1] or 'the config'}; {hint}"


def sentence(error: Exception) -> str:
    """What went wrong, in one line for a person, without characters that a terminal would obey."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in _sentence(error))


def _sentence(error: Exception) -> str:
    if isinstance(error, OverrideParseException):
        reasons = [line for line in error.message.splitlines() if not line.startswith(("Error parsing", "See https"))]
        return f"{error.override!r}: expected <key>=<value> ({' '.join(reasons)})."
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        for start, extra in EXTRAS.items():
            if error.missing_cfg_file.startswith(start):
                return f"{error.missing_cfg_file}: {extra} is missing; pip install 'pickplace[{extra}]'."
    if isinstance(error, MissingConfigException) and error.options:
        return f"{error.missing_cfg_file}: there is no such config; expected one of {', '.join(error.options)}."
    if isinstance(error, OSError) and error.filename and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{error.filename}: {error.strerror}; expected a place where you may read and write."
    if isinstance(error, EXPECTED):
        noise = ("full_key", "object_type", "See https", "To append", "Config search path", "provider=")
        lines = [line.strip() for line in str(error).splitlines()]
        return " ".join(line for line in lines if line and not line.startswith(noise)) or type(error).__name__
    return f"{type(error).__name__}: {' '.join(str(error).split())} (HYDRA_FULL_ERROR=1 shows where)"


#: Config files that come with an optional extra.
EXTRAS = {"hydra/sweeper/optuna": "optuna", "hydra/launcher/joblib": "joblib", "hydra/launcher/submitit": "submitit"}


class JobFailed(Exception):
    """A run of a sweep that failed; the message is one sentence. It crosses processes, as the error itself may not."""


class WorkerDied(Exception):
    """A collector worker process is gone. Not an OSError: much code around signals takes those for its own."""


#: What users or their machines cause; anything else may be a fault of the program, and its kind is told too.
EXPECTED = (ValueError, OSError, FloatingPointError, JobFailed, WorkerDied, HydraException, OmegaConfBaseException)


@contextmanager
def one_sentence():
    """An error ends the command in one sentence and exit code 2; with ``HYDRA_FULL_ERROR=1`` in its traceback."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # who reads the output, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except Exception as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        sys.stderr.write(f"error: {sentence(error)}\n")
        sys.exit(2)


class Occupied(ValueError):
    """A run folder that holds a training already."""


def refuse_occupied(run_dir: Path) -> None:
    """Refuse a folder for a new run in which a training has left a checkpoint: two runs would be mixed.

    Raises:
        Occupied: naming the folder.
    """
    saved = run_dir / "checkpoints"
    if saved.is_dir() and any(not entry.name.endswith(".new") for entry in saved.iterdir()):
        raise Occupied(OCCUPIED.format(run_dir))


class Refused(BaseException):
    """Why a run is refused before it begins; Hydra would only warn of an error in a callback."""


class FreshFolder(Callback):
    """Refuses a run folder that another training is in, before Hydra overwrites the notes on that training."""

    def on_run_start(self, config: DictConfig, **kwargs) -> None:
        before = HydraConfig.instance().cfg
        try:
            HydraConfig.instance().set_config(config)  # for references such as ${hydra:job.name}
            folder = Path(config.hydra.run.dir)
        finally:
            HydraConfig.instance().cfg = before
        try:
            if claimed(folder):
                raise ValueError(TAKEN.format(folder))
            refuse_occupied(folder)
        except ValueError as error:
            raise Refused(str(error)) from None


class SweepCallback(Callback):
    """Lets :func:`command` know the folder of a sweep whose jobs cannot even be composed; the end of a sweep is told to
    it even where Hydra does not, since a job failed or was stopped."""

    def on_multirun_start(self, config: DictConfig, **kwargs) -> None:
        HydraConfig.instance().set_config(config)


def command(config_name: str, task, from_checkpoint: tuple[str, ...] = ()) -> None:
    """Run ``task(cfg, run_dir)`` as a Hydra application; what a user did wrong ends in one sentence and exit code 2.

    A run folder in which nothing was written is taken away again.

    Args:
        config_name: the file in ``conf/``.
        task: what to do.
        from_checkpoint: groups whose keys a checkpoint brings; overrides of them reach ``task`` as they are.
    """
    full_error = os.environ.get("HYDRA_FULL_ERROR", "")
    overrides = sys.argv[1:]
    opened = tuple(f"{group}." for group in from_checkpoint)
    sys.argv[1:] = [f"++{word}" if word.startswith(opened) else word for word in overrides]

    def app(cfg: DictConfig):
        hydra_cfg = HydraConfig.get()
        os.environ["HYDRA_FULL_ERROR"] = full_error
        with _job() if hydra_cfg.mode == RunMode.MULTIRUN else _run():
            if missing := OmegaConf.missing_keys(cfg):
                raise ValueError(f"{min(missing)}: no value; expected {min(missing)}=<value>.")
            known = hydra.compose(hydra_cfg.job.config_name)
            own = [str(key) for key in cfg if key not in from_checkpoint]
            refuse_unknown_keys(OmegaConf.masked_copy(cfg, own), known)
            return task(cfg, Path(hydra_cfg.runtime.output_dir))

    app.__module__, app.__qualname__ = "__main__", "app"
    HydraConfig.instance().cfg = None
    with one_sentence():
        # Hydra raises what it would print over many lines.
        os.environ["HYDRA_FULL_ERROR"] = "1"
        try:
            with _sweep_end(), _tidy():
                hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config_name)(app)()
        except Refused as error:
            raise ValueError(str(error)) from None
        except ConfigCompositionException as error:
            if not (key := re.match("Could not override '(.*)'", str(error))):
                raise
            raise ValueError(_unknown_key(key[1], _composed_without(key[1], config_name, overrides))) from error
        except ValueError as error:  # Hydra's own, which does not say where
            if isinstance(error.__cause__, OSError):  # such as a log file that cannot be opened
                raise error.__cause__ from None
            for word in overrides:  # a group without a choice, which experiment may do
                group, _, choice = word.lstrip("+").partition("=")
                if choice in ("null", "") and group != "experiment" and (conf_dir() / group).is_dir():
                    names = sorted(file.stem for file in (conf_dir() / group).glob("*.yaml"))
                    raise ValueError(f"{word}: expected {group}=<one of {', '.join(names)}>.") from error
            raise ValueError(f"{' '.join(overrides)}: {error}.") from error
        finally:
            os.environ["HYDRA_FULL_ERROR"] = full_error


def _composed_without(key: str, config_name: str, overrides: list[str]) -> DictConfig:
    """The config without the overrides of a key, or without any if others are wrong too."""
    rest = [word for word in overrides if not word.startswith("-") and word.partition("=")[0] != key]
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        try:
            return hydra.compose(config_name, rest)
        except (HydraException, OmegaConfBaseException, ValueError):
            return hydra.compose(config_name)


@contextmanager
def _job():
    """What goes wrong in a run of a sweep is noted in its folder, and leaves the other runs alone."""
    try:
        yield
    except Exception as error:
        folder = Path(HydraConfig.get().runtime.output_dir)
        if not isinstance(error, Occupied):  # what is there has not failed
            with suppress(OSError):  # the disk may be what is wrong
                (folder / FAILURE).write_text(f"{sentence(error)}\n")
        log.error("run %s failed: %s", folder.name, sentence(error))
        raise JobFailed(f"run {folder.name}: {sentence(error)}") from error
    finally:
        os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra goes on in this process


@contextmanager
def _run():
    """What goes wrong in a run that is no part of a sweep."""
    with one_sentence(), _tidy():
        yield


@contextmanager
def _sweep_end():
    """Tell the callbacks that a sweep has ended where Hydra does not: when a job failed or was stopped."""
    try:
        yield
    except BaseException:
        cfg = HydraConfig.get() if HydraConfig.initialized() else None
        if cfg and cfg.mode == RunMode.MULTIRUN and os.path.isdir(cfg.sweep.dir):
            for callback in cfg.callbacks.values():
                try:
                    hydra.utils.instantiate(callback).on_multirun_end(HydraConfig.instance().cfg)
                except Exception as error:  # what ended the sweep matters more
                    log.error(sentence(error))
        raise


def claimed(folder: str | Path) -> bool:
    """Does another process train in a run folder?"""
    from filelock import FileLock, Timeout

    path = Path(folder) / LOCK
    try:
        with FileLock(path, timeout=0) if path.exists() else nullcontext():
            return False
    except Timeout:
        return True


@contextmanager
def _tidy():
    """Take away the folders of a run or sweep that failed, if nothing but Hydra's own notes is in them."""
    try:
        yield
    except BaseException:
        if HydraConfig.initialized():
            cfg = HydraConfig.get()
            run_dir = None if OmegaConf.is_missing(cfg.runtime, "output_dir") else cfg.runtime.output_dir
            notes = {".hydra", LOCK, FAILURE, f"{cfg.job.name}.log"}
            logging.shutdown()

            def nothing(folder: str) -> bool:
                return os.path.isdir(folder) and set(os.listdir(folder)) <= notes and not claimed(folder)

            if run_dir and nothing(run_dir):
                shutil.rmtree(run_dir, ignore_errors=True)
            if cfg.mode == RunMode.MULTIRUN and os.path.isdir(cfg.sweep.dir):
                names = set(os.listdir(cfg.sweep.dir)) - {"multirun.yaml"}
                if all(nothing(os.path.join(cfg.sweep.dir, name)) for name in names):
                    shutil.rmtree(cfg.sweep.dir, ignore_errors=True)
        raise
