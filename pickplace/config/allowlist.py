"""The allowlist: what a checkpoint's config, which may come from a stranger, may make (docs/reliability.md)."""

import importlib
import inspect
import re
import sys
from collections.abc import Collection
from importlib.metadata import packages_distributions

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pickplace.common.validate import excerpt
from pickplace.config.references import children, refusal, refuse_interpolations, select_groups, walk
from pickplace.config.registry import names_at, qualified_names

#: Modules that are never a user's own: with their functions a config could do anything.
RESERVED_MODULES = {"pickplace", "hydra", "numpy", "omegaconf", "tensordict", "torch", "torchrl"}
RESERVED_MODULES |= sys.stdlib_module_names

#: Keys that the config of every training has.
REQUIRED_KEYS = ["env._target_", "env.rotations", "env.tote_size", "items._target_", "model.actor._target_"]
REQUIRED_KEYS += ["model.mask_infeasible", "reward_scale", "seed"]

#: The groups and keys that a policy is restored from. The others are of use to the training alone.
POLICY_GROUPS = ("env", "items", "model", "reward_scale", "seed", "device")

#: Greatest depth and number of nodes of a config, and length of a text in it: more would fill the memory.
MAX_DEPTH, MAX_NODES, MAX_TEXT = 32, 50_000, 10_000


def trusted_config(content: dict, trust=(), groups: Collection[str] | None = POLICY_GROUPS) -> DictConfig:
    """Return a checkpoint's config, after checking that it is one of a training and makes nothing unexpected.

    Args:
        content: the config.
        trust: modules whose classes it may make beside pickplace's own, see :func:`own_modules`.
        groups: the groups and keys that are used, and returned; None: all. Nothing in the others is looked at, but
            for values that these refer to.

    Raises:
        ValueError: naming the key that is missing, or refused.
    """
    own = own_modules(trust)
    if groups is None:
        groups = tuple(content)
    refuse_large_config({key: content[key] for key in groups if key in content})
    content = select_groups(content, groups)
    try:
        refuse_interpolations(content)
        refuse_foreign_targets(content, own)
        cfg = OmegaConf.create(content)
        refuse_foreign_targets(OmegaConf.to_container(cfg, resolve=True), own)
        missing = [key for key in REQUIRED_KEYS if OmegaConf.select(cfg, key) is None]
    except (OmegaConfBaseException, RecursionError, AttributeError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"The checkpoint's config cannot be read ({reason}).") from error
    if missing:
        raise ValueError(f"The checkpoint's config has no {missing[0]}; expected the config of a training.")
    if type(cfg.seed) is not int:
        raise refusal("seed", cfg.seed, "a whole number")
    return cfg


def refuse_large_config(content) -> None:
    """Refuse a config that would fill the memory, before OmegaConf makes an object of each of its nodes.

    Raises:
        ValueError: naming the limit.
    """
    level, count, depth = [content], 1, 0
    while level:
        pairs = [pair for node in level for pair in children(node)]
        count, depth = count + len(pairs), depth + 1
        longest = max((len(part) for pair in pairs for part in pair if isinstance(part, str)), default=0)
        for found, most, what in (
            (count, MAX_NODES, "entries"),
            (depth, MAX_DEPTH, "levels"),
            (longest, MAX_TEXT, "characters in a text"),
        ):
            if found > most:
                raise ValueError(f"The checkpoint's config has {found:,} {what} or more; expected at most {most:,}.")
        level = [value for _, value in pairs]


def own_modules(trust) -> tuple[str, ...]:
    """Return the modules that a user trusts, given as ``trust=``: none, a name, or a list of names.

    Raises:
        ValueError: for anything but names of modules that may be the user's own.
    """
    names = list(trust) if isinstance(trust, (list, tuple, ListConfig)) else [] if trust is None else [trust]
    for name in names:
        if not _may_be_own(name):
            raise ValueError(f"trust={excerpt(name)}: expected names of modules of your own, such as trust=my_models.")
    return tuple(names)


def _may_be_own(module) -> bool:
    is_name = isinstance(module, str) and len(module) <= 200 and all(part.isidentifier() for part in module.split("."))
    return is_name and module.partition(".")[0] not in RESERVED_MODULES


def refuse_foreign_targets(node, trust: Collection[str] = (), place: str = "", in_own: bool = False) -> None:
    """Refuse a config that would make anything but classes of the registry, each in its place, and a user's own.

    Args:
        node: the config, or a part of it.
        trust: modules of the user. What they define may be made in any place, out of any of pickplace's classes; they
            are imported to know what that is.
        place: the place of the part in the config.
        in_own: whether it is a part of something that a trusted module defines.

    Raises:
        ValueError: naming the ``_target_`` and its place.
    """
    if isinstance(node, dict) and "_target_" in node:
        target = node["_target_"]
        is_own = _is_defined_by(target, trust)
        names = names_at(place)
        if not is_own and target not in [*names, *(qualified_names() if in_own else ())]:
            expected = f"one of {', '.join(names)}" if names else "none in this place"
            expected = "a name with its place, such as items/kinds" if in_own else expected
            raise refusal(f"{place}._target_", target, expected + _advice(_module(target), trust))
        in_own = in_own or is_own
    for key, value in children(node):
        child = f"{place}[{key}]" if isinstance(node, list) else f"{place}.{key}" if place else str(key)
        refuse_foreign_targets(value, trust, child, in_own)


def _module(target) -> str:
    return target.rpartition(".")[0] if isinstance(target, str) else ""


def _advice(module: str, trust: Collection[str]) -> str:
    """Return how to trust a module that may be the user's own; an installed package is not."""
    if not _may_be_own(module) or module in trust or module.partition(".")[0] in packages_distributions():
        return ""
    return f"; if {module} is yours, say trust={module} (--trust {module} to pickplace-plan)"


def _is_defined_by(target, trust: Collection[str]) -> bool:
    """Return whether a trusted module, or a part of it, defines that class or function, and not merely imports it."""
    if (module := _module(target)) not in trust or not re.fullmatch(r"[A-Za-z]\w*", target[len(module) + 1 :]):
        return False
    try:
        found = getattr(importlib.import_module(module), target[len(module) + 1 :], None)
    except ImportError as error:
        raise ValueError(f"trust={module}: it cannot be imported ({error}); expected it on PYTHONPATH.") from error
    home = getattr(found, "__module__", None) or ""
    return (inspect.isclass(found) or inspect.isfunction(found)) and f"{home}.".startswith(f"{module}.")


def modules_to_trust(config) -> tuple[str, ...]:
    """Return the modules that a reader of this config, resolved, has to trust."""
    modules = {_module(node.get("_target_")) for _, node in walk(config) if isinstance(node, dict)}
    return tuple(sorted(filter(_may_be_own, modules)))
