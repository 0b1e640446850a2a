"""The softmax over sampled choices, against the exact one."""

import pytest
import torch
from problems import random_states
from tensordict import TensorDict
from torch.distributions import Categorical
from untrained import CELLS, POLICIES, every_policy, small

from pickplace.algorithms.sampled_softmax import (
    CANDIDATE_KEYS,
    SampledSoftmax,
    as_sampled_actor,
    as_sampling_policy,
    draw_candidates,
)
from pickplace.policies.base import MASKED, as_collection_policy
from pickplace.policies.fcn4d.network import Conv4dNet
from pickplace.policies.fcn4d.policy import Fcn4d


def random_logits(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, requires_grad=True)


def gradients(value: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
    return torch.autograd.grad(value, logits, retain_graph=True)[0]


@pytest.mark.parametrize("temperature", [1.0, 2.0])
@pytest.mark.parametrize("samples", [5, 8])
def test_with_every_choice_a_candidate_the_softmax_is_exact(samples, temperature):
    """Values and gradients are those of the new policy, whatever the old one was; 8 samples are more than there are."""
    torch.manual_seed(samples)
    old, new = random_logits(3, 6).detach(), random_logits(3, 6)
    candidates, log_prob, log_weight = draw_candidates(old, samples, temperature)
    estimated, exact = SampledSoftmax(new.gather(1, candidates) + 3, log_prob, log_weight), Categorical(logits=new)
    torch.testing.assert_close(log_weight.exp(), old.softmax(1).gather(1, candidates))
    wanted = exact.logits.gather(1, candidates)
    torch.testing.assert_close(estimated.log_prob(candidates), wanted)
    torch.testing.assert_close(estimated.entropy(), exact.entropy())
    part = torch.randn(candidates.shape, dtype=torch.float64)
    for got, want in ((estimated.log_prob(candidates) * part, wanted * part), (estimated.entropy(), exact.entropy())):
        torch.testing.assert_close(gradients(got.sum(), new), gradients(want.sum(), new))


def test_a_choice_that_had_no_probability_may_become_likely():
    """Its ratio of probabilities would overflow; a mask that leaves few choices makes such candidates."""
    log_prob = torch.tensor([[0.0, -170.0]])
    grown = SampledSoftmax(torch.tensor([[0.0, 1.0]]), log_prob, log_prob)
    assert (grown.log_prob(None) - log_prob).exp().isfinite().all()
    torch.testing.assert_close(grown.entropy(), Categorical(logits=torch.tensor([[0.0, 1.0]])).entropy())


@pytest.mark.parametrize("temperature", [1.0, 2.0])
@pytest.mark.parametrize("samples", [2, 3])
def test_weighted_means_over_candidates_are_expectations(samples, temperature):
    """Nearly so: a scale that makes the weights sum to 1 is itself an estimate."""
    torch.manual_seed(13)
    logits, value = random_logits(6).detach(), torch.randn(6, dtype=torch.float64)
    candidates, log_prob, log_weight = draw_candidates(logits.expand(200_000, 6), samples, temperature)
    assert (candidates.sort(1).values.diff(dim=1) > 0).all()
    expected = (logits.softmax(0) * value).sum().item()
    mean = (log_weight.exp() * value[candidates]).sum(1).mean()
    assert mean.item() == pytest.approx(expected, abs=0.01)
    taken = torch.bincount(candidates[:, 0], minlength=6) / len(candidates)
    torch.testing.assert_close(taken.double(), logits.softmax(0), rtol=0, atol=0.005)


def test_at_a_high_temperature_rare_choices_are_candidates():
    torch.manual_seed(0)
    logits = torch.tensor([12.0, 11.0, 4.0, 2.0, 1.0, 0.0]).expand(20_000, 6)
    shares = []
    for temperature in (1.0, 1e3):
        candidates, _, log_weight = draw_candidates(logits, 2, temperature)
        shares.append((candidates == 5).any(1).double().mean().item())
        assert log_weight.exp()[candidates == 5].mean() < 1e-3
    assert shares[0] < 0.02 and shares[1] == pytest.approx(2 / 5, abs=0.02)


@pytest.mark.parametrize("temperature", [0.01, 1.0])
@pytest.mark.parametrize("samples", [3, 4, 7])
def test_forbidden_choices_are_no_candidates(samples, temperature):
    logits = torch.tensor([[0.0, MASKED, 1.0, MASKED, MASKED], [MASKED, MASKED, MASKED, 0.3, MASKED]])
    candidates, log_prob, log_weight = draw_candidates(logits, samples, temperature)
    assert candidates[0].sort().values.unique().tolist() == [0, 2] and (candidates[1] == 3).all()
    torch.testing.assert_close(log_weight.exp().sum(1), torch.ones(2))
    torch.testing.assert_close(log_weight[0, :2].exp(), logits[0].softmax(0)[candidates[0, :2]])
    estimated = SampledSoftmax(logits.gather(1, candidates), log_prob, log_weight)
    torch.testing.assert_close(estimated.entropy(), Categorical(logits=logits).entropy())


@pytest.mark.parametrize("options", CELLS)
@every_policy
def test_logits_of_some_choices_are_those_of_all(kind, options):
    for env, observation in random_states(steps=3, masks=("action", "footprint", "corner"), **options):
        policy = small(kind, env.cell)
        logits = policy.logits(observation)
        choices = torch.distributions.Categorical(logits=logits).sample((7,)).T
        wanted, got = logits.gather(1, choices), policy.choice_logits(observation, choices)
        torch.testing.assert_close(got - got[:, :1], wanted - wanted[:, :1], rtol=1e-4, atol=1e-4)


def test_logits_of_some_choices_of_a_masked_policy():
    for env, observation in random_states(steps=3, masks=("action",), **CELLS[1]):
        policy = Fcn4d(env.cell, True, **POLICIES[Fcn4d])
        logits = policy.logits(observation)
        choices = torch.distributions.Categorical(logits=logits).sample((7,)).T
        assert observation["action_mask"].gather(1, choices).all()
        torch.testing.assert_close(policy.choice_logits(observation, choices), logits.gather(1, choices))


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_logits_of_single_actions_and_their_gradients(dtype):
    torch.manual_seed(0)
    network = Conv4dNet(3, filters=5, compute_dtype=dtype, head_std=0.5)
    bins, totes = torch.randint(0, 2, (70, 4, 3)).float(), torch.randint(0, 4, (70, 5, 6)).float()
    actions = [torch.randint(0, count, (1_080,)) for count in (12, 30, 3)]  # more pairs than computed at once
    row, weights = torch.randint(0, 70, (1_080,)), torch.rand(1_080)
    single = network.pair_logits(bins, totes, row, *actions[:2]).gather(1, actions[2][:, None])[:, 0]
    every = network(bins, totes).view(70, 12, 30, 3)[(row, *actions)]
    tolerance = {"float32": 1e-5, "bfloat16": 3e-2}[dtype]
    torch.testing.assert_close(single, every, rtol=tolerance, atol=tolerance)
    for ours, wanted in zip(
        *(torch.autograd.grad((out * weights).sum(), list(network.parameters())) for out in (single, every)),
        strict=True,
    ):
        torch.testing.assert_close(ours, wanted, rtol=tolerance, atol=tolerance * wanted.abs().max().item())


def test_logits_of_a_pair_are_the_same_in_any_batch():
    torch.manual_seed(0)
    network = Conv4dNet(4, compute_dtype="bfloat16", head_std=0.3)
    maps = torch.randint(0, 2, (9, 5, 5)).float(), torch.randint(0, 6, (9, 6, 6)).float()
    index = [torch.randint(0, count, (700,)) for count in (9, 25, 36)]
    with torch.no_grad():
        every = network.pair_logits(*maps, *index)
        for count in (1, 3, 70, 513):
            few = network.pair_logits(*maps, *(part[:count] for part in index))
            torch.testing.assert_close(few, every[:count], rtol=0, atol=0)


@every_policy
def test_the_collector_s_candidates_are_drawn_from_the_policy(kind):
    env, observation = next(iter(random_states(masks=("action", "footprint", "corner"), **CELLS[0])))
    policy = small(kind, env.cell)
    frame = as_sampling_policy(policy, 5, 2.0)(observation.clone())
    candidates, log_prob, log_weight = (frame[key] for key in CANDIDATE_KEYS)
    assert candidates.shape == log_prob.shape == log_weight.shape == (env.num_envs, 6)
    assert torch.equal(frame[policy.choice_key], policy.to_choice(frame["action"], observation)) or kind is not Fcn4d
    assert torch.equal(candidates[:, 0], frame[policy.choice_key]) and torch.equal(log_prob[:, 0], frame["log_prob"])
    exact = Categorical(logits=policy.logits(observation))
    torch.testing.assert_close(log_prob, exact.logits.gather(1, candidates))
    wanted = set(as_collection_policy(policy)(observation.clone()).keys()) | set(CANDIDATE_KEYS)
    assert set(frame.keys()) == wanted
    # Before any step the ratio of PPO is 1.
    again = as_sampled_actor(policy).get_dist(TensorDict({**observation, **frame}, env.batch_size))
    torch.testing.assert_close(again.log_prob(frame[policy.choice_key]), log_prob, rtol=1e-3, atol=1e-3)
