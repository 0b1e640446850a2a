"""Untrained policies that clearly prefer some actions, and checkpoints of them."""

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from pickplace.config.registry import build
from pickplace.config.words import conf_dir
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.fcn4d.policy import Fcn4d, Typical
from pickplace.policies.fcn_grasp.policy import FcnGrasp, UnmaskedFcnGrasp, fcn_grasp
from pickplace.policies.individual.policy import IndividualGrasp, IndividualRl, UnmaskedIndividualGrasp
from pickplace.runs import checkpoint
from pickplace.runs.provenance import commit, versions

GRASP, CONV4D = {"filters": 8, "hidden": 8, "head_std": 1.0}, {"filters": 4, "head_std": 1.0}
POLICIES = {
    FcnGrasp: GRASP, UnmaskedFcnGrasp: GRASP, UnmaskedIndividualGrasp: GRASP, IndividualGrasp: GRASP,
    Fcn4d: CONV4D, Typical: CONV4D, IndividualRl: CONV4D,
}  # fmt: skip
CELLS = [
    {"tote_size": (4, 4, 2), "bin_size": (4, 4, 1), "num_envs": 4},
    {"tote_size": (4, 5, 3), "bin_size": (4, 3, 1), "effector_size": (3, 2), "rotations": 3, "num_envs": 4},
    {"tote_size": (4, 4, 2), "bin_size": (3, 3, 1), "rotations": 1, "pick_rule": "overlap", "num_envs": 4},
    {
        "tote_size": (4, 5, 2),
        "effector_size": (2, 2),
        "cup": [[1, 0], [1, 0]],
        "pick_rule": "seal",
        "min_seal": 0.5,
        "num_envs": 4,
    },
]
every_policy = pytest.mark.parametrize("kind", POLICIES)


def small(kind, cell, **settings):
    """Return a small policy with random weights, whose distribution is far from uniform."""
    torch.manual_seed(0)
    return kind(cell, **POLICIES[kind], **settings)


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
