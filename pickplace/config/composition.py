"""The config that a command line makes, beyond Hydra's merge: values of replaced options, unknown keys, hints."""

import re
from collections.abc import Iterable
from contextlib import nullcontext
from functools import cache, reduce
from itertools import islice
from operator import getitem
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pickplace.common.errors import unknown_key
from pickplace.common.validate import excerpt, refuse_any, refuse_if
from pickplace.config.allowlist import walk
from pickplace.config.own_values import own_values
from pickplace.config.registry import REGISTRY, names_at
from pickplace.config.words import conf_dir, config_files, group_options, line_of, package_of, parse, search_words

#: Keys of Hydra that users of the commands set.
HYDRA_KEYS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.searchpath", "hydra.verbose")

#: Sweepers and launchers of Hydra that are optional extras.
PLUGINS = ("optuna", "joblib", "submitit")


@cache
def compose_plain(config_name: str) -> DictConfig:
    """Return the config of a file in ``conf/``, with the node ``hydra``. It is shared: do not change it."""
    with nullcontext() if GlobalHydra().is_initialized() else config_files():
        return hydra.compose(config_name, return_hydra_config=True)


def merge_search_path(words: list[str], folders: Iterable[str]) -> list[str]:
    """Return words of a command line with all the user's folders of config files in one override, if there are any."""
    search = search_words(words)
    values: list = [override.value() for override in parse(search)]
    paths = [f"file://{Path(folder).absolute()}" for folder in folders]
    paths += [path for value in values for path in (value if isinstance(value, list) else [value])]
    merged = [f"hydra.searchpath=[{','.join(map(quoted, paths))}]"] if paths else []
    return [*merged, *(word for word in words if word not in search)]


def quoted(value) -> str:
    """Return a text as a value of an override."""
    return "'{}'".format(str(value).replace("'", "\\'"))


def compose_training(words: list[str]) -> DictConfig:
    """Return the config that ``pickplace-train`` makes of a command line, such as ``["experiment=quick", "seed=1"]``.

    Raises:
        ValueError: for several values of a key, an unknown key, or one without a value.
    """
    refuse_several_values(words)
    running = HydraConfig.instance()
    before = running.cfg
    try:
        with config_files():
            _, cfg = compose_job("train", words)
            check_keys(cfg, "train")
    finally:
        running.cfg = before
    return cfg


def compose_job(config_name: str, words: list[str]) -> tuple[DictConfig, DictConfig]:
    """Return Hydra's merge of a command line, with the node ``hydra``, which is Hydra's current one from now on; and
    the config of the run, or of the first run of a sweep."""
    merged = compose_first_job(config_name, words)
    HydraConfig.instance().set_config(merged)
    cfg = own_values(OmegaConf.masked_copy(merged, [str(key) for key in merged if key != "hydra"]))
    OmegaConf.set_struct(cfg, True)
    return merged, cfg


def check_keys(cfg: DictConfig, config_name: str, from_checkpoint: tuple[str, ...] = ()) -> DictConfig:
    """Return a config; refuse values that are missing and unknown keys, but for groups ``from_checkpoint``."""
    refuse_any(sorted(OmegaConf.missing_keys(cfg)), lambda key: f"{key}: no value; expected {key}=<value>.")
    keys = [str(key) for key in cfg if key not in from_checkpoint]
    refuse_unknown_keys(OmegaConf.masked_copy(cfg, keys), compose_plain(config_name))
    return cfg


def refuse_several_values(words: list[str]) -> None:
    """Refuse words that only a sweep understands."""
    several = [str(word.input_line) for word in parse(words) if word.is_sweep_override()]
    refuse_any(several, lambda word: f"{word}: several values; expected one, or the command with -m for a sweep.")


def compose_first_job(config_name: str, words: list[str]) -> DictConfig:
    """Return Hydra's merge of a command line, with the node ``hydra``; for a sweep, the merge of its first job."""
    _refuse_options_as_values(words)
    try:
        cfg = hydra.compose(config_name, _first_of_sweep(words), return_hydra_config=True)
    except HydraException as error:
        raise clearer_error(error, config_name, words) from error
    except (ValueError, TypeError) as error:  # Hydra's own, which names no key
        for word in words:  # a group without an option, allowed for presets only
            group, _, option = word.lstrip("+").partition("=")
            if option in ("null", "") and (names := group_options(group, search_words(words))):
                raise ValueError(f"{word}: expected {group}=<one of {', '.join(sorted(names))}>.") from error
        raise ValueError(f"{' '.join(words)}: {error}.") from error
    _refuse_hidden_files(cfg)
    return cfg


def _refuse_hidden_files(cfg: DictConfig) -> None:
    """Refuse an option with a file in several folders, of which Hydra would silently take the first."""
    folders = {Path(each.path).resolve() for each in cfg.hydra.runtime.config_sources if each.schema == "file"}
    for group, choice in cfg.hydra.runtime.choices.items():
        for option in choice if OmegaConf.is_list(choice) else [choice]:
            files = [folder / group.partition("@")[0] / f"{option}.yaml" for folder in sorted(folders)]
            found = [str(file) for file in files if file.is_file()]
            refuse_if(
                len(found) > 1, f"{group}={option}: it is in {' and '.join(found)}; expected one file of that name."
            )


def _refuse_options_as_values(words: list[str]) -> None:
    """Refuse an option that is given to a place of the config, such as ``env.gripper=paper``, instead of its group."""
    search = search_words(words)
    for override in parse(words):
        place, value = override.key_or_group.replace("/", "."), override.value()
        for group in {place.replace(".", "/"), place.rpartition(".")[2]} - {override.key_or_group}:
            options = group_options(group, search) if isinstance(value, str) else []
            if options and place in (own := group.replace("/", "."), f"{package_of(group, options)}.{own}"):
                known = value if value in options else f"<one of {', '.join(options)}>"
                raise ValueError(f"{override.key_or_group}={excerpt(value)}: expected {group}={known}.")


def known_names(cfg: DictConfig) -> list[str]:
    """Return the names that a command line may set: the keys of a config, and its groups if it has a node ``hydra``."""
    own = OmegaConf.to_container(OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"]))
    choices = OmegaConf.select(cfg, "hydra.runtime.choices") or {}
    groups = [str(group) for group in choices if not str(group).startswith("hydra/")]
    keys = [path for path, value in walk(own) if not isinstance(value, dict) and path[-1] != "_target_"]
    return [
        *groups,
        *(HYDRA_KEYS if groups else ()),
        *(".".join(path) for path in keys if all(isinstance(key, str) for key in path)),
    ]


def _first_of_sweep(words: list[str]) -> list[str]:
    """Return overrides with only the first of their values. Those whose values cannot be listed are left out."""
    first = []
    for override in parse(words):
        if not override.is_sweep_override():
            first.append(line_of(override))
        elif override.is_discrete_sweep():
            first += [f"{override.get_key_element()}={value}" for value in islice(override.sweep_string_iterator(), 1)]
    return first


def clearer_error(error: HydraException, config_name: str, words: list[str]) -> ValueError:
    """Return an error that names the key or the option that Hydra does not find, and the known ones."""
    if isinstance(error, MissingConfigException) and (missing := error.missing_cfg_file):
        for extra in PLUGINS:
            if missing.startswith((f"hydra/sweeper/{extra}", f"hydra/launcher/{extra}")):
                return ValueError(f"{missing}: {extra} is missing; pip install 'pickplace[{extra}]'.")
        if error.options:
            return ValueError(f"{missing}: there is no such config; expected one of {', '.join(error.options)}.")
    if not (key := re.match("Could not (?:override|delete from config.) '([^']*)'", str(error))):
        return ValueError(str(error))
    others = [word for word in words if word.lstrip("+~").partition("=")[0] != key[1]]
    with nullcontext() if GlobalHydra().is_initialized() else config_files():
        try:
            known = hydra.compose(config_name, _first_of_sweep(others), return_hydra_config=True)
        except (HydraException, OmegaConfBaseException, ValueError):  # others are wrong, too
            search = search_words(words)
            choices = [line_of(each) for each in parse(words) if group_options(each.key_or_group, search)]
            known = hydra.compose(config_name, [*search, *_first_of_sweep(choices)], return_hydra_config=True)
    if "delete" in key[0] and OmegaConf.select(known, key[1], default=key) is None:
        return ValueError(f"{key[1]}: it is null already; expected no ~{key[1]}.")
    return ValueError(unknown_key(key[1], known, others=known_names(known)))


def refuse_unknown_keys(cfg: DictConfig, known: DictConfig, path: str = "") -> None:
    """Refuse keys that ``known`` lacks, such as misspelt ones: Hydra adds any key of a preset, or after a ``+``.

    Nodes with a ``_target_`` are left to :func:`pickplace.config.registry.build`, which knows their arguments.
    """
    if f"{path}*" in REGISTRY:  # a dict of parts with names of the user's choice
        return
    for key, node in cast(dict, cfg).items():
        if key not in known or f"{path}{key}" == "hydra":  # that node belongs to the command line
            raise ValueError(unknown_key(f"{path}{key}", known, path, () if path else known_names(known)))
        if OmegaConf.is_dict(node) and OmegaConf.is_dict(known[key]) and "_target_" not in node:
            refuse_unknown_keys(node, known[key], f"{path}{key}.")


def use_whole_numbers(cfg: DictConfig) -> None:
    """Replace numbers such as 1e5, which Hydra and YAML read as floats, by whole numbers.

    Those below 10 stay: nobody writes 1e0, and many settings are 1.0 or 2.0.
    """
    for path, value in walk(OmegaConf.to_container(cfg, resolve=False)):
        if isinstance(value, float) and value.is_integer() and 10 <= abs(value) < 2**53:
            reduce(getitem, path[:-1], cast(Any, cfg))[path[-1]] = int(value)


def apply_overrides(saved: DictConfig, overrides: list[str], groups: Any = None, instead: str = "") -> DictConfig:
    """Return a saved config with command-line overrides on top.

    Args:
        saved: the config of a checkpoint.
        overrides: as on Hydra's command line, ``key=value``; a leading ``+`` changes nothing.
        groups: composed nodes of the config groups that may be exchanged as a whole.
        instead: what a message suggests instead of exchanging another group.

    Raises:
        ValueError: for a group that cannot be exchanged, a key that the config does not have, or a bad value.
    """
    cfg = saved.copy()
    OmegaConf.set_struct(cfg, True)
    # As in Hydra, a value overrides that of a group's option, whichever is written first.
    for override in sorted(parse(overrides), key=lambda override: override.key_or_group not in (groups or ())):
        key, line = override.key_or_group, override.input_line
        is_part = key.startswith("env.") and bool(names_at(key))  # a part of the cell, in its short or its long form
        if groups and key in groups:
            cfg[key] = groups[key]
        elif (conf_dir() / key).is_dir() or (OmegaConf.is_dict(OmegaConf.select(cfg, key)) and not is_part):
            raise ValueError(
                f"{line!r}: the checkpoint's config group {key!r} cannot be exchanged; expected overrides of its "
                f"values, such as {key.replace('/', '.')}.<key>=<value>{instead}."
            )
        elif override.is_delete() or override.is_sweep_override():
            raise ValueError(f"{line!r}: expected <key>=<value> with one value, on top of the checkpoint's config.")
        else:
            try:
                OmegaConf.update(cfg, key, override.value(), merge=not is_part)
            except OmegaConfBaseException as error:
                raise ValueError(unknown_key(key, cfg, others=known_names(cfg))) from error
    use_whole_numbers(cfg)
    return cfg
