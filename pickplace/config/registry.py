"""The registry: short names of all classes and functions that a config may name, and their construction.

``_target_`` in a config holds a short name (``_target_: joint_dbl``), or the dotted path of a class of the user's own
(``_target_: own_planner.Nearest``). A short name belongs to a place in the config, such as ``planner`` or
``curriculum.advance``. If a part of a user's own class is in no such place, the place comes before the name, with
slashes: ``_target_: items/kinds``. To add an option, write its name into :data:`REGISTRY` and one file into ``conf/``.
"""

import inspect
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from importlib import import_module
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pickplace.common.errors import unknown_key
from pickplace.common.validate import refuse_any, short_text


def _classes(module: str, **names: str) -> dict[str, str]:
    return {name: f"pickplace.{module}.{path}" for name, path in names.items()}


PLANNERS = _classes(
    "planners", policy="policy.PolicyPlanner", lookahead="lookahead.Lookahead", beam="beam.Beam",
    joint_dbl="heuristics.JointDBL", corner="heuristics.Corner", best_fit="spaces.BestFit",
    online_bph="spaces.OnlineBPH", heightmap_minimisation="heuristics.HeightmapMinimisation",
    individual_heuristic="heuristics.IndividualHeuristic", mcts="mcts.MCTS",
    random="heuristics.RandomFeasible", uniform="heuristics.UniformRandom",
)  # fmt: skip

#: Place in the config -> short name -> dotted path. ``*`` stands for any one key.
REGISTRY: dict[str, dict[str, str]] = {
    "algo": _classes("algorithms", ppo="ppo.PPO", a2c="a2c.A2C", sampled_ppo="sampled_ppo.SampledPPO", td="td.TD"),
    "env": _classes("envs.torchrl", pick_place="PickPlaceEnv"),
    "env.observation.*": _classes(
        "rules.observation", bin_depth="BinDepth", tote_depth="ToteDepth", tote_bearing="ToteBearing",
        tote_height="ToteHeight", tote_capacity="ToteCapacity",
    ),
    "env.gripper": _classes("rules.gripper.rules", contain="Contain", overlap="Overlap", seal="Seal"),
    "env.reach": _classes("rules.reach", annulus="annulus.Annulus", table="table.ReachTable"),
    "env.support": _classes(
        "rules.support", half="rules.Half", more_than_half="rules.MoreThanHalf", hull="rules.Hull",
        bearing="rules.Bearing", half_or_hull="rules.HalfOrHull", corners="rules.Corners", cdrl="rules.Cdrl",
        gopt="rules.Gopt", full="rules.Full", pct="pct.Pct", share="rules.Share",
    ),
    "items": _classes(
        "items", kinds="distributions.Kinds", uniform="distributions.Uniform", recorded="distributions.Recorded",
        cut="cut.Cut", orders="orders.Orders", published="published.published",
    ),
    "items.drawn": _classes("items", uniform="distributions.Uniform", cut="cut.Cut"),
    "model.actor": _classes(
        "policies", fcn_grasp="fcn_grasp.policy.fcn_grasp",
        afterstate="afterstate.policy.Afterstate", afterstate_fcn="afterstate.policy.AfterstateFcn",
        fcn4d="fcn4d.policy.Fcn4d", typical="fcn4d.policy.Typical", individual_rl="individual.policy.IndividualRl",
        individual_grasp="individual.policy.individual_grasp",
    ),
    "model.critic": _classes("policies.critics", pooled="Pooled", conv4d="Conv4d"),
    "compile": _classes("common.graphs", compile="CompileSettings"),
    "curriculum": _classes("training.curriculum.curriculum", curriculum="Curriculum"),
    "curriculum.advance": _classes(
        "training.curriculum", none="advance.NoAdvance", frames="advance.Frames", threshold="advance.Threshold",
        plateau="advance.Plateau", staged="advance.Staged", learning_progress="learning_progress.LearningProgress",
    ),
    "curriculum.sample": _classes("training.curriculum.sample", current="Current", uniform="Uniform", recent="Recent"),
    "collector": _classes("training.collectors", single="single", multi_sync="multi_sync", ray="ray"),
    "callbacks.*": _classes("training.callbacks", early_stopping="EarlyStopping"),
    "logger": _classes(
        "runs.loggers", csv="CsvLogger", tensorboard="TensorboardLogger", wandb="WandbLogger", mlflow="MlflowLogger",
        none="NoLogger",
    ),
    "physics": _classes("physics", settle="settle.Settle", execute="execute.Execute"),
    "planner": PLANNERS,
    "warm_start.teacher": PLANNERS,
}  # fmt: skip


def build(place: str, node: DictConfig | dict, **kwargs):
    """Make the object that a config node names. The objects of nodes within it are made first.

    Args:
        place: the node's place in the config, such as ``"planner"`` or ``"model.actor"``.
        node: the settings, with a ``_target_``.
        **kwargs: arguments that are passed unchanged; the node may not set them.

    Raises:
        ValueError: for an unknown ``_target_`` or setting, or an argument that is missing; and what the constructor
            raises.
    """
    content: Any = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
    if isinstance(content, list):
        return [build(f"{place}[{index}]", value) for index, value in enumerate(content)]
    if not isinstance(content, dict):
        return content
    settings = {key: build(f"{place}.{key}", value) for key, value in content.items() if key != "_target_"}
    if "_target_" not in content:
        return settings
    function = find(place, content["_target_"])
    known = accepted_arguments(function)
    free = dict.fromkeys(key for key in known or () if key not in kwargs)
    refuse_any(
        (key for key in settings if key in kwargs or (known is not None and key not in free)),
        lambda key: unknown_key(f"{place}.{key}", free, f"{place}."),
    )
    try:
        return function(**settings, **kwargs)
    except TypeError as error:
        if missing := re.search("missing .* arguments?: (.*)", str(error)):
            what = f"{place}._target_={short_text(content['_target_'])}: {missing[1]} missing"
            raise ValueError(f"{what}; expected a value, or an option of that group in the file's defaults.") from error
        unknown = re.search("unexpected keyword argument '(.*)'", str(error))  # of a function that gets its **keywords
        if unknown and unknown[1] in settings:
            others = {key: value for key, value in settings.items() if key != unknown[1]}
            raise ValueError(unknown_key(f"{place}.{unknown[1]}", others, f"{place}.")) from error
        raise ValueError(f"{place}._target_={short_text(content['_target_'])}: {error}.") from error


def node_of(place: str, part: Any) -> Any:
    """Return the config from which :func:`build` makes a part: for a dataclass its name and its settings."""
    if isinstance(part, (tuple, list)):
        return [node_of(place, value) for value in part]
    if not is_dataclass(part):
        return part
    path = f"{type(part).__module__}.{type(part).__qualname__}"
    names = {path: name for name, path in names_at(place).items()}
    keys = [each.name for each in fields(part) if each.init]
    return {"_target_": names.get(path, path)} | {key: node_of(f"{place}.{key}", getattr(part, key)) for key in keys}


def names_at(place: str) -> dict[str, str]:
    """Return the short names that a place of the config may hold, with their dotted paths."""
    return REGISTRY.get(place) or REGISTRY.get(f"{place.rpartition('.')[0]}.*", {})


def qualified_names() -> dict[str, str]:
    """Return the dotted paths of all names with their places, such as ``items/kinds``."""
    return {
        f"{place.removesuffix('.*').replace('.', '/')}/{name}": path
        for place, names in REGISTRY.items()
        for name, path in names.items()
    }


def find(place: str, target) -> Callable:
    """Return the class or function that a ``_target_`` names; a ``ValueError`` lists the known names."""
    names = names_at(place)
    path = {**qualified_names(), **names}.get(str(target), str(target))
    module, _, name = path.rpartition(".")
    reason, close = "", get_close_matches(path, names, 1)
    try:
        if callable(found := getattr(import_module(module), name) if module else None):
            return found
    except (ImportError, AttributeError, TypeError, ValueError) as error:  # the last two from ".a.b" and "..a"
        reason = f" ({short_text(error)})"
    known = f"one of {', '.join(names)}, or " if names else ""
    hint = f"did you mean {close[0]!r}?" if close else f"expected {known}the dotted path of a class of your own."
    raise ValueError(f"{place}._target_={short_text(target)}: there is no such class or function{reason}; {hint}")


def with_defaults(place: str, node: dict) -> dict:
    """Return a config node with the defaults of the arguments that it leaves out."""
    parameters = inspect.signature(find(place, node["_target_"])).parameters
    return {key: each.default for key, each in parameters.items() if each.default is not each.empty} | node


def accepted_arguments(function: Callable) -> list[str] | None:
    """Return the keywords that a config may give to a class or function; None: any.

    With ``**keywords`` it takes any. An attribute ``settings``, a tuple of names, states the keywords instead.
    """
    if isinstance(settings := getattr(function, "settings", None), tuple):
        return list(settings)
    has_init = inspect.isclass(function) and function.__init__ is not object.__init__
    try:  # of __init__ itself, since a metaclass may hide its arguments
        parameters = inspect.signature(function.__init__ if has_init else function).parameters.values()
    except (TypeError, ValueError):  # a function written in C
        return None
    named = {each.name: each.kind for each in parameters if each.name != "self"}
    others = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.VAR_POSITIONAL)
    return (
        None if inspect.Parameter.VAR_KEYWORD in named.values() else [key for key in named if named[key] not in others]
    )
