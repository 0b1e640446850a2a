"""Training: advantages by hand, what each loss and step consists of, and the wiring of stream, slots and curriculum."""

import logging
from copy import deepcopy
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from commands import TINY, algorithm_of, composed
from torch import nn
from torchrl.modules import ValueOperator

from pickplace import CellSpec, PickPlaceEnv
from pickplace.algorithms.actor_critic import ActorCritic
from pickplace.algorithms.base import BatchPosition
from pickplace.algorithms.imitation import Imitation, imitation_loss
from pickplace.common.graphs import NO_COMPILE
from pickplace.config.registry import build
from pickplace.evaluation.play import play
from pickplace.planners.heuristics import JointDBL
from pickplace.policies.base import as_collection_policy, as_critic
from pickplace.policies.critics import Pooled
from pickplace.policies.fcn_grasp.policy import fcn_grasp
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate
from pickplace.runs.loggers import read_csv
from pickplace.training import trainer
from pickplace.training.collectors import ResumableCollector
from pickplace.training.curriculum.advance import NoAdvance
from pickplace.training.curriculum.curriculum import Curriculum
from pickplace.training.curriculum.sample import Current
from pickplace.training.progress import has_passed
from pickplace.training.train import train
from pickplace.training.trainer import Trainer, episode_metrics, training_env

OBSERVED = ["bin_depth", "tote_depth"]  # by a critic
POSITION = BatchPosition(0, 48, 1, 1000)


class MeanDepthCritic(nn.Module):
    """A value that is computed by hand: a tenth of the mean tote depth."""

    def __init__(self):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(0.1))

    def forward(self, bin_depth, tote_depth):
        return self.scale * tote_depth.mean((-2, -1))[..., None]


class MaskCritic(nn.Module):
    """A value that follows from the number of feasible choices."""

    def __init__(self, cell):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(0.1))

    def forward(self, mask):
        return self.scale * mask.float().mean(-1, keepdim=True)


@pytest.mark.parametrize(
    ("key", "message"),
    [("footprint_mask", None), ("action_mask", r"model.critic: its masks=.*: expected among \['footprint_mask'\]")],
)
def test_a_critic_may_read_the_masks_of_the_policy(key, message, tmp_path, monkeypatch, no_report):
    """GAE also values the next state, whose mask a batch does not hold otherwise."""
    monkeypatch.setattr(MaskCritic, "in_keys", (key,), raising=False)
    words = [word for word in TINY if not word.startswith("model.critic")]
    cfg = composed(*words, "curriculum=none", "total_frames=32", "trust=test_loop")
    cfg.model.critic = {"_target_": "test_loop.MaskCritic"}
    if message:
        with pytest.raises(ValueError, match=message):
            trainer.Trainer(cfg, tmp_path)
    else:
        train(cfg, tmp_path)
        assert checkpoint.read(locate(tmp_path))[0]["critic"]["module.scale"] != 0.1


@pytest.fixture(scope="module")
def collected():
    """Policy and batch [8, 6] of a small tote."""
    torch.manual_seed(0)
    env = PickPlaceEnv(num_envs=8, masks=("footprint",), tote_size=(4, 4, 1))
    policy = fcn_grasp(env.cell, True, filters=8, hidden=8, head_std=1.0, compute_dtype="float32")
    with torch.no_grad():
        return policy, env.rollout(6, as_collection_policy(policy), break_when_any_done=False)


# --- advantages, losses, steps


def test_advantages_by_hand(collected):
    policy, batch = collected[0], collected[1].clone()
    critic = ValueOperator(MeanDepthCritic(), OBSERVED)
    algorithm_of(policy, critic, "algo.gamma=0.9", "algo.lmbda=0.5", "reward_scale=0.25").prepare(batch, POSITION)
    value, following = (0.1 * depth.mean((-2, -1)) for depth in (batch["tote_depth"], batch["next", "tote_depth"]))
    reward, goes_on = 0.25 * collected[1]["next", "reward"][..., 0], ~batch["next", "done"][..., 0]
    assert 0 < goes_on.sum() < goes_on.numel()
    expected, later = torch.zeros_like(value), torch.zeros(8)
    for step in reversed(range(6)):
        surprise = reward[:, step] + 0.9 * following[:, step] * goes_on[:, step] - value[:, step]
        later = surprise + 0.9 * 0.5 * later * goes_on[:, step]
        expected[:, step] = later
    torch.testing.assert_close(batch["advantage"][..., 0], expected)
    torch.testing.assert_close(batch["value_target"][..., 0], expected + value)


@pytest.mark.parametrize("algo", ["ppo", "a2c"])
def test_losses_are_weighted_as_the_config_says(collected, algo):
    policy, data = collected[0], collected[1].reshape(-1)
    words = [f"algo={algo}", "algo.entropy_coeff=0.3", "algo.critic_coeff=0.05"]
    made = algorithm_of(policy, ValueOperator(MeanDepthCritic(), OBSERVED), *words)
    with torch.no_grad():
        made.advantage(data)
        losses, value = made.objective(data)[1], 0.1 * data["tote_depth"].mean((-2, -1))[..., None]
    torch.testing.assert_close(losses["loss_entropy"], -0.3 * losses["entropy"])
    torch.testing.assert_close(losses["loss_critic"], 0.05 * (value - data["value_target"]).square().mean())


@pytest.mark.parametrize("wanted", [True, False])
@pytest.mark.parametrize("algo", ["ppo", "a2c"])
def test_advantages_are_normalised_where_the_config_says_so(collected, algo, wanted):
    """Then twice the reward has the same gradient for the policy, otherwise twice the gradient."""
    policy, critic, data = collected[0], MeanDepthCritic(), collected[1].clone()
    critic.scale.data.zero_()
    words = [f"algo={algo}", f"algo.normalize_advantage={wanted}"]
    made = algorithm_of(policy, ValueOperator(critic, OBSERVED), *words)
    gradients = []
    for _ in range(2):
        with torch.no_grad():
            made.advantage(data)
        policy.zero_grad()
        made.objective(data.reshape(-1))[1]["loss_objective"].backward()
        gradients.append(torch.cat([part.grad.flatten() for part in made.parameters if part.grad is not None]))
        data["next", "reward"] = 2 * data["next", "reward"]
    torch.testing.assert_close(gradients[1], gradients[0] * (1 if wanted else 2), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("limit", [1e-3, 1e9])
@pytest.mark.parametrize("phase", ["reward", "critic", "imitation"])
def test_a_step_follows_what_its_phase_learns_from(phase, limit, collected):
    """The policy from reward or its teacher, the critic always; no further than the greatest norm of a gradient."""
    policy, data = deepcopy(collected[0]), collected[1].reshape(-1)
    critic = as_critic(Pooled(CellSpec(), filters=8, hidden=8, compute_dtype="float32"))
    words = ["algo.entropy_coeff=0.3", "algo.epochs=1", "algo.minibatch_size=64", "algo.lr_decay_start=null"]
    made = algorithm_of(policy, critic, *words, f"algo.max_grad_norm={limit}")
    with torch.no_grad():
        made.advantage(data)
    if phase == "imitation":
        data["taught"] = data["footprint"]
    _, losses = made.objective(data)
    total = losses["loss_critic"]
    if phase == "reward":
        total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
    elif phase == "imitation":
        total = total + imitation_loss(policy, data)[0]
    before = [parameter.detach().clone() for parameter in made.parameters]
    gradients = torch.autograd.grad(total, made.parameters, allow_unused=True)
    gradients = [torch.zeros_like(b) if g is None else g for b, g in zip(before, gradients, strict=True)]
    norm = torch.cat([g.flatten() for g in gradients]).norm()
    made.lr = step = 1 / min(limit, norm.item())  # so that the parameters move by 1, whatever the limit
    made.optimizer = torch.optim.SGD(made.parameters, lr=1.0)
    objective = made.objective if phase == "reward" else Imitation(made, SimpleNamespace(policy=policy)).objective
    assert made.descend(data, POSITION, objective)["train/lr"] == step
    for parameter, old, gradient in zip(made.parameters, before, gradients, strict=True):
        moved = gradient * step * min(1, limit / norm)
        torch.testing.assert_close(old - parameter.detach(), moved, rtol=1e-2, atol=1e-5)


def test_the_learning_rate_falls_linearly_over_the_last_part(collected):
    critic = ValueOperator(MeanDepthCritic(), OBSERVED)
    falling = algorithm_of(collected[0], critic, "algo.lr=0.2", "algo.lr_decay_start=0.75")
    rates = [falling.learning_rate(BatchPosition(0, frames, 1, 1000)) for frames in (0, 750, 875, 1000, 1100)]
    assert rates == pytest.approx([0.2, 0.2, 0.1, 0, 0])
    constant = algorithm_of(collected[0], critic, "algo.lr=0.2", "algo.lr_decay_start=null")
    assert constant.learning_rate(BatchPosition(0, 1000, 1, 1000)) == 0.2


def test_a_changed_learning_rate_or_budget_begins_the_schedule_anew(collected, caplog):
    """Over the frames that are left, with no batch at rate 0, and exactly in a later resume."""
    critic = ValueOperator(MeanDepthCritic(), OBSERVED)
    caplog.set_level(logging.INFO)

    def resumed(before, lr):
        made = algorithm_of(collected[0], critic, f"algo.lr={lr}", "algo.lr_decay_start=0.5")
        made.load_state_dict(before.state_dict())
        return made

    first = algorithm_of(collected[0], critic, "algo.lr=0.2", "algo.lr_decay_start=0.5")
    first.optimizer.step()
    assert first.learning_rate(BatchPosition(600, 700, 7, 1000)) == pytest.approx(0.12) and not caplog.messages
    assert (
        resumed(first, 0.2).learning_rate(BatchPosition(700, 800, 8, 1000)) == pytest.approx(0.08)
        and not caplog.messages
    )
    second = resumed(first, 0.1)
    rates = [second.learning_rate(BatchPosition(frames, frames + 100, 0, 1000)) for frames in (600, 700, 800, 900)]
    assert rates == pytest.approx([0.1, 0.1, 0.1, 0.05])
    assert caplog.messages == ["600 frames: the learning rate is now 0.1, and falls to 0 from 800 to 1,000 frames"]
    assert resumed(second, 0.1).learning_rate(BatchPosition(900, 1000, 10, 1000)) == pytest.approx(0.05)
    longer = resumed(second, 0.1).learning_rate
    assert [longer(BatchPosition(frames, frames + 1, 0, 2000)) for frames in (1000, 1750)] == pytest.approx([0.1, 0.05])


# --- the loop


def test_intervals_fire_for_any_batch_size():
    fired = [now for now in range(30, 301, 30) if has_passed(now - 30, now, 100)]
    assert fired == [120, 210, 300]


def test_a_run_counts_logs_scales_and_saves(smoke, tmp_path, monkeypatch, no_report):
    """The curriculum counts the batch at hand, ``best`` is the best validation, only the learner's rewards scale."""
    occupancies, rows, pushed = iter([0.5, 0.8, 0.6, 0.7, 0.1]), [], []
    interval = {"ci95_low": 0.0, "ci95_high": 1.0}
    monkeypatch.setattr(trainer, "validation_metrics", lambda _: {"occupancy": next(occupancies), **interval})
    push = "update_policy_weights_"
    monkeypatch.setattr(ResumableCollector, push, lambda collector, weights: pushed.append(collector._frames))
    levels = ["curriculum=paper", "curriculum.advance.frames_per_level=256", "env.tote_size=[4,4,3]"]
    quick = ["algo.minibatch_size=128", "evaluation.episodes=1", "evaluation_interval=128"]
    for scale, frames, final in ((0.5, 512, 0.7), (5, 128, 0.1)):
        overrides = [*levels, *quick, f"reward_scale={scale}", f"total_frames={frames}"]
        assert smoke(tmp_path / str(scale), *overrides) == final
        rows.append(read_csv(tmp_path / str(scale) / "metrics.csv"))
    low, high = rows
    assert [(row["frames"], row["curriculum/level"]) for row in low] == [(128, 1), (256, 2), (384, 2), (512, 3)]
    assert "curriculum/occupancy_at_2" in low[-1]  # the collector was told the level
    assert pushed == [0, 128, 256, 384, 0]  # before each batch; a collector on one CPU shares the weights anyway
    best, last = (checkpoint.read(tmp_path / "0.5" / "checkpoints" / name)[1] for name in ("best", "last"))
    assert (best["frames"], best["best"], last["frames"], last["best"]) == (256, 0.8, 512, 0.8)
    assert low[0]["train/reward"] == high[0]["train/reward"] > 0
    # At first the critic's values are near 0: its error is the return, squared.
    assert high[0]["train/loss_critic"] / low[0]["train/loss_critic"] == pytest.approx(100, rel=0.3)


def test_metrics_are_of_the_episodes_that_ended(collected):
    batch = collected[1]
    done = batch["next", "done"][..., 0]
    metrics = episode_metrics(batch)
    assert metrics["train/episodes"] == done.sum() > 0
    assert metrics["train/occupancy"] == pytest.approx(batch["next", "occupancy"][done].mean().item())
    assert sum(value for key, value in metrics.items() if "failure_" in key) == pytest.approx(1)


def test_the_slots_of_all_workers_share_the_episodes_of_a_stream():
    """Each episode is played once, by one of them."""
    curriculum, cfg, played = Curriculum(NoAdvance(), Current()), composed("env.tote_size=[4,4,2]"), []
    curriculum.setup(CellSpec(tote_size=(4, 4, 2)), build("items", cfg["items"]), 100)
    base_env = partial(PickPlaceEnv, tote_size=(4, 4, 2), items=build("items", cfg["items"]), episode_stride=4)
    for first in (0, 2):
        env = training_env(base_env, curriculum, NO_COMPILE, first_episode=first, num_envs=2)
        env.set_seed(0)
        for _ in range(3):
            env.reset()
            played += env.base_env.episode.tolist()
    assert sorted(played) == list(range(12))


def test_validation_plays_its_own_stream_at_full_height(tmp_path):
    settings = ["env.tote_size=[4,4,2]", "evaluation.seed=3", "seed=5", "evaluation.episodes=6", "threads=1"]
    training = Trainer(composed("experiment=smoke", *settings), tmp_path)

    def make_env(first, count):
        stream = {"stream": "validation", "seed": 3, "first_episode": first}
        return PickPlaceEnv(tote_size=(4, 4, 2), num_envs=count, masks=(), **stream)

    training.planner = JointDBL(make_env(0, 1).cell)
    found = training.validate()
    training.collector.shutdown()
    assert torch.equal(found.occupancy, play(make_env, training.planner, 6, 6).occupancy)
    assert (found.tote_height == 2).all()


def test_a_learner_expects_nothing_after_the_end_of_a_recording(smoke, tmp_path, monkeypatch):
    """Though it truncates: nothing more comes, and no critic learns the value of an empty bin."""
    batches, prepare = [], ActorCritic.prepare

    def recording(algorithm, batch, position):
        data = prepare(algorithm, batch, position)
        batches.append(batch.clone())
        return data

    monkeypatch.setattr(ActorCritic, "prepare", recording)
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n2,1,1\n")
    quick = ["env.tote_size=[5,5,1]", "total_frames=128", "evaluation.episodes=1", "logger=none"]
    smoke(tmp_path / "run", "items=recorded", f"items.path={tmp_path}/items.csv", *quick)
    ended, target = (torch.cat([b[key].flatten() for b in batches]) for key in (("next", "truncated"), "value_target"))
    assert ended.sum() > 20
    torch.testing.assert_close(target[ended], torch.full_like(target[ended], 2 * 0.25))  # 2 cells, by reward_scale


def test_a_training_may_begin_with_the_weights_of_another_one(tmp_path, caplog):
    """For another tote, which is said; a critic that is not among the weights, or does not fit, begins anew."""
    caplog.set_level("INFO")
    words = ["threads=1", "env.num_envs=8", "algo.minibatch_size=16", "env.tote_size=[6,5,2]", "total_frames=64"]
    changed = ["algo.gamma=0.5", "reward_scale=1", "curriculum=none", "curriculum.levels=[{tote_height: 1}, {}]"]
    begun = Trainer(composed(*words, *changed, "warm_start.weights=pretrained/r4"), tmp_path)
    state, _ = checkpoint.read(locate("pretrained/r4"))
    for key, module in (("policy", begun.policy), ("critic", begun.critic)):
        assert module.state_dict().keys() == state[key].keys()
        assert all(torch.equal(value, state[key][name]) for name, value in module.state_dict().items())
    assert begun.frames == 0 and not begun.resumed
    assert "env.tote_size is [6, 5, 2]; those weights were trained with [6, 6, 5]" in caplog.messages
    assert "env.preview is 0" not in caplog.text and "env.tipping is" not in caplog.text  # newer than those weights
    for message in ("algo.gamma is 0.5; those", "reward_scale is 1; those", "curriculum.levels: NoAdvance plays"):
        assert message in caplog.text  # values of the critic; and levels that are never played
    bare = Trainer(composed(*words, "model=fcn4d", "warm_start.weights=pretrained/paper"), tmp_path)
    assert "critic" not in checkpoint.read(locate("pretrained/paper"))[0]
    assert bare.critic.module.value[0].in_features == 64 * (25 + 30) + 2
    narrow = Trainer(composed(*words, "model.critic.hidden=8", "warm_start.weights=pretrained/r4"), tmp_path)
    assert all(map(torch.equal, narrow.policy.parameters(), begun.policy.parameters()))


@pytest.mark.parametrize(("weights", "complaint"), [
    ("pretrained/unknown", "the package ships no such weights; expected pretrained/cdrl_rs"),
    ("outputs/nowhere", "no checkpoint there"),
    ("pretrained/paper", " does not fit these settings"),
    (3, "=3: expected a text"),
])  # fmt: skip
def test_weights_that_do_not_serve_are_refused(weights, complaint, tmp_path):
    with pytest.raises(ValueError, match=f"warm_start.weights.*{complaint}"):
        Trainer(composed("experiment=smoke", f"warm_start.weights={weights}"), tmp_path)
