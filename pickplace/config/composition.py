"""The config that a command line makes, beyond Hydra's merge: values of replaced options, unknown keys, hints."""

import re
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import ConfigCompositionException, HydraException
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from pickplace.config.errors import unknown_key
from pickplace.config.registry import REGISTRY, names_at

#: Groups whose options have plain settings in common, such as ``algo.lr``: what a preset says of these stays.
SHARED = ("algo", "model")


def conf_dir() -> Path:
    """Return the folder of the config files: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def config_files():
    """Return a context in which :func:`hydra.compose` reads the files of ``conf/``."""
    return hydra.initialize_config_dir(str(conf_dir()), version_base="1.3")


def parse(words: Iterable[str]) -> list[Override]:
    """Return the overrides that are words of a command line."""
    return OverridesParser.create().parse_overrides(list(words))


def compose_plain(config_name: str) -> DictConfig:
    """Return the config of a file in ``conf/``, outside a Hydra application too."""
    with config_files():
        return hydra.compose(config_name)


# ---------------------------------------------------------------------- the command line
def merge_search_path(words: list[str], folders: Iterable[str]) -> list[str]:
    """Return words of a command line with all the user's folders of config files in one override, if there are any."""
    paths = [f"file://{Path(folder).absolute()}" for folder in folders]
    search = [word for word in words if word.lstrip("+").startswith("hydra.searchpath=")]
    for override in parse(search):
        value: Any = override.value()
        paths += value if isinstance(value, list) else [value]
    merged = [f"hydra.searchpath=[{','.join(map(quoted, paths))}]"] if paths else []
    return [*merged, *(word for word in words if word not in search)]


def quoted(value) -> str:
    """Return a text as a value of an override."""
    return "'{}'".format(str(value).replace("'", "\\'"))


def compose_first_job(config_name: str, words: list[str]) -> DictConfig:
    """Return Hydra's merge of a command line, ``hydra`` included; of a sweep, that of the first values.

    Raises:
        ValueError: naming the key, and what was expected.
    """
    try:
        first = [_first_of_sweep(word) for word in parse(words)]
        return hydra.compose(config_name, [word for word in first if word is not None], return_hydra_config=True)
    except ConfigCompositionException as error:
        raise clearer_error(error, config_name, words) from error
    except (ValueError, TypeError) as error:  # Hydra's own, which names no key
        for word in words:  # a group without an option, allowed for presets only
            group, _, option = word.lstrip("+").partition("=")
            if option in ("null", "") and (names := _options(group, config_name, _search_words(words))):
                raise ValueError(f"{word}: expected {group}=<one of {', '.join(sorted(names))}>.") from error
        raise ValueError(f"{' '.join(words)}: {error}.") from error


def _options(group: str, config_name: str, search: list[str]) -> list[str]:
    """Return the options of a config group, those in the user's folders too; none if there is no such group."""
    return GlobalHydra.instance().config_loader().get_group_options(group, config_name=config_name, overrides=search)


def _first_of_sweep(override: Override) -> str | None:
    """Return an override with the first of its values only; None if these cannot be listed."""
    if not override.is_sweep_override():
        return override.input_line
    values = iter(override.sweep_string_iterator() if override.is_discrete_sweep() else ())
    return next((f"{override.get_key_element()}={value}" for value in values if isinstance(value, str)), None)


def clearer_error(error: ConfigCompositionException, config_name: str, words: list[str]) -> Exception:
    """Return an error that names the key which Hydra could not override, and the keys that there are."""
    if not (key := re.match("Could not override '(.*)'", str(error))):
        return error
    search = _search_words(words)
    others = [word for word in words if word.lstrip("+~").partition("=")[0] != key[1] and word not in search]
    with nullcontext() if GlobalHydra().is_initialized() else config_files():
        try:
            known = hydra.compose(config_name, [*search, *filter(None, map(_first_of_sweep, parse(others)))])
        except (HydraException, OmegaConfBaseException, ValueError):  # others are wrong, too
            known = hydra.compose(config_name, search)
    return ValueError(unknown_key(key[1], known))


def _search_words(words: Iterable[str]) -> list[str]:
    return [word for word in words if word.lstrip("+").startswith("hydra.searchpath=")]


def without_hydra(cfg: DictConfig) -> DictConfig:
    """Return a copy of a config without the group ``hydra``."""
    cfg = cfg.copy()
    with read_write(cfg), open_dict(cfg):
        del cfg["hydra"]
    return cfg


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


# ---------------------------------------------------------------------- values of replaced options
def own_values(cfg: DictConfig) -> DictConfig:
    """Return the config of this run, in which an option chosen on the command line has no values of another one.

    Hydra merges what a preset, or a config file of the user, wrote for the option that it expected, such as
    ``curriculum.advance.occupancy`` for ``threshold``, into the option that the command line chose instead. A part with
    a ``_target_`` gets the values of the chosen option's own files, and the values on the command line, if without
    that choice it had another option. ``env`` is exempt: its options differ in sizes only, and a preset's sizes belong
    to the experiment. So do the plain settings that the options of :data:`SHARED` have in common.
    """
    running = HydraConfig.get()
    search, given = _search_words(running.overrides.hydra), parse(task_overrides(running))
    choices = [override for override in given if _is_choice(override)]
    pairs = [(place, choice) for choice in choices if not choice.is_delete() for place in _places(choice, search)]
    for place, choice in sorted(pairs, key=lambda pair: pair[0].count(".")):  # an outer part before its own parts
        if place == "env" or OmegaConf.select(cfg, place) is None:
            continue
        inside = [override for override in given if override is not choice and _is_inside(override, place, search)]
        others = [str(other.input_line) for other in choices if other is not choice and other not in inside]
        try:
            words = [f"+{str(choice.input_line).lstrip('+')}", *map(_added, inside)]
            own = _part_at(hydra.compose(None, [*search, *words]), place)
            if own == _part_at(cfg, place):
                continue
            before = hydra.compose(running.job.config_name, [*search, *others], return_hydra_config=True)
        except ConfigCompositionException:  # an option that depends on those of other groups
            continue
        has_parts = _has_parts(own) or _has_parts(_part_at(before, place))
        if has_parts and str(before.hydra.runtime.choices.get(_group(choice))) != str(choice.value()):
            cfg = cfg.copy()
            if place in SHARED:
                own |= _shared_values(_part_at(cfg, place), own)
            OmegaConf.update(cfg, place, own, merge=False, force_add=True)
    return cfg


def _shared_values(merged: dict, own: dict) -> dict:
    """Return the values of a merged part, other than parts and their names, whose keys an option has, too."""
    keys = [key for key in own if key in merged and key != "_target_"]
    return {key: merged[key] for key in keys if not isinstance(own[key], dict) and not isinstance(merged[key], dict)}


def correct_note(cfg: DictConfig, noted: DictConfig) -> None:
    """Write the config of this run over Hydra's note on its merge, if they differ."""
    notes = HydraConfig.get().output_subdir
    if notes is not None and cfg != noted:
        OmegaConf.save(cfg, output_dir() / notes / "config.yaml")


def output_dir() -> Path:
    """Return the folder of the run."""
    return Path(HydraConfig.get().runtime.output_dir)


def task_overrides(hydra_cfg: Any) -> list[str]:
    """Return the words of the command line; references in them stay, which lead elsewhere from there."""
    words: Any = OmegaConf.to_container(hydra_cfg.overrides.task, resolve=False)
    return list(words)


def places_in_other_groups(word: str) -> list[str]:
    """Return the places in other groups that an option sets, such as ``["env.reach"]`` for ``reach=annulus``.

    Raises:
        ValueError: for one that is removed (``~reach``): nothing says what would be there instead.
    """
    (override,) = parse([word])
    if not _is_choice(override):
        return []
    own = (override.key_or_group.replace("/", "."), override.package)
    places = [
        place for place in _places(override, _search_words(HydraConfig.get().overrides.hydra)) if place not in own
    ]
    if places and override.is_delete():
        group = override.key_or_group
        raise ValueError(f"{word}: the checkpoint's {group} can be exchanged, not removed; expected {group}=<option>.")
    return places


def _is_choice(override: Override) -> bool:
    """Return whether an override chooses the option of a group, rather than a value."""
    group = override.key_or_group
    is_removed = override.is_delete() and (conf_dir() / group).is_dir()
    is_listed = group in HydraConfig.get().runtime.choices and not isinstance(override.value(), dict)
    return bool(override.package or "/" in group or is_listed or is_removed)


def _group(choice: Override) -> str:
    """Return the group of a choice as Hydra lists it, such as ``planner@warm_start.teacher``."""
    return choice.get_key_element().lstrip("+~")


def _places(choice: Override, search: list[str]) -> list[str]:
    """Return the places in the config that an option sets: its package, or its keys if that is another group's.

    There are none of a preset, whose package is the whole config. All options of a group have the same package.
    """
    group, loader = choice.key_or_group, GlobalHydra.instance().config_loader()
    own = choice.package or group.replace("/", ".")
    option = next((f"{group}/{name}" for name in loader.get_group_options(group)), "")
    found = [source for source in loader.get_sources() if option and source.is_config(option)]
    package = found[0].load_config(option).header.get("package") if found and not choice.package else None
    if package in (None, own):
        return [own]
    if package == "_global_" or choice.is_delete():
        return [] if package == "_global_" else [f"{package}.{own}"]
    part = OmegaConf.select(hydra.compose(None, [*search, f"+{str(choice.input_line).lstrip('+')}"]), package)
    return [f"{package}.{key}" for key in part or ()]


def _is_inside(override: Override, place: str, search: list[str]) -> bool:
    """Return whether an override changes something at a place."""
    if _is_choice(override):
        return any(f"{other}.".startswith(f"{place}.") for other in _places(override, search))
    key = override.key_or_group
    return f"{key}.".startswith(f"{place}.") or f"{place}.".startswith(f"{key}.")


def _added(override: Override) -> str:
    """Return an override for a config that may lack its key."""
    line = str(override.input_line)
    return line if _is_choice(override) or override.is_delete() else f"++{line.lstrip('+')}"


def _part_at(cfg: DictConfig, place: str) -> Any:
    """Return the part of a config at a place, unresolved; None if there is none."""
    part: Any = OmegaConf.to_container(cfg, resolve=False)
    for key in place.split("."):
        part = part.get(key) if isinstance(part, dict) else None
    return part


def _has_parts(node: Any) -> bool:
    """Return whether a part of a config has a ``_target_``, itself or in its own parts."""
    return isinstance(node, dict) and ("_target_" in node or any(map(_has_parts, node.values())))


# ---------------------------------------------------------------------- saved configs
def apply_overrides(saved: DictConfig, overrides: list[str], groups: Any = None) -> DictConfig:
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
    for override in parse(overrides):
        key, line = override.key_or_group, override.input_line
        is_part = key.startswith("env.") and bool(names_at(key))  # a part of the cell, in its short or its long form
        if groups and key in groups:
            cfg[key] = groups[key]
        elif (conf_dir() / key).is_dir() or (OmegaConf.is_dict(OmegaConf.select(cfg, key)) and not is_part):
            new_run = "" if groups else ", or a new run with warm_start.weights=<run folder>"
            raise ValueError(
                f"{line!r}: the checkpoint's config group {key!r} cannot be exchanged; expected overrides of its "
                f"values, such as {key.replace('/', '.')}.<key>=<value>{new_run}."
            )
        elif override.is_delete() or override.is_sweep_override():
            raise ValueError(f"{line!r}: expected <key>=<value> with one value, on top of the checkpoint's config.")
        else:
            try:
                OmegaConf.update(cfg, key, override.value(), merge=not is_part)
            except OmegaConfBaseException as error:
                raise ValueError(unknown_key(key, cfg)) from error
    return cfg
