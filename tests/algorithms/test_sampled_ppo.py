"""Advantages of the choices that were drawn, against steps of the environment."""

import pytest
import torch
from commands import TINY, algorithm_of, composed
from problems import late_state
from tensordict import TensorDict
from torch import nn
from torchrl.modules import ValueOperator

from pickplace.algorithms.base import BatchPosition
from pickplace.algorithms.sampled_ppo import SampledPPO, taken_choice_advantages
from pickplace.algorithms.sampled_softmax import CANDIDATE_KEYS, as_sampling_policy, draw_candidates
from pickplace.policies.base import Policy
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.policies.individual.policy import IndividualRl
from pickplace.rules.observation import RESERVED
from pickplace.training.train import train


def value_by_hand(bin_depth, tote_depth):
    return 1 + tote_depth.mean((-2, -1))[..., None] + bin_depth.mean((-2, -1))[..., None]


class MeanDepth(nn.Module):
    """A value that is computed by hand."""

    def forward(self, bin_depth, tote_depth):
        return value_by_hand(bin_depth, tote_depth)


CRITIC = ValueOperator(MeanDepth(), ["bin_depth", "tote_depth"])
SETTINGS = [
    "algo=sampled_ppo",
    "algo.gamma=0.9",
    "reward_scale=0.5",
    "algo.normalize_advantage=false",
    "algo.minibatch_size=7",
]


def drawn(kind, steps):
    """Return an environment in the middle of its episodes, a policy, and frames with candidates and what followed."""
    torch.manual_seed(0)
    env, observation = late_state(steps, masks=("action",), bin_size=(5, 5, 1), tote_size=(5, 5, 2), num_envs=24)
    policy = kind(env.cell, filters=4, head_std=1.0)
    choices = as_sampling_policy(policy, 40, 1.0)(observation.clone())
    frames, saved = observation.clone().update(choices), {key: value.clone() for key, value in env.state_dict().items()}
    frames["next"] = env.step(frames.clone())["next"]
    env.load_state_dict(saved)
    return env, policy, frames


@pytest.mark.parametrize("kind", [Fcn4d, IndividualRl])
def test_no_term_may_have_the_name_of_what_is_learned_from(kind):
    env, policy, frames = drawn(kind, 1)
    algorithm = algorithm_of(policy, CRITIC, *SETTINGS)
    data = algorithm.prepare(frames.detach().unsqueeze(1), BatchPosition(0, 24, 1, 24))
    algorithm.objective(data)
    assert {*CANDIDATE_KEYS, "advantage"} <= {*data.keys()} <= {*RESERVED, *env.terms}


@pytest.mark.parametrize("kind", [Fcn4d, IndividualRl])
def test_advantages_are_those_of_single_steps(kind, monkeypatch):
    """The item that follows is that of a frame in turn, instead of one drawn at random."""
    env, policy, frames = drawn(kind, 1)
    monkeypatch.setattr(torch, "randint", lambda count, size, **_: torch.arange(*size) % count)
    arrived = frames["next", "bin_depth"][frames["next", "failure"][:, 0] == 0]
    assert 1 < len(arrived) < 24
    arrived = arrived[torch.arange(24) % len(arrived)]
    algorithm = algorithm_of(policy, CRITIC, *SETTINGS)
    got = algorithm.vine_advantages(frames)[..., 0]
    saved, expected = {key: value.clone() for key, value in env.state_dict().items()}, []
    for candidate in frames["candidates"].T:
        after = env.step(frames.clone().set("action", policy.to_action(candidate, frames)))["next"]
        value = 0.5 * after["reward"] + 0.9 * value_by_hand(arrived, after["tote_depth"])
        expected.append(torch.where(after["terminated"], 0.0, value)[:, 0])
        assert not (after["failure"] == 7).any()  # a tote with one item takes any other
        env.load_state_dict({key: value.clone() for key, value in saved.items()})
    expected, weight = torch.stack(expected, 1), frames["candidate_log_weight"].exp().detach()
    assert (expected > 0).any() and (expected == 0).any()
    for gains, weights, advantages in zip(expected, weight, got, strict=True):
        gains = gains - (weights * gains).sum()
        shares = [float(w) * 41 for w in weights]
        shares = [max(w, min(1, w**0.5)) if gain > 0 else w for w, gain in zip(shares, gains, strict=True)]
        torch.testing.assert_close(advantages, gains * torch.tensor(shares))
    algorithm.normalize_advantage = True
    unit = algorithm.vine_advantages(frames)
    torch.testing.assert_close(unit[..., 0], got / got.square().mean().sqrt())


def test_nothing_follows_where_the_next_item_has_no_place():
    """Each tote is full but for a cell that the item fills."""
    _, policy, frames = drawn(Fcn4d, 1)
    for key in ("tote_depth", "bin_depth"):
        frames[key] = torch.zeros(24, 5, 5)
        frames[key][:, 2, 2] = 1.0
    frames["tote_height"] = torch.full((24, 1), 2)
    middle, elsewhere = (12 * 25 + 12) * 4, 12 * 25 * 4
    frames["candidates"] = torch.tensor([[middle, elsewhere]]).expand(24, 2).clone()
    frames["candidate_log_weight"] = torch.tensor([0.5, 0.5]).log().expand(24, 2).clone()
    got = algorithm_of(policy, CRITIC, *SETTINGS).vine_advantages(frames)
    torch.testing.assert_close(got[..., 0], torch.tensor([[0.25, -0.25]]).expand(24, 2))


class Fixed(Policy):
    """The same logits in every state."""

    choice_key = "action"
    to_action = to_choice = action_log_probs = lambda self, *_: _[0]

    def __init__(self, cell, logits):
        super().__init__(cell)
        self.values = nn.Parameter(logits)

    def logits(self, observation):
        return self.values.expand(len(observation["bin_depth"]), -1)


@pytest.mark.parametrize(("samples", "frames", "error"), [(6, 5, 1e-6), (9, 5, 1e-6), (3, 100_000, 0.02)])
def test_the_loss_has_the_policy_gradient(samples, frames, error):
    """Of 7 choices: exactly once all are candidates, else on average, a little short."""
    torch.manual_seed(samples)
    env, observation = late_state(1)
    policy, state = Fixed(env.cell, torch.randn(7)), observation[:1].expand(frames)
    keys = draw_candidates(policy.values.detach().expand(frames, 7), samples, 1.0)
    data = TensorDict({**state, **dict(zip(CANDIDATE_KEYS, keys, strict=True))}, [frames])
    value, weight = torch.randn(7), data["candidate_log_weight"].exp()
    gain = value[data["candidates"]]
    data["advantage"] = ((gain - (weight * gain).sum(1, keepdim=True)) * weight * weight.shape[1])[..., None]
    data["action"], data["value_target"] = data["candidates"][:, 0], torch.zeros(frames, 1)
    _, losses = algorithm_of(policy, CRITIC, "algo=sampled_ppo", "algo.samples=3").objective(data)
    chance = policy.values.detach().softmax(0)
    wanted = -chance * (value - (chance * value).sum())
    got = torch.autograd.grad(losses["loss_objective"], policy.values, retain_graph=True)[0]
    scale = (got * wanted).sum() / wanted.square().sum()
    torch.testing.assert_close(got / scale, wanted, rtol=0, atol=error)
    assert 0.8 < scale < 1 + error and (samples == 3 or scale > 1 - error)
    (entropy,) = torch.autograd.grad(losses["loss_entropy"], policy.values)
    torch.testing.assert_close(
        entropy, 0.002 * chance * (chance.log() - (chance * chance.log()).sum()), rtol=0, atol=max(error, 1e-6) * 0.02
    )


def test_with_every_choice_a_candidate_and_gae_the_loss_is_the_exact_one():
    """Gradients equal those of TorchRL's loss over all logits, also where the policy has changed since."""
    torch.manual_seed(0)
    env, observation = late_state(1)
    frames, earlier = 64, torch.randn(7).log_softmax(0)
    policy, gae = Fixed(env.cell, earlier + 0.3 * torch.randn(7)), torch.randn(frames, 1)
    keys = draw_candidates(earlier.expand(frames, 7), 6, 1.0)
    data = TensorDict({**observation[:1].expand(frames), **dict(zip(CANDIDATE_KEYS, keys, strict=True))}, [frames])
    data["action"], data["value_target"], data["advantage"] = keys[0][:, 0], torch.zeros(frames, 1), gae
    data["log_prob"] = keys[1][:, 0]
    gradients = []
    for name in ("ppo", "sampled_ppo"):
        if name == "sampled_ppo":
            data["advantage"] = taken_choice_advantages(gae, 7, normalize=True)
        _, losses = algorithm_of(policy, CRITIC, f"algo={name}").objective(data)
        total = losses["loss_objective"] + losses["loss_entropy"]
        gradients += torch.autograd.grad(total, policy.values)
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize(("advantages", "counted"), [("vine", 4), ("gae", 1)])
def test_a_training_learns_from_every_candidate_or_the_taken_one(advantages, counted, monkeypatch, tmp_path):
    batches, descend = [], SampledPPO.descend
    monkeypatch.setattr(SampledPPO, "descend", lambda self, *args: batches.append(args[0]) or descend(self, *args))
    settings = ["curriculum=none", "logger=none", "algo=sampled_ppo", "algo.samples=3", f"algo.advantages={advantages}"]
    train(composed("model=fcn4d", *settings, *TINY), tmp_path)
    assert [batch["advantage"].shape for batch in batches] == [(16, 4, 1)]
    assert batches[0]["advantage"][:, :counted].all() and not batches[0]["advantage"][:, counted:].any()
