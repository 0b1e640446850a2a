"""The words of a command line, and the options that they may choose."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf


def conf_dir() -> Path:
    """Return the folder of the config files: inside the package in a wheel, beside it in a checkout."""
    package, checkout = Path(__file__).resolve().parents[1:3]
    return package / "conf" if (package / "conf").is_dir() else checkout / "conf"


def config_files():
    """Return a context in which :func:`hydra.compose` reads the files of ``conf/``."""
    return hydra.initialize_config_dir(str(conf_dir()), version_base="1.3")


def parse(words: Iterable[str]) -> list[Override]:
    """Parse words of a command line into overrides; a ``ValueError`` names a word that is not an override."""
    words = list(words)
    try:
        return OverridesParser.create().parse_overrides(words)
    except (ValueError, TypeError) as error:  # such as a number of too many digits
        raise ValueError(f"{' '.join(words)}: {error}.") from error
    except OverrideParseException as error:
        reasons = [line for line in error.message.splitlines() if not line.startswith(("Error parsing", "See https"))]
        raise ValueError(f"{error.override!r}: expected <key>=<value> ({' '.join(reasons)}).") from error


def group_options(group: str, search: Iterable[str] = ()) -> list[str]:
    """Return the names of a group's options, with those in folders that overrides add to the search path."""
    return GlobalHydra.instance().config_loader().get_group_options(group, overrides=list(search))


def search_words(words: Iterable[str]) -> list[str]:
    """Return the words of a command line that set the folders with config files."""
    return [word for word in words if word.lstrip("+").startswith("hydra.searchpath=")]


def task_overrides(hydra_cfg: Any = None) -> list[str]:
    """Return the words of the command line, with references unresolved: here they would lead elsewhere."""
    return cast(list, OmegaConf.to_container((hydra_cfg or HydraConfig.get()).overrides.task, resolve=False))


def line_of(override: Override, prefix: str = "") -> str:
    """Return an override as a word of the command line; a prefix replaces its own."""
    line = str(override.input_line)
    return f"{prefix}{line.lstrip('+')}" if prefix else line


def part_at(cfg: DictConfig, place: str) -> Any:
    """Return the value at a place of a config, or None; a node as a dict or list, with references unresolved."""
    part = OmegaConf.select(cfg, place)
    return OmegaConf.to_container(part, resolve=False) if OmegaConf.is_config(part) else part


def package_of(group: str, options: list[str]) -> str:
    """Return the package of a group's options, which is the same for all, such as ``env`` for ``gripper``."""
    sources, paths = GlobalHydra.instance().config_loader().get_sources(), [f"{group}/{name}" for name in options]
    files = (source.load_config(path) for path in paths for source in sources if source.is_config(path))
    return next((file.header for file in files), {}).get("package") or group.replace("/", ".")
