"""Planners and a trained policy against the exact optimum on small totes."""

from functools import partial

import pytest
from dynamic_programming import optimal_occupancy
from hydra import compose, initialize_config_dir

from pickplace import PickPlaceEnv
from pickplace.evaluation.play import play
from pickplace.planners.heuristics import JointDBL, RandomFeasible
from pickplace.planners.policy import PolicyPlanner
from pickplace.runs import checkpoint
from pickplace.runs.hydra_app import conf_dir
from pickplace.runs.registry import build
from pickplace.training.train import train

OPTIMA = {  # rules of the task, "Exact optimum"
    (3, 3, 1): 0.7864,
    (3, 3, 2): 0.8502,
    (4, 3, 1): 0.8478,
    (4, 3, 2): 0.9241,
    (4, 4, 1): 0.9208,
    (4, 4, 4): 0.9456,
}


@pytest.mark.parametrize(("width", "depth", "rotations"), OPTIMA)
def test_optimum_by_dynamic_programming(width, depth, rotations):
    assert optimal_occupancy(width, depth, rotations) == pytest.approx(OPTIMA[width, depth, rotations], abs=5e-5)


def mean_occupancy(make_planner, rotations):
    """Mean occupancy of a planner on 4x4x1 totes, which no planner brings above the optimum."""

    def make_env(first, count):
        stream = {"stream": "test", "first_episode": first}
        return PickPlaceEnv(tote_size=(4, 4, 1), rotations=rotations, num_envs=count, masks=(), **stream)

    occupancy = play(make_env, make_planner(make_env(0, 1).cell), 2000, 1000).occupancy
    noise = occupancy.std() / len(occupancy) ** 0.5
    assert occupancy.mean() < OPTIMA[4, 4, rotations] + 3 * noise
    return occupancy.mean()


@pytest.mark.parametrize("rotations", [1, 4])
@pytest.mark.parametrize("planner", [RandomFeasible, JointDBL])
def test_no_planner_exceeds_the_optimum(planner, rotations):
    assert mean_occupancy(planner, rotations) > 0.7


def test_fcn_grasp_comes_within_1_percent(tmp_path):
    overrides = [
        "experiment=quick", "env.tote_size=[4,4,1]", "curriculum=none", "total_frames=40_960", "threads=1",
        "algo.minibatch_size=256", "model.actor.filters=32", "model.actor.hidden=32", "logger=none",
    ]  # fmt: skip
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose("train", overrides)
    train(cfg, tmp_path)
    state, _ = checkpoint.read(tmp_path / "checkpoints" / "last")

    def trained(cell):
        make_policy = partial(build, "model.actor", cfg.model.actor, cell=cell, mask_infeasible=True)
        return PolicyPlanner(cell, checkpoint.restore(make_policy, state["policy"], "policy"))

    assert mean_occupancy(trained, 4) > 0.99 * OPTIMA[4, 4, 4]
