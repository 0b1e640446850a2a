"""Advantages of the choices that were drawn, against steps of the environment."""

import pytest
import torch
from commands import composed
from problems import late_state
from torch import nn
from torchrl.modules import ValueOperator

from pickplace.policies.fcn4d import ActionPolicy
from pickplace.policies.individual import IndividualRlPolicy
from pickplace.policies.sampled_softmax import as_sampling_policy
from pickplace.task.observation import STANDARD_TERMS
from pickplace.training.vine import vine_advantages


class MeanDepth(nn.Module):
    """A value that is computed by hand."""

    def forward(self, bin_depth, tote_depth):
        return 1 + tote_depth.mean((-2, -1))[..., None]


CRITIC = ValueOperator(MeanDepth(), ["bin_depth", "tote_depth"])
SETTINGS = ["algo.gamma=0.9", "algo.reward_scale=0.5", "algo.normalize_advantage=false", "algo.minibatch_size=7"]


def drawn(kind, steps):
    """Return an environment in the middle of its episodes, a policy, and frames with candidates."""
    torch.manual_seed(0)
    env, observation = late_state(steps, masks=("action",), bin_size=(5, 5, 1), tote_size=(5, 5, 2), num_envs=24)
    policy = kind(env.cell, filters=4, head_std=1.0)
    choices = as_sampling_policy(policy, 40)(observation.clone())
    return env, policy, observation.clone().update(choices)


@pytest.mark.parametrize("kind", [ActionPolicy, IndividualRlPolicy])
def test_advantages_are_those_of_single_steps(kind):
    env, policy, frames = drawn(kind, 1)
    algo = composed(*SETTINGS).algo
    got = vine_advantages(frames, policy, CRITIC, STANDARD_TERMS, algo)[..., 0]
    saved, expected = {key: value.clone() for key, value in env.state_dict().items()}, []
    for candidate in frames["candidates"].T:
        after = env.step(frames.clone().set("action", policy.to_action(candidate, frames)))["next"]
        value = 0.5 * after["reward"] + 0.9 * (1 + after["tote_depth"].mean((1, 2))[:, None])
        expected.append(torch.where(after["terminated"], 0.0, value)[:, 0])
        assert not (after["failure"] == 7).any()  # a tote with one item takes any other
        env.load_state_dict({key: value.clone() for key, value in saved.items()})
    expected, weight = torch.stack(expected, 1), frames["candidate_log_weight"].exp()
    assert (expected > 0).any() and (expected == 0).any()
    torch.testing.assert_close(got, (expected - (weight * expected).sum(1, keepdim=True)) * weight * 41)
    algo.normalize_advantage = True
    unit = vine_advantages(frames, policy, CRITIC, STANDARD_TERMS, algo)
    torch.testing.assert_close(unit[..., 0], got / got.square().mean().sqrt())


def test_nothing_follows_where_the_next_item_has_no_place():
    """Each tote is full but for a cell that the item fills."""
    _, policy, frames = drawn(ActionPolicy, 1)
    for key in ("tote_depth", "bin_depth"):
        frames[key] = torch.zeros(24, 5, 5)
        frames[key][:, 2, 2] = 1.0
    frames["tote_height"] = torch.full((24, 1), 2)
    middle, elsewhere = (12 * 25 + 12) * 4, 12 * 25 * 4
    frames["candidates"] = torch.tensor([[middle, elsewhere]]).expand(24, 2).clone()
    frames["candidate_log_weight"] = torch.tensor([0.5, 0.5]).log().expand(24, 2).clone()
    got = vine_advantages(frames, policy, CRITIC, STANDARD_TERMS, composed(*SETTINGS).algo)
    torch.testing.assert_close(got[..., 0], torch.tensor([[0.25, -0.25]]).expand(24, 2))
