"""The config that a command line makes, beyond Hydra's merge: values of replaced options, hints, names of folders."""

import argparse
import hashlib
import re
from collections.abc import Iterable
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

#: Config groups whose options set parts of the group ``env`` (``# @package env``), and their plainest options.
PARTS_OF_ENV = {"effector": "paper", "support": "bearing", "reach": "everywhere"}

#: Groups whose options have plain settings in common, such as ``algo.lr``: what a preset says of these stays.
SHARED = ("algo", "model")

LONGEST_NAME = 150  # letters of the name of a run folder; file systems allow 255 bytes


def conf_dir() -> Path:
    """Return the folder of the config files: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def drop_replaced_values(cfg: DictConfig) -> DictConfig:
    """Return the config of this run, in which an option chosen on the command line has no values of another one.

    Hydra merges what a preset, or a config file of the user, wrote for the option that it expected, such as
    ``curriculum.advance.occupancy`` for ``threshold``, into the option that the command line chose instead. A group of
    parts with a ``_target_`` gets the values of the chosen option's own files, and the values on the command line, if
    without that choice it had another option. ``env`` is exempt: its options differ in sizes only, and a preset's sizes
    belong to the experiment. So do the plain settings that the options of :data:`SHARED` have in common. Hydra's note
    on the config is corrected.
    """
    given = OverridesParser.create().parse_overrides(task_overrides(HydraConfig.get()))
    name = HydraConfig.get().job.config_name
    search = [word for word in HydraConfig.get().overrides.hydra if word.startswith("hydra.searchpath")]
    choices = [override for override in given if _is_choice(override)]
    replaced = False
    for choice in sorted(choices, key=lambda choice: _package(choice).count(".")):  # an outer part before its own parts
        place = _package(choice)
        if choice.is_delete() or place == "env" or OmegaConf.select(cfg, place) is None:
            continue
        inner = [str(other.input_line) for other in choices if f"{_package(other)}.".startswith(f"{place}.")]
        others = [str(other.input_line) for other in choices if other.input_line not in inner]
        inner.remove(str(choice.input_line))
        try:
            own = _part_at(hydra.compose(None, [*search, f"+{str(choice.input_line).lstrip('+')}", *inner]), place)
            if own == _part_at(cfg, place):
                continue
            before = hydra.compose(name, [*search, *others], return_hydra_config=True)
        except ConfigCompositionException:  # an option that depends on those of other groups
            continue
        options = {_package(key): option for key, option in before.hydra.runtime.choices.items()}
        has_parts = _has_parts(own) or _has_parts(_part_at(before, place))
        if has_parts and str(options.get(place)) != str(choice.value()):
            cfg = cfg if replaced else cfg.copy()
            if place in SHARED:
                own |= _shared_values(_part_at(cfg, place), own)
            OmegaConf.update(cfg, place, own, merge=False, force_add=True)
            replaced = True
    if replaced:
        for value in given:
            if value not in choices:
                _apply(value, cfg)
        runtime, notes = HydraConfig.get().runtime, HydraConfig.get().output_subdir
        if notes is not None and not OmegaConf.is_missing(runtime, "output_dir"):  # which --cfg has none of
            OmegaConf.save(cfg, Path(runtime.output_dir) / notes / "config.yaml")
    return cfg


def _shared_values(merged: dict, own: dict) -> dict:
    """Return the values of a merged part, other than parts and their names, whose keys an option has, too."""
    keys = [key for key in own if key in merged and key != "_target_"]
    return {key: merged[key] for key in keys if not isinstance(own[key], dict) and not isinstance(merged[key], dict)}


def task_overrides(hydra_cfg: Any) -> list[str]:
    """Return the words of the command line; references in them stay, which lead elsewhere from there."""
    words: Any = OmegaConf.to_container(hydra_cfg.overrides.task, resolve=False)
    return list(words)


def _is_choice(override: Override) -> bool:
    """Return whether an override chooses the option of a group, rather than a value."""
    is_group = override.package or override.key_or_group in HydraConfig.get().runtime.choices
    return bool(is_group or "/" in override.key_or_group) and not isinstance(override.value(), dict)


def _package(choice: Override | str) -> str:
    """Return the place in the config of the group that an override chooses, or of a ``group`` or ``group@package``."""
    group, _, package = choice.partition("@") if isinstance(choice, str) else (choice.key_or_group, "", choice.package)
    return package or ("env." if group in PARTS_OF_ENV else "") + group.replace("/", ".")


def keys_set_in_env(choice: str) -> list[str]:
    """Return the keys of ``env`` that an option of :data:`PARTS_OF_ENV` sets, such as ``reach`` for ``reach=annulus``.

    The search path is that of the running command.

    Raises:
        ValueError: for one that is removed (``~reach``): nothing says what would be there instead.
    """
    if choice.startswith("~"):
        group = choice[1:].partition("=")[0]
        raise ValueError(
            f"{choice}: the checkpoint's {group} can be exchanged, not removed; expected {group}={PARTS_OF_ENV[group]} "
            "or another option."
        )
    search = [word for word in HydraConfig.get().overrides.hydra if word.startswith("hydra.searchpath")]
    return [str(key) for key in hydra.compose(None, [*search, f"+{choice.lstrip('+')}"]).env]


def _part_at(cfg: DictConfig, place: str) -> Any:
    """Return the part of a config at a place, unresolved; None if there is none."""
    part: Any = OmegaConf.to_container(cfg, resolve=False)
    for key in place.split("."):
        part = part.get(key) if isinstance(part, dict) else None
    return part


def _has_parts(node: Any) -> bool:
    """Return whether a part of a config has a ``_target_``, itself or in its own parts."""
    return isinstance(node, dict) and ("_target_" in node or any(map(_has_parts, node.values())))


def _apply(value: Override, cfg: DictConfig) -> None:
    """Apply the override of a value; a key that is not there is added, and refused later by its reader."""
    parent, _, key = value.key_or_group.rpartition(".")
    if not value.is_delete():
        OmegaConf.update(cfg, value.key_or_group, value.value(), merge=True, force_add=True)
    elif OmegaConf.is_dict(node := OmegaConf.select(cfg, parent) if parent else cfg):
        with open_dict(node):
            node.pop(key, None)


def compose_plain(config_name: str, overrides: Iterable[str] = ()) -> DictConfig:
    """Return the config of a file in ``conf/`` as Hydra merges it, outside a Hydra application too."""
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return hydra.compose(config_name, list(overrides))


def compose_for_hint(config_name: str, words: list[str], without: str) -> DictConfig:
    """Return the config of a command line without the overrides of a key, or without any if others are wrong too.

    Args:
        config_name: the file in ``conf/``.
        words: the command line.
        without: the key.
    """
    search, rest = _search_path(words)
    rest = [word for word in rest if word.lstrip("+~").partition("=")[0] != without]
    try:
        return compose_plain(config_name, [*search, *map(_first_of_sweep, rest)])
    except (HydraException, OmegaConfBaseException, ValueError):
        return compose_plain(config_name, search)


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
    return folder_name(task_overrides(cfg), list(cfg.job.config.override_dirname.exclude_keys))


OmegaConf.register_new_resolver("run_name", _run_name, replace=True)
