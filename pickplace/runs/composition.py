"""The config that a command line makes, beyond Hydra's merge: values of replaced options, hints, names of folders."""

import argparse
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import ConfigCompositionException, HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

LONGEST_NAME = 150  # letters of the name of a run folder; file systems allow 255 bytes


def conf_dir() -> Path:
    """Return the folder of the config files: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def drop_replaced_values(cfg: DictConfig) -> DictConfig:
    """Return the config of this run, in which an option chosen on the command line has no values of another one.

    Hydra merges what a preset, or a config file of the user, wrote for the option that it expected, such as
    ``curriculum.advance.occupancy`` for ``threshold``, into the option that the command line chose instead. A part
    whose ``_target_`` a choice on the command line changes gets the values of that option's own files, and the values
    on the command line. So does a group of which the choice turns a part on or off (``warm_start.teacher``). Hydra's
    note on the config is corrected.
    """
    given = OverridesParser.create().parse_overrides(list(HydraConfig.get().overrides.task))
    name = HydraConfig.get().job.config_name
    search = [word for word in HydraConfig.get().overrides.hydra if word.startswith("hydra.searchpath")]
    choices = [override for override in given if _is_choice(override)]
    replaced: list[str] = []
    for choice in sorted(choices, key=lambda choice: _package(choice).count(".")):  # an outer part before its own parts
        place = _package(choice)
        if choice.is_delete() or not OmegaConf.is_dict(OmegaConf.select(cfg, place)):  # such as experiment=
            continue
        inner = [str(other.input_line) for other in choices if f"{_package(other)}.".startswith(f"{place}.")]
        others = [str(other.input_line) for other in choices if other.input_line not in inner]
        inner.remove(str(choice.input_line))
        try:
            own = _part_at(hydra.compose(None, [*search, f"+{str(choice.input_line).lstrip('+')}", *inner]), place)
            if own == _part_at(cfg, place):
                continue
            before = _part_at(hydra.compose(name, [*search, *others]), place)
        except ConfigCompositionException:  # an option that depends on those of other groups
            continue
        inner_places = {_package(other) for other in choices if other.input_line in inner}
        for leaf, content in _exchanged_leaves(place, own, before):
            if leaf not in inner_places:
                cfg = cfg if replaced else cfg.copy()
                OmegaConf.update(cfg, leaf, content, merge=False, force_add=True)
                replaced.append(leaf)
    if replaced:
        for value in given:
            if value not in choices:
                _apply(value, cfg)
        if (notes := HydraConfig.get().output_subdir) is not None:
            OmegaConf.save(cfg, Path(HydraConfig.get().runtime.output_dir) / notes / "config.yaml")
    return cfg


def _is_choice(override: Override) -> bool:
    """Return whether an override chooses the option of a group, rather than a value."""
    is_group = override.package or override.key_or_group in HydraConfig.get().runtime.choices
    return bool(is_group or "/" in override.key_or_group) and not isinstance(override.value(), dict)


def _package(choice: Override) -> str:
    """Return the place in the config of the group that an override chooses."""
    return choice.package or choice.key_or_group.replace("/", ".")


def _part_at(cfg: DictConfig, place: str) -> Any:
    """Return the part of a config at a place, unresolved; None if there is none."""
    part: Any = OmegaConf.to_container(cfg, resolve=False)
    for key in place.split("."):
        part = part.get(key) if isinstance(part, dict) else None
    return part


def _exchanged_leaves(place: str, own: Any, before: Any) -> Iterator[tuple[str, dict]]:
    """Yield place and content of each part that is another one than before."""
    if not isinstance(own, dict):
        return
    before = before if isinstance(before, dict) else {}

    def parts(cfg: dict) -> set:
        """Return the keys of the parts in a group."""
        return {key for key, node in cfg.items() if isinstance(node, dict) and "_target_" in node}

    if own.get("_target_") != before.get("_target_") or parts(own) != parts(before):
        yield place, own
    else:
        for key, node in own.items():
            yield from _exchanged_leaves(f"{place}.{key}", node, before.get(key))


def _apply(value: Override, cfg: DictConfig) -> None:
    """Apply the override of a value; a key that is not there is added, and refused later by its reader."""
    parent, _, key = value.key_or_group.rpartition(".")
    if not value.is_delete():
        OmegaConf.update(cfg, value.key_or_group, value.value(), merge=True, force_add=True)
    elif OmegaConf.is_dict(node := OmegaConf.select(cfg, parent) if parent else cfg):
        with open_dict(node):
            node.pop(key, None)


def compose_for_hint(config_name: str, words: list[str], without: str) -> DictConfig:
    """Return the config of a command line without the overrides of a key, or without any if others are wrong too.

    Args:
        config_name: the file in ``conf/``.
        words: the command line.
        without: the key.
    """
    search, rest = _search_path(words)
    rest = [word for word in rest if word.lstrip("+~").partition("=")[0] != without]
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        try:
            return hydra.compose(config_name, [*search, *map(_first_of_sweep, rest)])
        except (HydraException, OmegaConfBaseException, ValueError):
            return hydra.compose(config_name, search)


def _first_of_sweep(word: str) -> str:
    """Return an override with the first of its values only."""
    override = OverridesParser.create().parse_override(word)
    if not override.is_sweep_override():
        return word
    return f"{override.get_key_element()}={next(iter(override.sweep_string_iterator()))}"


def list_options(group: str, config_name: str, words: list[str]) -> list[str]:
    """Return the options of a config group, those in the user's folders too; none if there is no such group."""
    search, _ = _search_path(words)
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        return sorted(loader.get_group_options(group, config_name=config_name, overrides=search))


def _search_path(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the user's folders of config files as an override, if there are any, and the other overrides."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd")
    known, rest = parser.parse_known_args(words)
    rest = [word for word in rest if not word.startswith("-")]
    paths: list = []
    for word in [word for word in rest if word.lstrip("+").startswith("hydra.searchpath=")]:
        rest.remove(word)
        value = OverridesParser.create().parse_override(word).value()
        paths += value if isinstance(value, list) else [value]
    if known.config_dir:
        paths.append(f"file://{Path(known.config_dir).absolute()}")
    quoted = ",".join(f"'{path}'" for path in paths)
    return [f"hydra.searchpath=[{quoted}]"] if paths else [], rest


def constant_keys(words: list[str]) -> list[str]:
    """Return the keys that have the same value in all runs of a sweep's command line, but for the seed."""
    given = OverridesParser.create().parse_overrides(words)
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
    return folder_name(list(cfg.overrides.task), list(cfg.job.config.override_dirname.exclude_keys))


OmegaConf.register_new_resolver("run_name", _run_name, replace=True)
