"""The softmax over sampled choices, against the exact one."""

import itertools

import pytest
import torch
from problems import random_states
from tensordict import TensorDict
from test_policies import CELLS, POLICIES, every_policy, small
from torch.distributions import Categorical

from pickplace.policies.base import Policy, as_collection_policy
from pickplace.policies.fcn4d import ActionPolicy
from pickplace.policies.networks.conv4d import Conv4dPolicy
from pickplace.policies.sampled_softmax import CANDIDATE_KEYS, SampledSoftmax, as_sampled_actor, as_sampling_policy


def random_logits(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, requires_grad=True)


def gradients(value: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
    return torch.autograd.grad(value, logits, retain_graph=True)[0]


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_the_expected_gradient_is_a_share_of_the_exact_one(samples):
    """Expectations are sums over every tuple of candidates, weighted by its probability."""
    torch.manual_seed(samples)
    logits, weight = random_logits(4), torch.randn(4, dtype=torch.float64)
    exact, old = Categorical(logits=logits), torch.log_softmax(logits.detach(), 0)
    tuples = torch.tensor(list(itertools.product(range(4), repeat=1 + samples)))
    estimated = SampledSoftmax(logits[tuples], old[tuples])
    chance = old[tuples].sum(1).exp()
    share = samples / (1 + samples)
    objective = (chance * weight[tuples[:, 0]] * estimated.log_prob(tuples[:, 0])[:, 0]).sum()
    expected = (exact.probs.detach() * weight * exact.logits).sum()
    torch.testing.assert_close(gradients(objective, logits), share * gradients(expected, logits))
    entropy = (chance * estimated.entropy()).sum()
    torch.testing.assert_close(gradients(entropy, logits), share * gradients(exact.entropy(), logits))


def test_many_samples_give_the_exact_distribution_of_a_changed_policy():
    torch.manual_seed(0)
    old, new = Categorical(logits=random_logits(6).detach()), Categorical(logits=random_logits(6).detach())
    candidates = old.sample((200_000,))
    estimated = SampledSoftmax(new.logits[candidates][None] + 3.0, old.logits[candidates][None])
    assert estimated.log_prob(candidates[:1])[0, 0].item() == pytest.approx(new.logits[candidates[0]].item(), abs=0.02)
    assert estimated.entropy().item() == pytest.approx(new.entropy().item(), abs=0.02)


@pytest.mark.parametrize("options", CELLS)
@every_policy
def test_logits_of_some_choices_are_those_of_all(kind, options):
    for env, observation in random_states(steps=3, masks=("action", "footprint"), **options):
        policy = small(kind, env.cell)
        logits = policy.logits(observation)
        choices = torch.distributions.Categorical(logits=logits).sample((7,)).T
        wanted, got = logits.gather(1, choices), policy.choice_logits(observation, choices)
        torch.testing.assert_close(got - got[:, :1], wanted - wanted[:, :1], rtol=1e-4, atol=1e-4)


def test_logits_of_some_choices_of_a_masked_policy():
    for env, observation in random_states(steps=3, masks=("action",), **CELLS[1]):
        policy = ActionPolicy(env.cell, True, **POLICIES[ActionPolicy])
        logits = policy.logits(observation)
        choices = torch.distributions.Categorical(logits=logits).sample((7,)).T
        assert observation["action_mask"].gather(1, choices).all()
        torch.testing.assert_close(policy.choice_logits(observation, choices), logits.gather(1, choices))


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_logits_of_single_actions_and_their_gradients(dtype):
    torch.manual_seed(0)
    network = Conv4dPolicy(3, filters=5, compute_dtype=dtype, head_std=0.5)
    bins, totes = torch.randint(0, 2, (70, 4, 3)).float(), torch.randint(0, 4, (70, 5, 6)).float()
    actions = [torch.randint(0, count, (280,)) for count in (12, 30, 3)]  # more windows than computed at once
    row, weights = torch.randint(0, 70, (280,)), torch.rand(280)
    single = network.action_logits(bins, totes, row, actions)
    every = network(bins, totes).view(70, 12, 30, 3)[row, *actions]
    tolerance = {"float32": 1e-5, "bfloat16": 3e-2}[dtype]
    torch.testing.assert_close(single, every, rtol=tolerance, atol=tolerance)
    for ours, wanted in zip(
        *(torch.autograd.grad((out * weights).sum(), list(network.parameters())) for out in (single, every)),
        strict=True,
    ):
        torch.testing.assert_close(ours, wanted, rtol=tolerance, atol=tolerance * wanted.abs().max().item())


@every_policy
def test_the_collector_s_candidates_are_drawn_from_the_policy(kind):
    env, observation = next(iter(random_states(masks=("action", "footprint"), **CELLS[0])))
    policy = small(kind, env.cell)
    frame = as_sampling_policy(policy, 5)(observation.clone())
    candidates, log_prob = (frame[key] for key in CANDIDATE_KEYS)
    assert candidates.shape == log_prob.shape == (env.num_envs, 6)
    assert (
        torch.equal(frame[policy.choice_key], policy.to_choice(frame["action"], observation))
        or kind is not ActionPolicy
    )
    assert torch.equal(candidates[:, 0], frame[policy.choice_key]) and torch.equal(log_prob[:, 0], frame["log_prob"])
    exact = Categorical(logits=policy.logits(observation))
    torch.testing.assert_close(log_prob, exact.logits.gather(1, candidates))
    wanted = set(as_collection_policy(policy)(observation.clone()).keys()) | set(CANDIDATE_KEYS)
    assert set(frame.keys()) == wanted
    # Before any step the ratio of PPO is 1.
    again = as_sampled_actor(policy).get_dist(TensorDict({**observation, **frame}, env.batch_size))
    torch.testing.assert_close(again.log_prob(frame[policy.choice_key]), log_prob, rtol=1e-3, atol=1e-3)


def test_candidates_follow_the_distribution():
    class Fixed(Policy):
        choice_key = "action"
        to_action = to_choice = action_log_probs = lambda self, *_: _[0]

        def logits(self, observation):
            return torch.tensor([0.1, 0.2, 0.7]).log().expand(20_000, 3)

    env, observation = next(iter(random_states(masks=("action",), **CELLS[0])))
    frame = as_sampling_policy(Fixed(env.cell), 3)(observation[:1].expand(20_000).clone())
    share = torch.stack([(frame["candidates"] == choice).float().mean(0) for choice in range(3)])
    torch.testing.assert_close(share, torch.tensor([[0.1], [0.2], [0.7]]).expand(3, 4), rtol=0, atol=0.015)
