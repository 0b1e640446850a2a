"""Hydra around the commands: where the config files are, overrides on saved configs, and errors in one sentence."""

import importlib
import logging
import os
import shutil
import sys
from difflib import get_close_matches
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

log = logging.getLogger(__name__)

PACKAGE = Path(__file__).resolve().parent


def conf_dir() -> Path:
    """The config files: inside the package in a wheel, beside it in a checkout."""
    inside = PACKAGE / "conf"
    return inside if inside.is_dir() else PACKAGE.parent / "conf"


def instantiate(node: DictConfig, **kwargs):
    """``hydra.utils.instantiate`` with ``kwargs`` handed over as they are, and constructors' errors as themselves."""
    try:
        # A partial, since Hydra would turn dataclasses among the arguments into configs.
        return hydra.utils.instantiate(node, _partial_=True, _convert_="all")(**kwargs)
    except TypeError as error:
        raise ValueError(f"{node.get('_target_')}: {error}.") from error
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, (TypeError, ImportError)):
            raise ValueError(f"{error.args[0] if error.args else ''} {cause}".strip()) from error
        raise cause from None


def use_machine(cfg: DictConfig) -> torch.device:
    """Set the number of threads, and return the device, of a config.

    Raises:
        ValueError: for a device that this machine lacks, or a bad number of threads.
    """
    if cfg.threads is not None:
        if not isinstance(cfg.threads, int) or isinstance(cfg.threads, bool) or cfg.threads < 1:
            raise ValueError(f"threads={cfg.threads}: expected a whole number >= 1, or null.")
        torch.set_num_threads(cfg.threads)
    try:
        device = torch.device(cfg.device)
        torch.empty(0, device=device)
    except (RuntimeError, TypeError, AssertionError) as error:
        raise ValueError(f"device={cfg.device}: expected cpu, or cuda on a machine that has it.") from error
    return device


def refuse_foreign_targets(node, path: str = "config") -> None:
    """Refuse a config that would make anything but pickplace's own objects; a checkpoint's config is not trusted.

    Raises:
        ValueError: naming the ``_target_``.
    """
    if isinstance(node, dict):
        target = node.get("_target_")
        if target is not None and not _is_ours(target):
            raise ValueError(f"{path}._target_={target!r}: expected a class or function defined in pickplace.")
        for key, value in node.items():
            refuse_foreign_targets(value, f"{path}.{key}")
    elif isinstance(node, list):
        for index, value in enumerate(node):
            refuse_foreign_targets(value, f"{path}[{index}]")


def _is_ours(target) -> bool:
    module, _, name = str(target).rpartition(".")
    if module.split(".")[0] != "pickplace":
        return False
    try:  # of what is importable below pickplace, only what was defined there: not `os` as some module of ours sees it
        found = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return False
    return getattr(found, "__module__", "").split(".")[0] == "pickplace"


def apply_overrides(saved: DictConfig, overrides: list[str], groups: dict[str, DictConfig] | None = None) -> DictConfig:
    """A saved config with command-line overrides on top.

    Args:
        saved: the config of a checkpoint.
        overrides: as on Hydra's command line, ``key=value``, ``+key=value``, ``~key``.
        groups: for a config group that may be exchanged as a whole, its composed node.

    Raises:
        ValueError: for a group that cannot be exchanged, a key that the config does not have, or a bad value.
    """
    cfg = saved.copy()
    OmegaConf.set_struct(cfg, True)
    for override in OverridesParser.create().parse_overrides(overrides):
        key = override.key_or_group
        if groups and key in groups:
            cfg[key] = groups[key]
        elif "/" in key or isinstance(OmegaConf.select(cfg, key), DictConfig):
            raise ValueError(
                f"{override.input_line!r}: the checkpoint's config group {key!r} cannot be exchanged; expected "
                f"overrides of its values, such as {key.replace('/', '.')}.<key>=<value>."
            )
        elif override.is_delete():
            raise ValueError(f"{override.input_line!r}: a key of the checkpoint's config cannot be deleted.")
        else:
            try:
                OmegaConf.update(cfg, key, override.value(), force_add=override.is_add())
            except OmegaConfBaseException as error:
                raise ValueError(_unknown_key(key, cfg)) from error
    return cfg


def _unknown_key(key: str, cfg: DictConfig) -> str:
    """A sentence on a key that is not in the config, with what is."""
    parent, _, leaf = key.rpartition(".")
    node = OmegaConf.select(cfg, parent) if parent else cfg
    while not isinstance(node, DictConfig):
        parent, _, leaf = parent.rpartition(".")
        node = OmegaConf.select(cfg, parent) if parent else cfg
    known = [str(name) for name in node if name != "_target_" and name != "hydra"]
    close = get_close_matches(leaf, known, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(known)}."
    return f"{key}: there is no key {leaf!r} in {parent or 'the config'}; {hint}"


def sentence(error: BaseException, cfg: DictConfig | None = None) -> str:
    """What went wrong, in one line for a person."""
    text = str(error).strip()
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        if lines and lines[0].startswith("Could not override '") and cfg is not None:
            return _unknown_key(lines[0].split("'")[1], cfg)
        lines = [line for line in lines if not line.startswith(("full_key", "object_type", "See https", "To append"))]
        return " ".join(lines)
    return " ".join(text.split()) or type(error).__name__


def fail(error: BaseException, cfg: DictConfig | None = None):
    """Print one sentence and exit with code 2; with ``HYDRA_FULL_ERROR=1`` raise the error itself."""
    if os.environ.get("HYDRA_FULL_ERROR") == "1":
        raise error
    sys.stderr.write(f"error: {sentence(error, cfg)}\n")
    sys.exit(2)


def _check_composition(config_name: str) -> None:
    """Compose once before Hydra does, so that a mistyped override ends in one sentence."""
    argv = sys.argv[1:]
    overrides = [arg for arg in argv if not arg.startswith("-")]
    if len(overrides) < len(argv):  # flags such as --help, --config-dir or -m: Hydra itself deals with them
        return
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        try:
            hydra.compose(config_name, overrides)
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            fail(error, hydra.compose(config_name))


def command(config_name: str, task) -> None:
    """Run ``task(cfg, run_dir)`` as a Hydra application; what a user did wrong ends in one sentence and exit code 2.

    A run folder that was made for a run that never began is taken away again.
    """
    _check_composition(config_name)

    def app(cfg: DictConfig):
        run_dir = Path(HydraConfig.get().runtime.output_dir)
        try:
            return task(cfg, run_dir)
        except Exception as error:  # HYDRA_FULL_ERROR=1 shows where it came from
            begun = run_dir.is_dir() and any(entry.is_dir() and entry.name != ".hydra" for entry in run_dir.iterdir())
            if not begun and (run_dir / ".hydra").is_dir():
                logging.shutdown()
                shutil.rmtree(run_dir, ignore_errors=True)
            fail(error)

    app.__module__, app.__qualname__ = "__main__", "app"
    hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config_name)(app)()
