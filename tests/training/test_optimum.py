"""Planners and a trained policy against the exact optimum on small totes."""

from functools import partial

import pytest
from commands import composed
from dynamic_programming import optimal_occupancy

from pickplace import PickPlaceEnv
from pickplace.config.registry import build
from pickplace.evaluation.play import play
from pickplace.planners.heuristics import JointDBL, RandomFeasible
from pickplace.planners.policy import PolicyPlanner
from pickplace.runs import checkpoint
from pickplace.training.train import train

OPTIMA = {  # rules of the task, "Exact optimum"
    (3, 3, 1): 0.7864, (3, 3, 2): 0.8502, (4, 3, 1): 0.8478, (4, 3, 2): 0.9241, (4, 4, 1): 0.9208, (4, 4, 4): 0.9456,
}  # fmt: skip


@pytest.mark.parametrize(("width", "depth", "rotations"), OPTIMA)
def test_optimum_by_dynamic_programming(width, depth, rotations):
    assert optimal_occupancy(width, depth, rotations) == pytest.approx(OPTIMA[width, depth, rotations], abs=5e-5)


def share_of_optimum(make_planner, sides, rotations):
    """Mean occupancy on totes of height 1 as a share of the optimum, which no planner exceeds."""

    def make_env(first, count):
        stream = {"stream": "test", "first_episode": first, "masks": ()}
        return PickPlaceEnv(tote_size=(*sides, 1), rotations=rotations, num_envs=count, **stream)

    share = play(make_env, make_planner(make_env(0, 1).cell), 2000, 1000).occupancy / OPTIMA[(*sides, rotations)]
    assert share.mean() < 1 + 3 * share.std() / len(share) ** 0.5
    return share.mean()


@pytest.mark.parametrize("rotations", [1, 4])
@pytest.mark.parametrize("planner", [RandomFeasible, JointDBL])
def test_no_planner_exceeds_the_optimum(planner, rotations):
    assert share_of_optimum(planner, (4, 4), rotations) > 0.75


def test_fcn_grasp_comes_within_1_percent(tmp_path):
    """``joint_dbl`` reaches 93% on this tote."""
    networks = [f"model.{part}.{size}=16" for part in ("actor", "critic") for size in ("filters", "hidden")]
    quick = ["total_frames=8192", "algo.minibatch_size=128", "env.num_envs=64", "evaluation.episodes=1"]
    tote = ["env.tote_size=[3,3,1]", "env.rotations=2", "curriculum=none", "logger=none", "threads=1"]
    cfg = composed("experiment=quick", *tote, *quick, *networks)
    train(cfg, tmp_path)
    state, _ = checkpoint.read(tmp_path / "checkpoints" / "last")

    def trained(cell):
        make_policy = partial(build, "model.actor", cfg.model.actor, cell=cell, mask_infeasible=True)
        return PolicyPlanner(cell, checkpoint.restore(make_policy, state["policy"], "policy"))

    assert share_of_optimum(trained, (3, 3), 2) > 0.99
