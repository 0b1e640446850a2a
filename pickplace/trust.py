"""What a checkpoint's config may make; it comes from others, and is data until it is known to be harmless."""

import importlib
import inspect
import re
import reprlib
import sys
from collections.abc import Collection, Iterator
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

#: Every planner, by its class.
PLANNERS = (
    "IndividualHeuristic",
    "JointDBL",
    "Lookahead",
    "MCTS",
    "PolicyPlanner",
    "RandomFeasible",
    "UniformRandom",
)

#: What a checkpoint's config may make, and where: by its place in the config, names below ``pickplace``.
TARGETS = {
    "env": ("PickPlaceEnv", "env.PickPlaceEnv"),
    "items": ("items.Kinds", "items.Uniform", "items.Recorded"),
    "model.actor": tuple(f"models.actors.{name}" for name in ("fcn_grasp", "fcn4d", "typical", "individual_rl")),
    "model.critic": ("models.critics.pooled_critic", "models.critics.conv4d_critic"),
    "curriculum": ("curriculum.Curriculum",),
    "curriculum.advance": tuple(
        f"curriculum.{rule}" for rule in ("NoAdvance", "Frames", "Threshold", "Plateau", "Staged")
    ),
    "curriculum.sample": ("curriculum.Current", "curriculum.Uniform", "curriculum.Recent"),
    "collector": ("collector.single", "collector.multi_sync", "collector.ray"),
    "logger": tuple(f"metrics.{name}Logger" for name in ("Csv", "Tensorboard", "Wandb", "Mlflow", "No")),
    "planner": ("planners.PolicyPlanner",),
    "warm_start.teacher": tuple(f"planners.{name}" for name in PLANNERS),
}


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


def targets(node, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every place in a config where something is made, and what it names."""
    if isinstance(node, dict):
        if "_target_" in node:
            yield path, node["_target_"]
        for key, value in node.items():
            yield from targets(value, f"{path}.{key}" if path else str(key))
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from targets(value, f"{path}[{index}]")


def refuse_foreign_targets(node, trust: Collection[str] = ()) -> None:
    """Refuse a config that would make anything unexpected.

    Args:
        node: the config, with every reference resolved.
        trust: modules beside pickplace's own, see :func:`own_modules`. What they define themselves may be made in any
            place; to know what that is, they are imported.

    Raises:
        ValueError: naming the ``_target_`` and its place.
    """
    for path, target in targets(node):
        allowed = [f"pickplace.{name}" for name in TARGETS.get(path, ())]
        if target not in allowed and not _defined_by(target, trust):
            expected = f"one of {', '.join(allowed)}" if allowed else "none in this place"
            module = target.rpartition(".")[0] if isinstance(target, str) else ""
            if _may_be_own(module) and module not in trust:
                expected += f"; if {module} is yours, say trust={module} (--trust {module} to pickplace-plan)"
            raise ValueError(f"{path}._target_={target!r}: the checkpoint is refused; expected {expected}.")


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


def refuse_resolvers(node, path: str = "") -> None:
    """Refuse interpolations but plain references to other keys: a resolver reads files and variables, or makes nodes.

    Raises:
        ValueError: naming the value and its place.
    """
    if isinstance(node, dict):
        for key, value in node.items():
            refuse_resolvers(value, f"{path}.{key}" if path else str(key))
    elif isinstance(node, list):
        for index, value in enumerate(node):
            refuse_resolvers(value, f"{path}[{index}]")
    elif isinstance(node, str) and "${" in node and not REFERENCE.fullmatch(node):
        raise ValueError(f"{path}={reprlib.repr(node)}: the checkpoint is refused; expected no resolver in its config.")


def refuse_references_to_parts(node: Any, path: str = "") -> None:
    """Refuse references to anything but values and short lists of them: copies of parts in parts could fill the memory.

    Args:
        node: a DictConfig or a ListConfig.
        path: where it is in the config.

    Raises:
        ValueError: naming the reference's place.
    """
    keys: Any = node if isinstance(node, DictConfig) else range(len(node))
    for key in keys:
        place = f"{path}.{key}" if path else str(key)
        if OmegaConf.is_missing(node, key):
            continue
        value = node[key]
        if OmegaConf.is_interpolation(node, key):
            if not _is_value(value):
                raise ValueError(f"{place}: the checkpoint is refused; expected no reference to a part of its config.")
        elif OmegaConf.is_config(value):
            refuse_references_to_parts(value, place)


def _is_value(value) -> bool:
    """A number, a text, or a short list of such."""
    values = value if isinstance(value, (list, ListConfig)) else [value]
    return len(values) <= 100 and not any(isinstance(part, (dict, list, DictConfig, ListConfig)) for part in values)


def settled(raw, resolved):
    """A config to be saved: references to values as they are, so that overrides reach both; all else resolved.

    Args:
        raw: a config's plain values, not resolved.
        resolved: the same, resolved.
    """
    if isinstance(raw, dict):
        return {
            key: resolved[key] if key == "_target_" else settled(value, resolved[key]) for key, value in raw.items()
        }
    if isinstance(raw, list):
        return [settled(*pair) for pair in zip(raw, resolved, strict=True)]
    return raw if isinstance(raw, str) and REFERENCE.fullmatch(raw) and _is_value(resolved) else resolved


def saved_form(cfg: DictConfig) -> dict:
    """The config of a run as its checkpoints hold it; whoever loads one says anew what to trust."""
    raw, resolved = (OmegaConf.to_container(cfg, resolve=resolve) for resolve in (False, True))
    return {**settled(raw, resolved), "trust": []}


def trust_needed(cfg: DictConfig) -> str:
    """What has to be said to load this run again: `` trust=[...]``, or nothing if all is pickplace's own."""
    named = {target.rpartition(".")[0] for _, target in targets(OmegaConf.to_container(cfg, resolve=True))}
    own = sorted(module for module in named if module.partition(".")[0] != "pickplace")
    return f" trust=[{','.join(own)}]" if own else ""


#: What every config of a training has.
TRAINED_WITH = (
    "env._target_",
    "env.rotations",
    "env.tote_size",
    "items._target_",
    "model.actor._target_",
    "algo.mask_infeasible",
)


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
        # What is written, and what it leads to: one without the other could hide something.
        refuse_resolvers(content)
        refuse_foreign_targets(content, own)
        cfg = OmegaConf.create(content)
        refuse_references_to_parts(cfg)
        refuse_foreign_targets(OmegaConf.to_container(cfg, resolve=True), own)
        missing = [key for key in TRAINED_WITH if OmegaConf.select(cfg, key) is None]
    except (OmegaConfBaseException, RecursionError, AttributeError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"The checkpoint's config cannot be read ({reason}).") from error
    if missing:
        raise ValueError(f"The checkpoint's config has no {missing[0]}; expected one that a training wrote.")
    return cfg
