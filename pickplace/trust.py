"""What a checkpoint's config may make; it comes from others, and is data until it is known to be harmless."""

import re
import reprlib
import sys
from collections.abc import Collection

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


def modules(trust) -> tuple[str, ...]:
    """The modules that a user trusts, as ``trust=[...]`` gives them.

    Raises:
        ValueError: for anything but names of modules that are the user's own.
    """
    names = list(trust) if isinstance(trust, (list, tuple, ListConfig)) else [trust]
    for name in names:
        module = isinstance(name, str) and all(part.isidentifier() for part in name.split("."))
        if not module or name.partition(".")[0] in (*sys.stdlib_module_names, "pickplace"):
            raise ValueError(
                f"trust={reprlib.repr(name)}: expected names of modules of your own, such as trust=my_models."
            )
    return tuple(names)


def refuse_foreign_targets(node, trust: Collection[str] = (), path: str = "") -> None:
    """Refuse a config that would make anything unexpected; a checkpoint's config is not trusted.

    Args:
        node: the config, or a part of it.
        trust: modules beside pickplace's own that it may make things from, see :func:`modules`.
        path: where the part is.

    Raises:
        ValueError: naming the ``_target_`` and its place.
    """
    if isinstance(node, dict):
        if "_target_" in node:
            allowed = [f"pickplace.{name}" for name in TARGETS.get(path, ())]
            # What a trusted module holds itself, not what it has imported and would be found by a longer path.
            trusted_one = isinstance(node["_target_"], str) and node["_target_"].rpartition(".")[0] in trust
            if node["_target_"] not in allowed and not trusted_one:
                expected = f"one of {', '.join(allowed)}" if allowed else "none in this place"
                raise ValueError(
                    f"{path}._target_={node['_target_']!r}: the checkpoint is refused; expected {expected}, or trust="
                    "[<module>] for one of your own."
                )
        for key, value in node.items():
            refuse_foreign_targets(value, trust, f"{path}.{key}" if path else str(key))
    elif isinstance(node, list):
        for index, value in enumerate(node):
            refuse_foreign_targets(value, trust, f"{path}[{index}]")
    elif isinstance(node, str) and re.search(r"\$\{[^}]*:", node):  # such as one that reads environment variables
        raise ValueError(f"{path}={node!r}: the checkpoint is refused; expected no resolver in its config.")


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
        trust: names of modules beside pickplace's own whose classes it may make.

    Raises:
        ValueError: naming what is missing, or what it would make.
    """
    own = modules(trust)
    try:
        refuse_foreign_targets(content, own)
        cfg = OmegaConf.create(content)
        OmegaConf.to_container(cfg, resolve=True)
        missing = [key for key in TRAINED_WITH if OmegaConf.select(cfg, key) is None]
    except (OmegaConfBaseException, RecursionError, AttributeError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"The checkpoint's config cannot be read ({reason}).") from error
    if missing:
        raise ValueError(f"The checkpoint's config has no {missing[0]}; expected one that a training wrote.")
    return cfg
