"""Untrained policies, which prefer some actions clearly, and checkpoints of them."""

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from pickplace.config.composition import conf_dir
from pickplace.config.registry import build
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.fcn_grasp.policy import fcn_grasp
from pickplace.runs import checkpoint
from pickplace.runs.provenance import commit, versions


def untrained_policy(cell, mask=True, seed=0):
    """Return a small ``fcn_grasp`` policy."""
    torch.manual_seed(seed)
    return fcn_grasp(cell, mask, filters=8, hidden=8, head_std=1.0).eval()


def untrained_planner(cell, candidates="all"):
    """Return the planner of :func:`untrained_policy`."""
    return PolicyPlanner(cell, untrained_policy(cell), candidates)


def write_checkpoint(folder, cell, *overrides):
    """Write a checkpoint of ``experiment=smoke`` with an untrained policy for a cell; return the folder."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose("train", ["experiment=smoke", "model.actor.head_std=1.0", *overrides])
    torch.manual_seed(0)
    policy = build("model.actor", cfg.model.actor, cell=cell, mask_infeasible=cfg.model.mask_infeasible)
    facts = {"frames": 256, "config": OmegaConf.to_container(cfg), "versions": versions(), "commit": commit()}
    checkpoint.write(folder, {"policy": policy.state_dict()}, facts)
    return folder
