"""Every preset, every model and every teacher trains."""

import pytest
import torch
from commands import composed, options
from torchrl.modules import ValueOperator

from pickplace import PickPlaceEnv
from pickplace.policies.base import as_collection_policy
from pickplace.policies.fcn_grasp import fcn_grasp
from pickplace.policies.networks.critics import PooledCritic
from pickplace.runs.loggers import read_csv
from pickplace.training.train import make_losses, train

TINY = [
    "env.num_envs=4", "algo.rollout_length=4", "algo.minibatch_size=8", "algo.epochs=1", "total_frames=32",
    "evaluation.episodes=2", "evaluation_interval=16", "checkpoint_interval=16", "progress_interval=16",
    "env.tote_size=[6,6,2]", "model.actor.filters=8", "model.critic.filters=8", "model.critic.hidden=8", "threads=1",
]  # fmt: skip


@pytest.mark.parametrize("name", options("experiment"))
def test_every_preset_runs(name, tmp_path):
    extra = {"smoke": ["env.tote_size=[4,4,1]"], "mixed": ["env.tote_size=[7,7,3]"]}.get(name, [])
    occupancy = train(composed(f"experiment={name}", *TINY, *extra), tmp_path)
    assert 0 <= occupancy <= 1
    assert [row["frames"] for row in read_csv(tmp_path / "metrics.csv")] == [16, 32]
    files = {".lock", "checkpoints", "learning_curve.png", "metrics.csv", "report.html"}
    assert {path.name for path in tmp_path.iterdir()} == files


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("model", options("model"))
def test_every_model_trains_with_and_without_a_mask(model, masked, tmp_path):
    overrides = [f"model={model}", f"algo.mask_infeasible={masked}", "curriculum=none", "logger=none", *TINY]
    overrides += ["env.rotations=2", "total_frames=16"]
    assert 0 <= train(composed(*overrides), tmp_path) <= 1


@pytest.mark.parametrize("name", [*options("planner"), "none"])
def test_any_planner_can_be_imitated(name, tmp_path):
    settings = {
        "mcts": ["warm_start.teacher.simulations=20"],
        "lookahead": ["warm_start.teacher.samples=2", "warm_start.teacher.rounds=1"],
    }
    follows = ["warm_start.checkpoint=pretrained/r4"] if name in ("policy", "lookahead") else []
    phases = [f"warm_start.{key}=16" for key in ("frames", "critic_frames")] if name != "none" else []
    overrides = [f"warm_start={name}", *settings.get(name, []), *follows, *phases, *TINY]
    cfg = composed("curriculum=none", *overrides, "total_frames=48")
    assert 0 <= train(cfg, tmp_path) <= 1
    rows = read_csv(tmp_path / "metrics.csv")
    assert ["train/agreement" in row for row in rows] == [name != "none", False, False]


def test_a2c_trains_through_the_same_loop(tmp_path):
    cfg = composed("algo=a2c", "model=fcn_grasp", "curriculum=none", *TINY)
    assert 0 <= train(cfg, tmp_path) <= 1
    assert (cfg.algo.loss, cfg.algo.gamma) == ("a2c", composed().algo.gamma)


def test_ppo_begins_where_a2c_is():
    """At the policy that collected the data the ratio is 1, and the clipped objective has the gradient of A2C's."""
    env = PickPlaceEnv(num_envs=16, masks=("footprint",))
    policy = fcn_grasp(env.cell, True, head_std=1.0)
    critic = ValueOperator(PooledCritic(), ["bin_depth", "tote_depth"])
    with torch.no_grad():
        data = env.rollout(4, as_collection_policy(policy), break_when_any_done=False).reshape(-1)
    gradients = {}
    for algo in ("ppo", "a2c"):
        cfg = composed(f"algo={algo}", "algo.normalize_advantage=false").algo
        advantage, loss = make_losses(cfg, policy, critic)
        with torch.no_grad():
            advantage(data)
        policy.zero_grad()
        loss(data)["loss_objective"].backward()
        gradients[algo] = torch.cat(
            [parameter.grad.flatten() for parameter in loss.parameters() if parameter.grad is not None]
        )
    assert gradients["ppo"].abs().max() > 0
    torch.testing.assert_close(gradients["ppo"], gradients["a2c"])


def test_the_console_tells_of_a_tote_that_did_not_grow(run):
    settings = ["experiment=smoke", "env.tote_size=[4,4,2]", "curriculum.start_height=1", "curriculum.advance.window=4"]
    for needed, told in ((1.0, True), (0.0, False)):
        threshold = [f"curriculum.advance.occupancy={needed}", f"hydra.run.dir={needed}"]
        code, out, err = run("train", *settings, "curriculum=adaptive", *threshold)
        assert code == 0, err
        assert ("the tote grew to height 1 of 2 only" in out) == told


def test_presets_change_the_training_config():
    assert composed("experiment=smoke").total_frames == 512
    assert composed("experiment=quick", "total_frames=7").total_frames == 7
    paper = composed("experiment=paper")
    assert (paper.algo.lr, paper.algo.gamma, paper.algo.rollout_length, paper.env.num_envs) == (2.5e-4, 0.99, 32, 16)
    assert (paper.algo.critic_coeff, paper.algo.entropy_coeff, paper.algo.mask_infeasible) == (0.005, 0.002, False)
    assert paper.curriculum.advance.frames_per_level == 5_000_000


def test_a_preset_combines_with_any_curriculum():
    for name in options("curriculum"):
        composed("experiment=quick", "env.tote_size=[6,6,10]", f"curriculum={name}", "algo.gamma=0.97", "seed=3")
