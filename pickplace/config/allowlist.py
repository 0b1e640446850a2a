"""The config of a checkpoint: its saved form, and the allowlist of classes that it may make (docs/reliability.md)."""

import importlib
import inspect
import re
import sys
from collections.abc import Collection, Iterator
from contextlib import suppress
from copy import deepcopy
from functools import reduce
from importlib.metadata import packages_distributions
from operator import getitem
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pickplace.common.validate import excerpt, expect, first_line, refuse_above, refuse_any, reword_errors, short_text
from pickplace.config.registry import names_at, qualified_names

#: Modules that are never a user's own: with their functions a config could do anything.
RESERVED_MODULES = {"pickplace", "hydra", "numpy", "omegaconf", "tensordict", "torch", "torchrl"}
RESERVED_MODULES |= sys.stdlib_module_names

#: Keys that the config of every training has.
REQUIRED_KEYS = ["env._target_", "env.rotations", "env.tote_size", "items._target_", "model.actor._target_"]
REQUIRED_KEYS += ["model.mask_infeasible", "reward_scale", "seed"]

#: The groups and keys from which a policy is restored. Only the training uses the others.
POLICY_GROUPS = ("env", "items", "model", "reward_scale", "seed", "device")

#: Greatest depth and number of nodes of a config, and length of a text in it. A larger one could fill the memory.
MAX_DEPTH, MAX_NODES, MAX_TEXT = 32, 50_000, 10_000

#: A reference to another key of the same config, and nothing else.
REFERENCE = re.compile(r"\$\{(\.*)([A-Za-z_]\w*(?:\.\w+)*)\}")


def trusted_config(content: dict, trust=(), groups: Collection[str] | None = POLICY_GROUPS) -> DictConfig:
    """Return a checkpoint's config, after checking that it is one of a training and makes nothing unexpected.

    Args:
        content: the config.
        trust: modules whose classes it may make beside pickplace's own, see :func:`own_modules`.
        groups: the groups and keys that are used and returned; None: all. The others are not checked, except for
            values to which these refer.

    Raises:
        ValueError: naming the key that is missing, or refused.
    """
    own, groups = own_modules(trust), tuple(content) if groups is None else groups
    refuse_large_config({key: content[key] for key in groups if key in content})
    content = select_groups(content, groups)
    with reword_errors(
        (OmegaConfBaseException, RecursionError, AttributeError, TypeError),
        lambda error: ValueError(f"The checkpoint's config cannot be read ({first_line(error)})."),
    ):
        refuse_interpolations(content)
        refuse_foreign_targets(content, own)
        cfg = OmegaConf.create(content)
        refuse_foreign_targets(OmegaConf.to_container(cfg, resolve=True), own)
        missing = [key for key in REQUIRED_KEYS if OmegaConf.select(cfg, key) is None]
    refuse_any(missing, lambda key: f"The checkpoint's config has no {key}; expected the config of a training.")
    if type(cfg.seed) is not int:
        raise refusal("seed", cfg.seed, "a whole number")
    return cfg


def refuse_large_config(content) -> None:
    """Refuse a config that would fill the memory, before OmegaConf makes an object of each of its nodes."""
    for count, (path, value) in enumerate(walk(content), start=1):
        longest = max((len(part) for part in (*path[-1:], value) if isinstance(part, str)), default=0)
        refuse_above("The checkpoint's config has", count, "entries or more", MAX_NODES)
        refuse_above("The checkpoint's config has", len(path) + 1, "levels or more", MAX_DEPTH)
        refuse_above("The checkpoint's config has", longest, "characters in a text or more", MAX_TEXT)


def own_modules(trust) -> tuple[str, ...]:
    """Return the modules that a user trusts, given as ``trust=``: none, a name, or a list of names.

    A ``ValueError`` refuses anything but names of modules that may be the user's own.
    """
    names = list(trust) if isinstance(trust, (list, tuple, ListConfig)) else [] if trust is None else [trust]
    for name in names:
        expect(_may_be_own(name), "trust", name, "names of modules of your own, such as trust=my_models")
    return tuple(names)


def _may_be_own(module) -> bool:
    parts = module.split(".") if isinstance(module, str) and len(module) <= 200 else [""]
    return all(map(str.isidentifier, parts)) and parts[0] not in RESERVED_MODULES


def refuse_foreign_targets(node, trust: Collection[str] = (), place: str = "", in_own: bool = False) -> None:
    """Refuse a config that would make anything except classes of the registry, each in its place, and a user's own.

    Args:
        node: the config, or a part of it.
        trust: modules of the user. Their classes and functions may be made in any place, with any of pickplace's
            classes as parts. The modules are imported to find them.
        place: the place of the part in the config.
        in_own: whether it is a part of something that a trusted module defines.
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
    """Return advice on how to trust a module, if it may be the user's own; an installed package may not."""
    if not _may_be_own(module) or module in trust or module.partition(".")[0] in packages_distributions():
        return ""
    return f"; if {module} is yours, say trust={module} (--trust {module} to pickplace-plan)"


def _is_defined_by(target, trust: Collection[str]) -> bool:
    """Return whether a trusted module, or a part of it, defines that class or function, and not merely imports it."""
    if (module := _module(target)) not in trust or not re.fullmatch(r"[A-Za-z]\w*", target[len(module) + 1 :]):
        return False
    with reword_errors(
        ImportError,
        lambda error: ValueError(f"trust={module}: it cannot be imported ({error}); expected it on PYTHONPATH."),
    ):
        found = getattr(importlib.import_module(module), target[len(module) + 1 :], None)
    home = getattr(found, "__module__", None) or ""
    return (inspect.isclass(found) or inspect.isfunction(found)) and f"{home}.".startswith(f"{module}.")


def modules_to_trust(config) -> tuple[str, ...]:
    """Return the modules that a reader of this config, resolved, has to trust."""
    modules = {_module(node.get("_target_")) for _, node in walk(config) if isinstance(node, dict)}
    return tuple(sorted(filter(_may_be_own, modules)))


# ---------------------------------------------------------------------- references between keys, ${..actor.filters}
def saved_form(cfg: DictConfig) -> dict:
    """Return the config of a run in the form of its checkpoints: without ``trust``, which every reader states anew.

    References to values stay, so that an override reaches both keys. Other interpolations are resolved.
    """
    raw: Any = OmegaConf.to_container(cfg, resolve=False)
    saved: Any = OmegaConf.to_container(cfg, resolve=True)
    for path, value in walk(raw):
        if _is_reference(value, path, raw):
            _put(saved, path, value)
    return {**saved, "trust": []}


def refuse_interpolations(root: dict) -> None:
    """Refuse all interpolations except references to values in the same config, before anything resolves them.

    A resolver reads files and variables, or makes nodes. A reference to a part, or to another reference, could copy
    parts into parts until the memory is full.
    """
    for path, value in walk(root):
        if isinstance(value, str) and "${" in value and not _is_reference(value, path, root):
            expected = "no interpolation but a reference to a number, a short text or a short list of such"
            raise refusal(".".join(map(str, path)), value, expected)


def select_groups(content: dict, groups: Collection[str]) -> dict:
    """Return some groups of a config, in which references to values in other groups are replaced by the values."""
    selected = deepcopy({key: content[key] for key in groups if key in content})
    for path, value in list(walk(selected)):
        if _is_reference(value, path, content) and (target := _target_path(value, path))[0] not in groups:
            _put(selected, path, reduce(getitem, target, content))
    return selected


def _target_path(text: str, path: tuple) -> tuple:
    ((dots, keys),) = REFERENCE.findall(text)
    return (*(path[: -len(dots)] if dots else ()), *keys.split("."))


def _is_reference(text, path: tuple, root) -> bool:
    """Return whether a text at a path is a reference to a number, a short text, or a short list of such."""
    if isinstance(text, str) and REFERENCE.fullmatch(text) and path[-1] != "_target_":
        with suppress(KeyError, TypeError):  # a TypeError from a key of a list or of a value
            found = reduce(getitem, _target_path(text, path), root)
            values = found if isinstance(found, list) else [found]
            return len(values) <= 100 and all(
                not isinstance(value, (dict, list)) and "${" not in str(value) and len(str(value)) <= 1000
                for value in values
            )
    return False


def _put(root, path: tuple, value) -> None:
    reduce(getitem, path[:-1], root)[path[-1]] = value


def walk(node, path: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """Yield the path and the value of a node and of all nodes within it."""
    yield path, node
    for key, value in children(node):
        yield from walk(value, (*path, key))


def children(node) -> Iterator[tuple]:
    """Yield the keys and values of a dict, or the indices and values of a list; nothing for anything else."""
    yield from node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()


def refusal(key: str, value, expected: str) -> ValueError:
    """Return the error for a value of a checkpoint's config."""
    return ValueError(f"{short_text(key)}={excerpt(value)}: the checkpoint is refused; expected {expected}.")
