"""What a checkpoint's config may make; it comes from others, and is data until it is known to be harmless."""

import importlib
import inspect
import re
import reprlib
import sys
from collections.abc import Collection
from importlib.metadata import packages_distributions

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

TARGETS: dict = {}

#: What nobody may call a module of his own: with the functions of these a config could do anything.
THEIRS = {*sys.stdlib_module_names, "pickplace", "hydra", "numpy", "omegaconf", "tensordict", "torch", "torchrl"}

#: A reference to another key of the same config, and nothing else: what it leads to is checked as well.
REFERENCE = re.compile(r"\$\{\.*[A-Za-z_]\w*(\.\w+)*\}")


def own_modules(trust) -> tuple[str, ...]:
    """The modules that a user trusts, as ``trust=`` gives them: none, a name, or a list of names.

    Raises:
        ValueError: for anything but names of modules that may be the user's own.
    """
    names = list(trust) if isinstance(trust, (list, tuple, ListConfig)) else [] if trust is None else [trust]
    for name in names:
        if not _may_be_own(name):
            raise ValueError(
                f"trust={reprlib.repr(name)}: expected names of modules of your own, such as trust=my_models."
            )
    return tuple(names)


def _may_be_own(module) -> bool:
    named = isinstance(module, str) and all(part.isidentifier() for part in module.split("."))
    return named and module.partition(".")[0] not in THEIRS


def refuse_foreign_targets(node, trust: Collection[str] = (), path: str = "", within: bool = False) -> None:
    """Refuse a config that would make anything unexpected.

    Args:
        node: the config, or a part of it, with every reference resolved.
        trust: modules beside pickplace's own, see :func:`own_modules`. What they define themselves may be made in any
            place, and out of any of pickplace's own parts; to know what that is, they are imported.
        path: where the part is.
        within: is it a part of something that a trusted module defines?

    Raises:
        ValueError: naming the ``_target_`` and its place.
    """
    if isinstance(node, dict):
        if "_target_" in node:
            target = node["_target_"]
            own = _defined_by(target, trust)
            places = TARGETS.values() if within else [TARGETS.get(path, ())]
            allowed = [f"pickplace.{name}" for names in places for name in names]
            if not own and not str(target).startswith("pickplace."):
                expected = f"one of {', '.join(allowed)}" if allowed else "none in this place"
                expected += _advice(target, trust)
                raise ValueError(f"{path}._target_={target!r}: the checkpoint is refused; expected {expected}.")
            within = within or own
        for key, value in node.items():
            refuse_foreign_targets(value, trust, f"{path}.{key}" if path else str(key), within)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            refuse_foreign_targets(value, trust, f"{path}[{index}]", within)


def _advice(target, trust: Collection[str]) -> str:
    """How to trust a module that may be the user's own: one that is not installed as somebody's package."""
    module = target.rpartition(".")[0] if isinstance(target, str) else ""
    if not _may_be_own(module) or module in trust or module.partition(".")[0] in packages_distributions():
        return ""
    return f"; if {module} is yours, say trust={module} (--trust {module} to pickplace-plan)"


def _defined_by(target, trust: Collection[str]) -> bool:
    """Does a trusted module, or a part of it, define that class or function, and not merely import it?

    Raises:
        ValueError: if the module cannot be imported.
    """
    module, _, name = target.rpartition(".") if isinstance(target, str) else ("", "", "")
    if module not in trust or not re.fullmatch(r"[A-Za-z]\w*", name):
        return False
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError as error:
        raise ValueError(f"trust={module}: it cannot be imported ({error}); expected it on PYTHONPATH.") from error
    home = getattr(found, "__module__", None) or ""
    return (inspect.isclass(found) or inspect.isfunction(found)) and f"{home}.".startswith(f"{module}.")


def refuse_interpolations(node, path: tuple = (), root=None) -> None:
    """Refuse all interpolations but references to a value in the same config, before anything resolves them.

    A resolver reads files and variables or makes nodes; a reference to a part, or to a reference, could copy parts into
    parts until the memory is full.

    Raises:
        ValueError: naming the interpolation and its place.
    """
    root = node if root is None else root
    if isinstance(node, (dict, list)):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            refuse_interpolations(value, (*path, key), root)
    elif isinstance(node, str) and "${" in node:
        place = f"{'.'.join(map(str, path))}={reprlib.repr(node)}: the checkpoint is refused; expected"
        if not REFERENCE.fullmatch(node):
            raise ValueError(f"{place} no resolver in its config.")
        if not _leads_to_a_value(node, path, root):
            raise ValueError(f"{place} a reference to a number, a short text or a short list of such.")


def _leads_to_a_value(reference: str, path: tuple, root) -> bool:
    """Does a reference at some place lead to a value that is none itself?"""
    name = reference[2:-1].lstrip(".")
    up = len(reference) - 3 - len(name)
    found = root
    for key in (*(path[:-up] if up else ()), *name.split(".")):
        try:
            found = found[int(key) if isinstance(found, list) else key] if isinstance(found, (dict, list)) else None
        except (KeyError, IndexError, ValueError):
            return False
    values = found if isinstance(found, list) else [found]
    return len(values) <= 100 and not any(
        isinstance(value, (dict, list)) or (isinstance(value, str) and ("${" in value or len(value) > 1000))
        for value in values
    )


def settled(raw, resolved, path: tuple = (), root=None):
    """A config to be saved: references to values as they are, so that overrides reach both; all else resolved.

    Args:
        raw: a config's plain values, not resolved.
        resolved: the same, resolved.
        path: where they are in the config.
        root: the whole config, not resolved.
    """
    root = raw if root is None else root
    if isinstance(raw, dict):
        kept = {key: settled(value, resolved[key], (*path, key), root) for key, value in raw.items()}
        return kept | {"_target_": resolved["_target_"]} if "_target_" in raw else kept
    if isinstance(raw, list):
        pairs = enumerate(zip(raw, resolved, strict=True))
        return [settled(*pair, (*path, index), root) for index, pair in pairs]
    plain = isinstance(raw, str) and REFERENCE.fullmatch(raw) and _leads_to_a_value(raw, path, root)
    return raw if plain else resolved


def saved_form(cfg: DictConfig) -> dict:
    """The config of a run as its checkpoints hold it; whoever loads one says anew what to trust."""
    raw, resolved = (OmegaConf.to_container(cfg, resolve=resolve) for resolve in (False, True))
    return {**settled(raw, resolved), "trust": []}


def trust_needed(node, among: tuple[str, ...] = ()) -> tuple[str, ...]:
    """The modules that have to be trusted to load a run of this config, resolved, again."""
    if isinstance(node, dict):
        if isinstance(target := node.get("_target_"), str):
            among = tuple({*among, target.rpartition(".")[0]})
        node = list(node.values())
    if isinstance(node, list):
        for value in node:
            among = trust_needed(value, among)
    return tuple(sorted(module for module in among if _may_be_own(module)))


#: What every config of a training has.
TRAINED_WITH = (
    "env._target_",
    "env.rotations",
    "env.tote_size",
    "items._target_",
    "model.actor._target_",
    "algo.mask_infeasible",
    "seed",
)


#: Where a large number alone would take all memory or start processes without end, the largest that is accepted.
MOST = {
    "env.bin_size": 2_000, "env.tote_size": 2_000, "env.effector_size": 2_000, "env.num_envs": 65_536,
    "collector.workers": 1_024,
}  # fmt: skip


def trusted(content: dict, trust=()) -> DictConfig:
    """A checkpoint's config, once it is known to be one of a training and to make nothing unexpected.

    Args:
        content: the config.
        trust: modules beside pickplace's own whose classes it may make, see :func:`own_modules`.

    Raises:
        ValueError: naming what is missing, or what it would make.
    """
    own = own_modules(trust)
    try:
        refuse_interpolations(content)
        refuse_foreign_targets(content, own)  # as it is written, and below as it is meant
        cfg = OmegaConf.create(content)
        refuse_foreign_targets(OmegaConf.to_container(cfg, resolve=True), own)
        missing = [key for key in TRAINED_WITH if OmegaConf.select(cfg, key) is None]
    except (OmegaConfBaseException, RecursionError, AttributeError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"The checkpoint's config cannot be read ({reason}).") from error
    if missing:
        raise ValueError(f"The checkpoint's config has no {missing[0]}; expected one that a training wrote.")
    for key, most in MOST.items():
        value = OmegaConf.select(cfg, key)
        for number in value if isinstance(value, ListConfig) else [value]:
            if isinstance(number, (int, float)) and number > most:
                raise ValueError(f"{key}={reprlib.repr(number)}: the checkpoint is refused; expected at most {most:,}.")
    if not isinstance(cfg.seed, int) or isinstance(cfg.seed, bool):
        raise ValueError(f"seed={reprlib.repr(cfg.seed)}: the checkpoint is refused; expected a whole number.")
    return cfg
