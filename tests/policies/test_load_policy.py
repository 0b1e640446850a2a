"""``load_policy``: the policy of a checkpoint as a TensorDictModule."""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from untrained import write_checkpoint

from pickplace import CellSpec, Planner, Scene, load_policy
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.base import as_collection_policy
from pickplace.rules.observation import STANDARD_TERMS
from pickplace.rules.support.rules import Bearing, Half
from pickplace.runs import checkpoint

SIZES = {"env.tote_size": (4, 4, 2), "env.bin_size": (4, 4, 1)}


@pytest.fixture(scope="module", params=[True, False], ids=["mask", "no mask"])
def policy(request, tmp_path_factory):
    words = [f"{key}={list(size)}" for key, size in SIZES.items()] + [f"model.mask_infeasible={request.param}"]
    cell = CellSpec(tote_size=(4, 4, 2), bin_size=(4, 4, 1))
    return load_policy(write_checkpoint(tmp_path_factory.mktemp("run") / "checkpoint", cell, *words))


def test_it_plays_the_best_feasible_action_and_draws_as_in_training(policy):
    env = policy.make_env(num_envs=4, masks=("action", "footprint"), stream="test", seed=3)
    assert env.cell.tote_size == (4, 4, 2) and env.stream == "test" and (env.item_seed == 3).all()
    data = env.rollout(20, policy)
    assert data.shape[1] > 2 and policy.out_keys == ["action"] and "logits" not in data
    for seen in (data[:, 0], data[:, 2]):
        assert torch.equal(seen["action"], PolicyPlanner(policy.cell, policy.policy).decide(seen))
    bare = data.select(*STANDARD_TERMS)  # no mask is needed, and any batch size is served
    assert torch.equal(policy(bare)["action"], data["action"])
    assert torch.equal(policy(bare[3, 1])["action"], data["action"][3, 1])
    with set_exploration_type(ExplorationType.RANDOM):
        draws = []
        for seed, act in ((0, policy), (0, as_collection_policy(policy.policy)), (1, policy)):
            torch.manual_seed(seed)
            draws.append(act(data[:, 0].clone())["action"])
    assert torch.equal(draws[0], draws[1]) and not torch.equal(draws[0], draws[2])
    feasible = data[:, 0]["action_mask"].gather(1, draws[0][:, None])
    assert feasible.all() == policy.config.model.mask_infeasible


def test_a_collector_runs_it(policy):
    collector = Collector(policy.make_env(num_envs=4), policy, frames_per_batch=32, total_frames=32)
    assert next(iter(collector))["action"].shape == (4, 8)
    collector.shutdown()


def test_other_sizes_and_shipped_weights():
    policy = load_policy("pretrained/r4", tote_size=(7, 8, 3), rotations=3)
    data = policy.make_env(num_envs=4, items=None, stream="test").rollout(60, policy)
    with pytest.raises(ValueError, match="varies=.*: expected no such argument; a loaded policy plays the full task"):
        policy.make_env(varies=("rotations",))
    assert policy.cell == CellSpec(tote_size=(7, 8, 3), rotations=3) and data["next", "occupancy"].max() > 0.7


def test_another_stability_rule_than_that_of_the_training(tmp_path):
    run = write_checkpoint(tmp_path / "run", CellSpec(support="half"), "env=paper", "env.tote_size=[6,6,5]")
    assert load_policy(run).cell.support == load_policy(run).make_env().cell.support == Half()
    scene = Scene.from_maps(torch.eye(5) * (torch.arange(5) == 2), torch.full((6, 6), 5))
    assert Planner.load(run).plan(scene).warnings == []
    other = Planner.load(run, support="bearing")
    assert other.cell.support == Bearing(0.25)
    assert other.plan(scene).warnings == ["support=bearing: the policy met support=half."]


@pytest.mark.parametrize(
    ("path", "settings", "message"),
    [
        (7, {}, "path=7: expected a run folder"),
        ("pretrained/r9", {}, "pretrained/r9.*expected pretrained/cdrl_rs"),
        ("pretrained/r1", {"rotations": 2}, "env.rotations=2: the checkpoint was trained with 1"),
        ("pretrained/r4", {"tote_sizes": (6, 6, 5)}, "tote_sizes"),
        ("pretrained/r4", {"device": "abacus"}, "device=abacus: expected cpu"),
        ("pretrained/r4", {"trust": "torch"}, "trust='torch': expected names of modules of your own"),
    ],
)
def test_bad_arguments_are_refused(path, settings, message):
    with pytest.raises(ValueError, match=message):
        load_policy(path, **settings)


@pytest.mark.parametrize("value", [0.25, "x", ["x"]])
def test_a_checkpoint_whose_observation_is_no_mapping_is_refused(smoke_run, tmp_path, value):
    state, facts = checkpoint.read(smoke_run / "checkpoints" / "best")
    facts = {**facts, "config": {**facts["config"], "env": {**facts["config"]["env"], "observation": value}}}
    checkpoint.write(tmp_path / "damaged", state, facts)
    with pytest.raises(ValueError, match=r"env.observation=.*: expected terms by their keys"):
        load_policy(tmp_path / "damaged")
