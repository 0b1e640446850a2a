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

from pickplace.policies.base import Policy, distinct
from pickplace.policies.sampled_softmax import CANDIDATE_KEYS
from pickplace.task.feasibility import footprint_mask, placing_maps
from pickplace.task.observation import Term, observe
from pickplace.task.state import Item, State
from pickplace.task.transition import apply


@torch.no_grad()
def vine_advantages(
    frames: TensorDictBase, policy: Policy, critic: ValueOperator, terms: Mapping[str, Term], algo: DictConfig
) -> Tensor:
    """Return the advantage of each candidate over the mean of its state, ``[B, 1 + samples, 1]``.

    Args:
        frames: observations and candidates, ``[B]``.
        policy: the policy that drew the candidates.
        critic: the value network.
        terms: of the observation, by key.
        algo: the config group ``algo``; the advantages have unit variance with ``normalize_advantage``.
    """
    items = State.from_observation(frames).item.rows(torch.randperm(len(frames), device=frames["candidates"].device))
    parts = torch.arange(len(frames), device=items.x.device).split(algo.minibatch_size)
    advantage = torch.cat([_values(frames[part], items.rows(part), policy, critic, terms, algo) for part in parts])
    advantage -= advantage.mean(1, keepdim=True)
    return advantage / advantage.std().clamp(min=1e-6) if algo.normalize_advantage else advantage


def _values(
    frames: TensorDictBase,
    items: Item,
    policy: Policy,
    critic: ValueOperator,
    terms: Mapping[str, Term],
    algo: DictConfig,
) -> Tensor:
    """Return the reward of each candidate and the critic's value of what follows, ``[B, 1 + samples, 1]``.

    The item that arrives next is another frame's, the same for all candidates of a state. A failure is worth nothing,
    and so is what follows if that item has no feasible action.
    """
    cell, (row, choice, back) = policy.cell, distinct(frames[CANDIDATE_KEYS[0]])
    state = State.from_observation(frames).rows(row)
    step = apply(cell, state, policy.to_action(choice, frames.select(*policy.act_keys)[row]))
    after = State(step.heights, state.tote_height, items.rows(row))
    placed = step.failure == 0
    goes_on = placed & footprint_mask(cell, placing_maps(cell, after)).flatten(1).any(1)
    seen = TensorDict(observe(terms, cell, after, critic.in_keys), [len(row)])
    following = critic(seen)["state_value"][:, 0]
    value = placed * state.item.volume * algo.reward_scale + algo.gamma * torch.where(goes_on, following, 0.0)
    return value[back][..., None]
