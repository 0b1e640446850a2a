"""The values of an option that the command line chose instead of a preset's."""

from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, OmegaConf

from pickplace.common.validate import refuse_if
from pickplace.config.words import group_options, line_of, package_of, parse, part_at, search_words, task_overrides

#: Groups whose preset values stay when the command line chooses another option: in the first all values, in the second
#: plain values under keys that the new option also has, such as ``algo.lr``.
KEPT_GROUPS, SHARED_GROUPS = ("env", "evaluation"), ("algo", "model")


def own_values(cfg: DictConfig) -> DictConfig:
    """Return the config of this run without preset values that were meant for an option that another one replaced.

    A preset, or a config file of the user, sets values for the option that it expects, such as
    ``curriculum.advance.occupancy`` for ``threshold``. Hydra merges them into the option that the command line chose
    instead. Here, an option that replaces another one gets the values of its own files and of the command line only.
    :data:`KEPT_GROUPS` and :data:`SHARED_GROUPS` are exceptions. A benchmark keeps its cell and its items, too.
    """
    running = HydraConfig.get()
    search = search_words(running.overrides.hydra)
    found = [(override, *_package_and_places(override, search)) for override in parse(task_overrides())]
    last = {_choice_of(each): each for each, package, _ in found if package}  # as in Hydra, of the choices for a group
    given = [one for one in found if not one[1] or last[_choice_of(one[0])] is one[0]]
    cfg = _of_benchmark(cfg, given, search)
    choices = [(each, places) for each, package, places in given if package and not each.is_delete()]
    pairs = [(place, choice) for choice, places in choices for place in places if place not in KEPT_GROUPS]
    for place, choice in sorted(pairs, key=lambda pair: pair[0].count(".")):  # outer parts before inner ones
        if OmegaConf.select(cfg, place) is None:
            continue
        words, others = [], []  # what is changed at that place, and the other choices
        for each, package, places in given:
            if each is choice:
                continue
            if any(_is_in(other, place) or (not package and _is_in(place, other)) for other in places):
                words.append(line_of(each, "" if package or each.is_delete() else "++"))
            elif package:
                others.append(line_of(each))
        try:
            own = part_at(hydra.compose(None, [*search, line_of(choice, "+"), *words]), place)
            before = hydra.compose(running.job.config_name, [*search, *others], return_hydra_config=True)
        except ConfigCompositionException:  # an option that depends on those of other groups
            continue
        merged = part_at(cfg, place)
        if isinstance(choice.value(), list):  # of callbacks: those that are listed keep their values
            cfg = cfg.copy()
            OmegaConf.update(cfg, place, {key: merged[key] for key in own or ()}, merge=False, force_add=True)
            continue
        group = choice.get_key_element().lstrip("+~")  # as Hydra lists it, such as planner@warm_start.teacher
        if str(before.hydra.runtime.choices.get(group)) != str(choice.value()):
            cfg = cfg.copy()
            if place in SHARED_GROUPS:
                plain = [key for key in own if not isinstance(own[key], dict) and not isinstance(merged[key], dict)]
                own |= {key: merged[key] for key in plain if key != "_target_"}
            OmegaConf.update(cfg, place, own, merge=False, force_add=True)
    return cfg


def _of_benchmark(cfg: DictConfig, given: list[tuple], search: list[str]) -> DictConfig:
    """Return the config with cell and items of the benchmark that a command line chose beside a preset.

    A preset that chooses a benchmark itself, such as ``buffer``, keeps what it sets.
    """
    presets = {each.key_or_group: line_of(each) for each, package, _ in given if package == "_global_" and each.value()}
    if not {"benchmark", "experiment"} <= presets.keys():
        return cfg
    name, places = HydraConfig.get().job.config_name, [place for *_, places in given for place in places]
    preset = hydra.compose(name, [*search, presets["experiment"]], return_hydra_config=True)
    if preset.hydra.runtime.choices.benchmark is not None:
        return cfg
    plain, own = (hydra.compose(name, [*search, *words]) for words in ([], [presets["benchmark"]]))
    cfg = cfg.copy()
    for place in ["items", *(f"env.{key}" for key in own.env)]:
        value = part_at(own, place)
        # A benchmark's lengths are in its own units, even where these are the usual ones.
        is_own = value != part_at(plain, place) or place in ("env.height_unit", "env.cell_size")
        if not is_own or any(_is_in(place, other) for other in places):
            continue
        kept = {other: part_at(cfg, other) for other in places if _is_in(other, place)}
        for key, each in {place: value, **kept}.items():
            OmegaConf.update(cfg, key, each, merge=False, force_add=True)
    return cfg


def places_in_other_groups(word: str) -> list[str]:
    """Return the places in other groups that an option sets, such as ``["env.reach"]`` for ``reach=annulus``.

    Raises:
        ValueError: for an option that is removed (``~reach``), because nothing replaces it.
    """
    (override,) = parse([word])
    group = override.key_or_group
    package, places = _package_and_places(override, search_words(HydraConfig.get().overrides.hydra))
    if package is None or override.package or package in ("_global_", group.replace("/", ".")):
        return []
    refuse_if(
        override.is_delete(),
        f"{word}: the checkpoint's {group} can be exchanged, not removed; expected {group}=<option>.",
    )
    return places


def _package_and_places(override: Override, search: list[str]) -> tuple[str | None, list[str]]:
    """Return the package, and the places in the config, that an override changes.

    Returns:
        The package of the group if the override chooses an option (``_global_`` for presets); None if it sets a value.
        Then the changed places: for a value its key; for an option the group's package. If that is the package of
        another group, the places are the option's keys in it.
    """
    group = override.key_or_group
    options = group_options(group, search)
    value: Any = override.value()  # options of callbacks are a list
    if not options or isinstance(value, dict) or (isinstance(value, list) and not {*map(str, value)} <= {*options}):
        return None, [group]
    own = override.package or group.replace("/", ".")
    package: Any = override.package or package_of(group, options)
    if package == "_global_" or override.value() is None:
        return package, []
    if package == own or override.is_delete():
        return package, [own if package == own else f"{package}.{own}"]
    part = part_at(hydra.compose(None, [*search, line_of(override, "+")]), package)
    return package, [f"{package}.{key}" for key in part or ()]


def _choice_of(override: Override) -> tuple[str, str | None]:
    """Return what an option is chosen for: its group, and the package if one is given."""
    return override.key_or_group, override.package


def _is_in(place: str, outer: str) -> bool:
    return f"{place}.".startswith(f"{outer}.")
