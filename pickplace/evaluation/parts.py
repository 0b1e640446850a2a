"""The parts of an evaluation, made from a config: the environment, the planner, and facts about a checkpoint."""

import logging
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from pickplace.common.machine import use_machine
from pickplace.config.allowlist import own_modules, trusted_config
from pickplace.config.composition import apply_overrides, places_in_other_groups, task_overrides
from pickplace.config.registry import build
from pickplace.evaluation.play import MakeEnv, check_episode_settings, check_play
from pickplace.evaluation.result import resolved
from pickplace.planners.base import BatchPlanner
from pickplace.planners.use import planner_parts
from pickplace.runs import checkpoint
from pickplace.runs.provenance import first_weights, imitated_planner

log = logging.getLogger(__name__)

#: Config groups that an evaluation takes from the checkpoint.
TRAINED = ("env", "items", "model")


def prepare(cfg: DictConfig) -> tuple[MakeEnv, BatchPlanner, dict[str, Any]]:
    """Return what a config evaluates (``conf/evaluate.yaml``): the environment's maker, the planner, and facts.

    The groups that a checkpoint brings are put into ``cfg``.

    Raises:
        ValueError: for settings that make no sense, or a checkpoint that does not fit them.
    """
    ev = cfg.evaluation
    check_episode_settings(ev)
    if "model" in cfg and cfg.checkpoint is None:
        raise ValueError("model: there are no settings of a model without checkpoint=<run folder>.")
    own_modules(cfg.trust)
    use_machine(cfg)
    settings = {key: value for key, value in resolved(cfg.planner).items() if key != "_target_"}
    facts: dict[str, Any] = {"planner_settings": settings, "checkpoint": None}
    trained = None
    if cfg.checkpoint is not None:
        trained, facts_of_training = load_trained(cfg)
        facts |= facts_of_training
    items = build("items", cfg["items"])
    if not items.varies:
        facts["same_items"] = True
        if ev.episodes > 1:
            log.warning("All episodes have the same items: the interval says nothing about other items.")

    def make_env(first, count):
        return build(
            "env", {**resolved(cfg.env), "num_envs": count}, items=items, device=cfg.device, masks=(),
            stream=ev.stream, seed=ev.seed, first_episode=first,
        )  # fmt: skip

    probe = make_env(0, 1)
    check_play(ev, probe.cell, cfg.device)
    parts = planner_parts(cfg.planner, probe.cell, items, probe.terms, trained)
    planner = build("planner", cfg.planner, **parts)
    if not isinstance(planner, BatchPlanner) or not isinstance(planner.name, str):  # now, not after all episodes
        raise ValueError(f"planner: {type(planner).__name__} has no name; expected an attribute name, a string.")
    if hasattr(planner, "evaluation_facts"):
        facts |= planner.evaluation_facts()
    return make_env, planner, facts


def load_trained(cfg: DictConfig) -> tuple[tuple[DictConfig, dict, dict], dict[str, Any]]:
    """Return the parts of a checkpoint as :func:`planner_parts` wants them, and facts about its training.

    The checkpoint's groups :data:`TRAINED` are put into ``cfg``, with the command line's overrides on top.

    Raises:
        ValueError: for a checkpoint that cannot be read, or overrides that do not fit it.
    """
    folder = checkpoint.locate(str(cfg.checkpoint))
    state, saved = checkpoint.read(folder)
    trained = trusted_config(saved["config"], cfg.trust)
    groups = OmegaConf.create({key: resolved(cfg[key]) for key in ("env", "items")})
    ours, changed = [], trained.copy()
    for word in task_overrides(HydraConfig.get()):
        key, _, option = word.lstrip("+~").partition("=")
        if key == "benchmark":
            ours += ["env=benchmark", "items=benchmark"] if option not in ("", "null") else []
        elif places := places_in_other_groups(word):
            for place in places:  # such as env.reach
                OmegaConf.update(changed, place, OmegaConf.select(groups, place), merge=False, force_add=True)
        elif key.split(".")[0] in TRAINED:
            ours.append(word)
    merged = apply_overrides(changed, ours, groups)
    with open_dict(cfg):
        for group in TRAINED:  # resolved where they come from: here a reference could lead elsewhere
            cfg[group] = resolved(merged[group])
        cfg.reward_scale = merged.reward_scale  # the scale of the critic's values
    facts = {
        "checkpoint": str(folder),
        "trained": {"frames": saved["frames"], "seed": merged.seed, "commit": saved["commit"]},
        "mask_in_training": merged.model.mask_infeasible,
        "warm_start": imitated_planner(saved["config"]),
        "first_weights": first_weights(saved["config"]),
    }
    return (cfg, state, resolved(trained.env)), facts
