"""Advantages of several choices in each state, all tried in the simulator: the "vine" of TRPO (Schulman et al. 2015).

A forward pass over all ``N_a`` actions costs far more than a step of the environment. So every choice that was drawn
there is tried, not only the one that is taken, and the loss learns from all of them.
"""

from collections.abc import Mapping

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules import ValueOperator

from pickplace.algorithms.sampled_softmax import CANDIDATE_KEYS
from pickplace.policies.base import Policy
from pickplace.rules.item import Item
from pickplace.rules.masks import footprint_mask, placing_maps
from pickplace.rules.observation import Term, observe
from pickplace.rules.state import Failure, State
from pickplace.rules.step import apply


@torch.no_grad()
def vine_advantages(
    frames: TensorDictBase,
    policy: Policy,
    critic: ValueOperator,
    terms: Mapping[str, Term],
    algo: DictConfig,
    reward_scale: float,
) -> Tensor:
    """Return the weighted advantage of each candidate over its state's value, ``[B, 1 + samples, 1]``.

    A state's value is the weighted mean over its candidates. The weights of a state have a mean of 1 here, so that the
    loss, an unweighted mean over candidates, is an expectation under the policy that drew them. There is one exception:
    a candidate that is better than expected has the square root of its weight, if that is more. By the expectation
    alone a rare choice would stay rare for long, however good it is; in a natural gradient (Kakade 2002) its step would
    not depend on its probability at all.

    Args:
        frames: observations, candidates and, in ``next``, what the taken choices led to, ``[B]``.
        policy: the policy that drew the candidates.
        critic: the value network.
        terms: of the observation, by key.
        algo: the config group ``algo``; with ``normalize_advantage`` what is returned has a mean square of 1.
        reward_scale: of the rewards.
    """
    items = _arrivals(frames)
    parts = torch.arange(len(frames), device=items.x.device).split(algo.minibatch_size)
    value = torch.cat(
        [_values(frames[part], items.rows(part), policy, critic, terms, algo, reward_scale) for part in parts]
    )
    weight = frames[CANDIDATE_KEYS[2]].exp()
    advantage = value - (weight * value).sum(1, keepdim=True)
    weight *= weight.shape[1]
    advantage *= torch.where(advantage > 0, weight.maximum(weight.sqrt().clamp(max=1)), weight)
    if algo.normalize_advantage:
        advantage /= advantage.square().mean().sqrt().clamp(min=1e-6)
    return advantage[..., None]


def _arrivals(frames: TensorDictBase) -> Item:
    """Return an item for each frame, ``[B, 1]``: one that arrived after some success; without any, the frame's own."""
    after = frames["next"]
    placed = (after["failure"] == Failure.NONE) | (after["failure"] == Failure.STUCK)
    rows = (placed & (after["bin_depth"].flatten(1) > 0).any(1, keepdim=True)).nonzero()[:, 0]
    if not len(rows):
        return State.from_observation(frames).items
    draw = torch.randint(len(rows), (len(frames),), device=rows.device)
    return State.from_observation(after[rows[draw]]).items


def _values(
    frames: TensorDictBase,
    items: Item,
    policy: Policy,
    critic: ValueOperator,
    terms: Mapping[str, Term],
    algo: DictConfig,
    reward_scale: float,
) -> Tensor:
    """Return the reward of each candidate and the critic's value of what follows, ``[B, 1 + samples]``.

    ``items`` has the item that arrives next, the same for all candidates of a state. A failure is worth nothing, and so
    is what follows if that item has no feasible action.
    """
    cell, candidates = policy.cell, frames[CANDIDATE_KEYS[0]]
    row = torch.arange(len(frames), device=candidates.device).repeat_interleave(candidates.shape[1])
    state = State.from_observation(frames).rows(row)
    step = apply(cell, state, policy.to_action(candidates.flatten(), frames.select(*policy.act_keys)[row]))
    after = State(step.surface, state.tote_height, items.rows(row))
    placed = step.failure == 0
    goes_on = placed & footprint_mask(cell, placing_maps(cell, after)).flatten(1).any(1)
    value = placed * step.item.volume * reward_scale
    if goes_on.any():
        after = after.rows(goes_on.nonzero()[:, 0])
        seen = TensorDict(observe(terms, cell, after, critic.in_keys), [len(after.tote_height)])
        value[goes_on] += algo.gamma * critic(seen)["state_value"][:, 0]
    return value.view(candidates.shape)
