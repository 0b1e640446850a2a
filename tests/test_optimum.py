"""Planners against the exact optimum on small totes."""

from functools import partial

import pytest
from dynamic_programming import optimal_occupancy
from hydra import compose, initialize_config_dir

from pickplace import PickPlaceEnv
from pickplace.evaluation.evaluate import play
from pickplace.planners import JointDBL, PolicyPlanner, RandomFeasible
from pickplace.runs import checkpoint
from pickplace.runs import hydra_app as config
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


def make_env(rotations):
    def make(first, count):
        return PickPlaceEnv(
            tote_size=(4, 4, 1), rotations=rotations, num_envs=count, masks=(), stream="test", first_episode=first
        )

    return make


@pytest.mark.parametrize("rotations", [1, 4])
@pytest.mark.parametrize("planner", [RandomFeasible, JointDBL])
def test_no_planner_exceeds_the_optimum(planner, rotations):
    make = make_env(rotations)
    occupancy = play(make, planner(make(0, 1).rules), 2000, 1000).occupancy
    noise = occupancy.std() / len(occupancy) ** 0.5
    assert occupancy.mean() < OPTIMA[4, 4, rotations] + 3 * noise
    assert occupancy.mean() > 0.7  # and it does play


def test_fcn_grasp_trained_there_comes_within_2_percent(tmp_path):
    overrides = [
        "experiment=quick", "env.tote_size=[4,4,1]", "curriculum=none",
        "total_frames=163_840", "evaluation_interval=163_840", "algo.minibatch_size=256", "threads=1", "logger=none",
    ]  # fmt: skip
    with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        cfg = compose("train", overrides)
    train(cfg, tmp_path)
    state, _ = checkpoint.read(tmp_path / "checkpoints" / "last")
    make = make_env(4)
    rules = make(0, 1).rules
    make_policy = partial(build, "model.actor", cfg.model.actor, rules=rules, mask_infeasible=True)
    policy = checkpoint.restore(make_policy, state["policy"], "policy")
    occupancy = play(make, PolicyPlanner(rules, policy), 2000, 1000).occupancy
    noise = occupancy.std() / len(occupancy) ** 0.5
    assert occupancy.mean() < OPTIMA[4, 4, 4] + 3 * noise
    assert occupancy.mean() > 0.98 * OPTIMA[4, 4, 4]
