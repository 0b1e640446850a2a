"""The ``pickplace-evaluate`` command: it checks its command line and the checkpoint's config, then imports torch."""

from omegaconf import DictConfig, OmegaConf

from pickplace.common.validate import refuse_if
from pickplace.config.allowlist import trusted_config
from pickplace.config.composition import apply_overrides
from pickplace.config.hydra_app import Command
from pickplace.config.own_values import places_in_other_groups
from pickplace.config.words import task_overrides
from pickplace.runs import folder
from pickplace.runs.locate import locate, read_facts

#: Config groups that an evaluation takes from the checkpoint.
TRAINED = ("env", "items", "model")


def main() -> None:
    """Entry point of ``pickplace-evaluate``."""
    Command("evaluate", "pickplace.evaluation.evaluate.run", folder, TRAINED, check=check)()


def check(cfg: DictConfig) -> None:
    """Refuse overrides that do not fit the checkpoint's config; its weights are read and checked by the evaluation."""
    if cfg.checkpoint is None:
        refuse_if("model" in cfg, "model: there are no settings of a model without checkpoint=<run folder>.")
    elif facts := read_facts(locate(str(cfg.checkpoint))):
        merge_trained(cfg, trusted_config(facts["config"], cfg.trust))


def merge_trained(cfg: DictConfig, trained: DictConfig) -> DictConfig:
    """Return a checkpoint's config with the command line's overrides of the groups :data:`TRAINED` on top.

    Args:
        cfg: the config that the command line makes.
        trained: the config of the checkpoint.

    Raises:
        ValueError: for overrides that do not fit it.
    """
    # References such as ${env.cell_size} must lead to the checkpoint's env.
    groups = OmegaConf.create({key: OmegaConf.to_container(cfg[key], resolve=False) for key in ("env", "items")})
    ours, changed = [], trained.copy()
    changed.evaluation = cfg.evaluation
    for word in task_overrides():
        key, _, option = word.lstrip("+~").partition("=")
        if key == "items" and "cell_size" not in changed.env:  # of an older checkpoint; these items may refer to it
            OmegaConf.update(changed, "env.cell_size", groups.env.cell_size, force_add=True)
        if key == "benchmark":
            ours += ["env=benchmark", "items=benchmark"] if option not in ("", "null") else []
        elif places := places_in_other_groups(word):
            for part in places:  # such as env.reach
                OmegaConf.update(changed, part, OmegaConf.select(groups, part), merge=False, force_add=True)
        elif _is_younger(key, groups, changed):
            OmegaConf.update(changed, key, OmegaConf.select(groups, key), merge=False, force_add=True)
        elif key.split(".")[0] in TRAINED:
            ours.append(word)
    return apply_overrides(changed, ours, groups)


def _is_younger(key: str, groups: DictConfig, trained: DictConfig) -> bool:
    """Return whether an older checkpoint's config lacks a setting of the cell, or of the same kind of items."""
    group, _, name = key.partition(".")
    if group not in groups or name not in groups[group] or name in trained[group]:
        return False
    return groups[group].get("_target_") == trained[group].get("_target_")
