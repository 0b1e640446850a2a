"""The registry: short names of all classes and functions that a config may name, and how they are called.

``_target_`` in a config holds a short name (``_target_: joint_dbl``), or the dotted path of a class of the user's own
(``_target_: own_planner.Nearest``). A short name belongs to a place in the config, such as ``planner`` or
``curriculum.advance``. Parts of a user's own class that are in no such place say it before the name, with slashes:
``_target_: items/kinds`` or ``_target_: curriculum/advance/frames``.

To add an option, write one line into :data:`REGISTRY` and one file into ``conf/``.
"""

import inspect
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from importlib import import_module
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pickplace.common.validate import short_text
from pickplace.config.errors import unknown_key

PLANNERS = {
    "policy": "pickplace.planners.policy.PolicyPlanner",
    "lookahead": "pickplace.planners.lookahead.Lookahead",
    "joint_dbl": "pickplace.planners.heuristics.JointDBL",
    "corner": "pickplace.planners.heuristics.Corner",
    "best_fit": "pickplace.planners.spaces.BestFit",
    "online_bph": "pickplace.planners.spaces.OnlineBPH",
    "heightmap_minimisation": "pickplace.planners.heuristics.HeightmapMinimisation",
    "individual_heuristic": "pickplace.planners.individual.IndividualHeuristic",
    "mcts": "pickplace.planners.mcts.MCTS",
    "random": "pickplace.planners.heuristics.RandomFeasible",
    "uniform": "pickplace.planners.heuristics.UniformRandom",
}

#: Place in the config -> short name -> dotted path. ``*`` stands for any one key.
REGISTRY: dict[str, dict[str, str]] = {
    "algo": {
        "ppo": "pickplace.algorithms.ppo.PPO",
        "a2c": "pickplace.algorithms.a2c.A2C",
        "sampled_ppo": "pickplace.algorithms.sampled_ppo.SampledPPO",
        "td": "pickplace.algorithms.td.TD",
    },
    "env": {"pick_place": "pickplace.envs.torchrl.PickPlaceEnv"},
    "env.observation.*": {
        "bin_depth": "pickplace.rules.observation.BinDepth",
        "tote_depth": "pickplace.rules.observation.ToteDepth",
        "tote_bearing": "pickplace.rules.observation.ToteBearing",
        "tote_height": "pickplace.rules.observation.ToteHeight",
    },
    "env.gripper": {
        "contain": "pickplace.rules.gripper.rules.Contain",
        "overlap": "pickplace.rules.gripper.rules.Overlap",
        "seal": "pickplace.rules.gripper.rules.Seal",
    },
    "env.reach": {
        "annulus": "pickplace.rules.reach.annulus.Annulus",
        "table": "pickplace.rules.reach.table.ReachTable",
    },
    "env.support": {
        "half": "pickplace.rules.support.rules.Half",
        "more_than_half": "pickplace.rules.support.rules.MoreThanHalf",
        "hull": "pickplace.rules.support.rules.Hull",
        "bearing": "pickplace.rules.support.rules.Bearing",
        "half_or_hull": "pickplace.rules.support.rules.HalfOrHull",
        "corners": "pickplace.rules.support.rules.Corners",
        "full": "pickplace.rules.support.rules.Full",
        "share": "pickplace.rules.support.rules.Share",
    },
    "items": {
        "kinds": "pickplace.items.distributions.Kinds",
        "uniform": "pickplace.items.distributions.Uniform",
        "recorded": "pickplace.items.distributions.Recorded",
        "cut": "pickplace.items.cut.Cut",
    },
    "model.actor": {
        "fcn_grasp": "pickplace.policies.fcn_grasp.policy.fcn_grasp",
        "corners": "pickplace.policies.corners.policy.Corners",
        "afterstate": "pickplace.policies.afterstate.policy.Afterstate",
        "fcn4d": "pickplace.policies.fcn4d.policy.Fcn4d",
        "typical": "pickplace.policies.fcn4d.policy.Typical",
        "individual_rl": "pickplace.policies.individual.policy.IndividualRl",
        "individual_grasp": "pickplace.policies.individual.policy.individual_grasp",
    },
    "model.critic": {
        "pooled": "pickplace.policies.critics.Pooled",
        "conv4d": "pickplace.policies.critics.Conv4d",
    },
    "curriculum": {"curriculum": "pickplace.training.curriculum.levels.Curriculum"},
    "curriculum.advance": {
        "none": "pickplace.training.curriculum.advance.NoAdvance",
        "frames": "pickplace.training.curriculum.advance.Frames",
        "threshold": "pickplace.training.curriculum.advance.Threshold",
        "plateau": "pickplace.training.curriculum.advance.Plateau",
        "staged": "pickplace.training.curriculum.advance.Staged",
    },
    "curriculum.sample": {
        "current": "pickplace.training.curriculum.sample.Current",
        "uniform": "pickplace.training.curriculum.sample.Uniform",
        "recent": "pickplace.training.curriculum.sample.Recent",
    },
    "collector": {
        "single": "pickplace.training.collectors.single",
        "multi_sync": "pickplace.training.collectors.multi_sync",
        "ray": "pickplace.training.collectors.ray",
    },
    "callbacks.*": {"early_stopping": "pickplace.training.callbacks.EarlyStopping"},
    "logger": {
        "csv": "pickplace.runs.loggers.CsvLogger",
        "tensorboard": "pickplace.runs.loggers.TensorboardLogger",
        "wandb": "pickplace.runs.loggers.WandbLogger",
        "mlflow": "pickplace.runs.loggers.MlflowLogger",
        "none": "pickplace.runs.loggers.NoLogger",
    },
    "physics": {"settle": "pickplace.physics.settle.Settle", "execute": "pickplace.physics.execute.Execute"},
    "planner": PLANNERS,
    "warm_start.teacher": PLANNERS,
}


def build(place: str, node: DictConfig | dict, **kwargs):
    """Make the object that a config node names, and before it the objects that nodes within it name.

    Args:
        place: the node's place in the config, such as ``"planner"`` or ``"model.actor"``.
        node: the settings, with a ``_target_``.
        **kwargs: arguments handed over as they are; the node may not set them.

    Raises:
        ValueError: for an unknown ``_target_`` or setting, or an argument that is missing; and what the constructor
            raises.
    """
    return _make(place, OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node, kwargs)


def _make(place: str, node, given: dict):
    if isinstance(node, list):
        return [_make(f"{place}[{index}]", value, {}) for index, value in enumerate(node)]
    if not isinstance(node, dict):
        return node
    settings = {key: _make(f"{place}.{key}", value, {}) for key, value in node.items() if key != "_target_"}
    if "_target_" not in node:
        return settings
    function = find(place, node["_target_"])
    known = accepted_arguments(function)
    free = dict.fromkeys(key for key in known or () if key not in given)
    if refused := [key for key in settings if key in given or (known is not None and key not in free)]:
        raise ValueError(unknown_key(f"{place}.{refused[0]}", free, f"{place}."))
    try:
        return function(**settings, **given)
    except TypeError as error:
        unknown = re.search("unexpected keyword argument '(.*)'", str(error))  # of what it hands its **keywords to
        if unknown and unknown[1] in settings:
            others = {key: value for key, value in settings.items() if key != unknown[1]}
            raise ValueError(unknown_key(f"{place}.{unknown[1]}", others, f"{place}.")) from error
        raise ValueError(f"{place}._target_={short_text(node['_target_'])}: {error}.") from error


def node_of(place: str, part: Any) -> Any:
    """Return the config of a part that :func:`build` makes of it: of a dataclass its name and its settings."""
    if isinstance(part, (tuple, list)):
        return [node_of(place, value) for value in part]
    if not is_dataclass(part):
        return part
    path = f"{type(part).__module__}.{type(part).__qualname__}"
    names = {path: name for name, path in names_at(place).items()}
    settings = {
        item.name: node_of(f"{place}.{item.name}", getattr(part, item.name)) for item in fields(part) if item.init
    }
    return {"_target_": names.get(path, path), **settings}


def names_at(place: str) -> dict[str, str]:
    """Return the short names that a place of the config may hold, with their dotted paths."""
    return REGISTRY.get(place) or REGISTRY.get(f"{place.rpartition('.')[0]}.*", {})


def qualified_names() -> dict[str, str]:
    """Return all names with their places, such as ``items/kinds``, with their dotted paths."""
    return {
        f"{place.removesuffix('.*').replace('.', '/')}/{name}": path
        for place, names in REGISTRY.items()
        for name, path in names.items()
    }


def find(place: str, target) -> Callable:
    """Return the class or function that a ``_target_`` names.

    Raises:
        ValueError: if there is none, with the names that there are.
    """
    names = names_at(place)
    path = {**qualified_names(), **names}.get(str(target), str(target))
    module, _, name = path.rpartition(".")
    reason = ""
    try:
        if callable(found := getattr(import_module(module), name) if module else None):
            return found
    except (ImportError, AttributeError, TypeError, ValueError) as error:  # the last two from ".a.b" and "..a"
        reason = f" ({short_text(error)})"
    close = get_close_matches(path, names, 1)
    known = f"one of {', '.join(names)}, or " if names else ""
    hint = f"did you mean {close[0]!r}?" if close else f"expected {known}the dotted path of a class of your own."
    raise ValueError(f"{place}._target_={short_text(target)}: there is no such class or function{reason}; {hint}")


def with_defaults(place: str, node: dict) -> dict:
    """Return a config node with the defaults of the arguments that it leaves out."""
    parameters = inspect.signature(find(place, node["_target_"])).parameters.values()
    return {each.name: each.default for each in parameters if each.default is not each.empty} | node


def accepted_arguments(function: Callable) -> list[str] | None:
    """Return the keywords that a config may give to a class or function, or None if any.

    One with ``**keywords`` takes any. An attribute ``settings``, a tuple of names, states them instead.
    """
    if isinstance(settings := getattr(function, "settings", None), tuple):
        return list(settings)
    has_init = inspect.isclass(function) and function.__init__ is not object.__init__
    try:  # of __init__ itself, since a metaclass may hide its arguments
        parameters = inspect.signature(function.__init__ if has_init else function).parameters.values()
    except (TypeError, ValueError):  # a function written in C
        return None
    named = [each.name for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)]
    names = [name for name in named if name != "self"]
    return names if all(each.kind != each.VAR_KEYWORD for each in parameters) else None
