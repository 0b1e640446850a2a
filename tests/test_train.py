"""Training: advantages by hand, what each loss and step consists of, and the wiring of stream, slots and curriculum."""

import pytest
import torch
from test_config import composed
from test_faults import slots
from torch import nn
from torchrl.collectors import RandomPolicy
from torchrl.modules import ValueOperator

from pickplace import PickPlaceEnv
from pickplace.evaluation.evaluate import play
from pickplace.planners import JointDBL
from pickplace.policies.actors import as_collection_policy, fcn_grasp
from pickplace.policies.networks.critics import PooledCritic
from pickplace.runs import checkpoint
from pickplace.runs.loggers import read_csv
from pickplace.runs.registry import build
from pickplace.training import collectors as collector
from pickplace.training import train
from pickplace.training.curriculum import Current, Curriculum, NoAdvance
from pickplace.training.imitation import Phase, imitation_loss
from pickplace.training.train import learning_rate, make_losses, training_env, update


class Judgement(nn.Module):
    """A value that can be told by hand."""

    def __init__(self):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(0.1))

    def forward(self, bin_depth, tote_depth):
        return self.scale * tote_depth.mean((-2, -1))[..., None]


def collected(policy, env, steps=6):
    with torch.no_grad():
        return env.rollout(steps, as_collection_policy(policy), break_when_any_done=False)


def test_advantages_by_hand():
    env = PickPlaceEnv(num_envs=8, masks=("outcome",), tote_size=(4, 4, 1))
    policy = fcn_grasp(env.rules, True)
    cfg = composed("algo.gamma=0.9", "algo.lmbda=0.5").algo
    batch = collected(policy, env)
    advantage, _ = make_losses(cfg, policy, ValueOperator(Judgement(), ["bin_depth", "tote_depth"]))
    with torch.no_grad():
        advantage(batch)
    value, following = (0.1 * depth.mean((-2, -1)) for depth in (batch["tote_depth"], batch["next", "tote_depth"]))
    goes_on = ~batch["next", "done"][..., 0]
    assert 0 < goes_on.sum() < goes_on.numel()
    expected, later = torch.zeros_like(value), torch.zeros(8)
    for step in reversed(range(6)):
        surprise = batch["next", "reward"][:, step, 0] + 0.9 * following[:, step] * goes_on[:, step] - value[:, step]
        later = surprise + 0.9 * 0.5 * later * goes_on[:, step]
        expected[:, step] = later
    torch.testing.assert_close(batch["advantage"][..., 0], expected)
    torch.testing.assert_close(batch["value_target"][..., 0], expected + value)


@pytest.mark.parametrize("algo", ["ppo", "a2c"])
def test_losses_are_weighted_as_the_config_says(algo):
    env = PickPlaceEnv(num_envs=8, masks=("outcome",), tote_size=(4, 4, 1))
    policy, critic = fcn_grasp(env.rules, True), ValueOperator(Judgement(), ["bin_depth", "tote_depth"])
    cfg = composed(f"algo={algo}", "algo.entropy_coeff=0.3", "algo.critic_coeff=0.05").algo
    advantage, loss = make_losses(cfg, policy, critic)
    data = collected(policy, env).reshape(-1)
    with torch.no_grad():
        advantage(data)
        losses, value = loss(data), 0.1 * data["tote_depth"].mean((-2, -1))[..., None]
    torch.testing.assert_close(losses["loss_entropy"], -0.3 * losses["entropy"])
    torch.testing.assert_close(losses["loss_critic"], 0.05 * (value - data["value_target"]).square().mean())


@pytest.mark.parametrize("limit", [1e-3, 1e9])
@pytest.mark.parametrize("phase", Phase)
def test_a_step_follows_what_its_phase_learns_from(phase, limit):
    """The policy from reward or its teacher, the critic always; no further than the greatest norm of a gradient."""
    env = PickPlaceEnv(num_envs=8, masks=("outcome",), tote_size=(4, 4, 1))
    policy = fcn_grasp(env.rules, True, filters=8, hidden=8, head_std=1.0, compute_dtype="float32")
    critic = ValueOperator(PooledCritic(filters=8, hidden=8, compute_dtype="float32"), ["bin_depth", "tote_depth"])
    cfg = composed(
        "algo.entropy_coeff=0.3", "algo.epochs=1", "algo.minibatch_size=64", f"algo.max_grad_norm={limit}"
    ).algo
    advantage, loss = make_losses(cfg, policy, critic)
    data = collected(policy, env).reshape(-1)
    with torch.no_grad():
        advantage(data)
    data["taught"] = data["outcome"]
    losses = loss(data)
    total = {
        Phase.REWARD: losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"],
        Phase.CRITIC: losses["loss_critic"],
        Phase.IMITATION: losses["loss_critic"] + imitation_loss(policy, data)[0],
    }[phase]
    before = [parameter.detach().clone() for parameter in loss.parameters()]
    gradients = torch.autograd.grad(total, list(loss.parameters()), allow_unused=True)
    gradients = [torch.zeros_like(b) if g is None else g for b, g in zip(before, gradients, strict=True)]
    norm = torch.cat([g.flatten() for g in gradients]).norm()
    step = 1 / min(limit, norm.item())  # so that the parameters move by 1, whatever the limit
    update(loss, torch.optim.SGD(loss.parameters(), lr=step), data, cfg, policy, phase)
    for parameter, old, gradient in zip(loss.parameters(), before, gradients, strict=True):
        torch.testing.assert_close(
            old - parameter.detach(), gradient * step * min(1, limit / norm), rtol=1e-2, atol=1e-5
        )


def test_the_learning_rate_falls_linearly_over_the_last_part():
    algo = composed("algo.lr=0.2", "algo.lr_decay_start=0.75").algo
    rates = [learning_rate(algo, frames, 1000) for frames in (0, 750, 875, 1000, 1100)]
    assert rates == pytest.approx([0.2, 0.2, 0.1, 0, 0])
    assert learning_rate(composed("algo.lr=0.2", "algo.lr_decay_start=null").algo, 1000, 1000) == 0.2


def test_the_learner_sees_scaled_rewards_and_the_log_shows_volumes(smoke, tmp_path):
    rows = []
    for scale in (0.5, 5):
        settings = [
            f"algo.reward_scale={scale}",
            "total_frames=128",
            "algo.minibatch_size=128",
            "evaluation.episodes=1",
        ]
        smoke(tmp_path / str(scale), *settings)
        rows.append(read_csv(tmp_path / str(scale) / "metrics.csv")[0])
    low, high = rows
    assert low["train/reward"] == high["train/reward"] > 0
    # At first the critic hardly says anything: its error is the return, squared.
    assert high["train/loss_critic"] / low["train/loss_critic"] == pytest.approx(100, rel=0.3)


def test_best_is_the_best_validation_and_not_the_last(smoke, tmp_path, monkeypatch):
    found = iter([0.5, 0.8, 0.6, 0.7])
    told = {"ci95_low": 0.0, "ci95_high": 1.0}
    monkeypatch.setattr(train, "validation_metrics", lambda _: {"occupancy": next(found), **told})
    assert smoke(tmp_path / "run", "evaluation_interval=128") == 0.7
    best, last = (checkpoint.read(tmp_path / "run" / "checkpoints" / name)[1] for name in ("best", "last"))
    assert (best["frames"], best["best"], last["frames"], last["best"]) == (256, 0.8, 512, 0.8)


def test_train_occupancy_is_that_of_the_episodes_that_ended():
    env = PickPlaceEnv(num_envs=8, masks=("action",), tote_size=(4, 4, 1))
    batch = env.rollout(12, break_when_any_done=False)
    done = batch["next", "done"][..., 0]
    metrics = train.episode_metrics(batch)
    assert metrics["train/episodes"] == done.sum() > 0
    assert metrics["train/occupancy"] == pytest.approx(batch["next", "occupancy"][done].mean().item())
    assert sum(value for key, value in metrics.items() if "failure_" in key) == pytest.approx(1)


def test_the_slots_of_all_workers_share_the_episodes_of_a_stream():
    """Each is played once, by one of them."""
    curriculum = Curriculum(NoAdvance(), Current())
    curriculum.setup(1, 2, 100)
    cfg = composed("env.tote_size=[4,4,2]")
    env_config, items = {k: v for k, v in cfg.env.items() if k != "num_envs"}, build("items", cfg["items"])
    played = []
    for first in (0, 2):
        env = training_env(env_config, items, "cpu", ("outcome",), 4, curriculum, first_episode=first, num_envs=2)
        env.set_seed(0)
        for _ in range(3):
            env.reset()
            played += env.base_env.episode.tolist()
    assert sorted(played) == list(range(12))


def test_each_worker_has_slots_of_its_own():
    policy = RandomPolicy(PickPlaceEnv(num_envs=2).action_spec)
    made = collector.multi_sync(slots, policy, num_envs=4, rollout_length=2, seed=0)
    try:
        workers = [state for name, state in made.state_dict().items() if name.startswith("worker")]
        episodes = [worker["environment"]["episode"].tolist() for worker in workers]
    finally:
        made.shutdown()
    assert episodes == [[0, 1], [2, 3]]


def test_validation_plays_its_own_stream_at_full_height():
    cfg = composed("experiment=smoke", "env.tote_size=[4,4,2]", "evaluation.seed=3", "seed=5", "evaluation.episodes=6")
    items = build("items", cfg["items"])

    def build_env(**settings):
        return build("env", cfg.env, items=items, **settings)

    def make_env(first, count):
        return PickPlaceEnv(
            tote_size=(4, 4, 2), stream="validation", seed=3, num_envs=count, first_episode=first, masks=()
        )

    planner = JointDBL(make_env(0, 1).rules)
    found = train.validate(cfg, build_env, planner)
    assert torch.equal(found.occupancy, play(make_env, planner, 6, 6).occupancy) and (found.tote_height == 2).all()


def test_the_curriculum_counts_the_frames_of_the_batch_at_hand(smoke, tmp_path):
    levels = ["curriculum=paper", "curriculum.advance.frames_per_level=256", "env.tote_size=[4,4,3]"]
    smoke(tmp_path, *levels, "evaluation.episodes=1")
    rows = read_csv(tmp_path / "metrics.csv")
    assert [(row["frames"], row["curriculum/level"]) for row in rows] == [(128, 1), (256, 2), (384, 2), (512, 3)]


@pytest.mark.parametrize("wanted", [True, False])
@pytest.mark.parametrize("algo", ["ppo", "a2c"])
def test_advantages_are_normalised_where_the_config_says_so(algo, wanted):
    """Twice the reward is then the same gradient for the policy, and twice as much of it else."""
    env = PickPlaceEnv(num_envs=8, masks=("outcome",), tote_size=(4, 4, 1))
    policy, critic = fcn_grasp(env.rules, True, head_std=1.0, compute_dtype="float32"), Judgement()
    critic.scale.data.zero_()
    cfg = composed(f"algo={algo}", f"algo.normalize_advantage={wanted}").algo
    advantage, loss = make_losses(cfg, policy, ValueOperator(critic, ["bin_depth", "tote_depth"]))
    data, gradients = collected(policy, env), []
    for _ in range(2):
        with torch.no_grad():
            advantage(data)
        policy.zero_grad()
        loss(data.reshape(-1))["loss_objective"].backward()
        gradients.append(torch.cat([part.grad.flatten() for part in loss.parameters() if part.grad is not None]))
        data["next", "reward"] = 2 * data["next", "reward"]
    torch.testing.assert_close(gradients[1], gradients[0] * (1 if wanted else 2), rtol=1e-3, atol=1e-5)
