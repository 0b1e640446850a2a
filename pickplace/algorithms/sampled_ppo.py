"""PPO over a few sampled choices in each state, and their advantages.

A forward pass over all ``N_a`` actions costs far more than a step of the environment. So every choice that was drawn
may be tried in the simulator, not only the one that is taken, and the loss learns from all of them: the "vine" of TRPO
(Schulman et al. 2015).
"""

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pickplace.algorithms.base import BatchPosition
from pickplace.algorithms.ppo import PPO, ClippedLoss
from pickplace.algorithms.sampled_softmax import CANDIDATE_KEYS, as_sampled_actor, as_sampling_policy
from pickplace.common.validate import expect, number, one_of, whole_number
from pickplace.rules.item import Item
from pickplace.rules.masks import footprint_mask, placing_maps
from pickplace.rules.observation import observe
from pickplace.rules.state import Failure, State
from pickplace.rules.step import apply

VALUED_STATES = {"cpu": 1_024, "cuda": 2**20}  # states whose activations in the critic stay in a CPU's caches


class SampledPPO(PPO):
    """PPO whose loss is over a few sampled choices (config ``algo=sampled_ppo``).

    Args:
        samples: choices drawn in each frame beside the one that is taken.
        temperature: divides the logits from which these are drawn.
        advantages: ``"vine"``: of all drawn choices, by one step in the simulator; ``"gae"``: of the taken choice only.
        **settings: of :class:`~pickplace.algorithms.ppo.PPO`; normalised advantages of a vine have a unit mean square.
    """

    drawn_keys = CANDIDATE_KEYS
    log_prob_key = CANDIDATE_KEYS[1]

    def __init__(self, *networks, samples: int, temperature: float, advantages: str, **settings):
        self.samples = whole_number("algo.samples", samples, most=10_000)
        self.temperature = number("algo.temperature", temperature, 0.01, 100.0)
        self.advantages = one_of("algo.advantages", advantages, ("vine", "gae"))
        super().__init__(*networks, **settings)
        expect(
            advantages == "gae" or (self.policy.cell.bin_items == 1 and self.policy.cell.preview == 0),
            "algo.advantages",
            advantages,
            "gae with env.bin_items > 1 or env.preview > 0; vine knows one item in the bin alone",
        )

    def make_loss(self, **common) -> ClippedLoss:
        if self.advantages == "gae":
            self.refuse_single_frame()
        # Advantages are normalised in prepare(): most of those that the loss sees are 0.
        return ClippedLoss(as_sampled_actor(self.policy), self.critic, clip_epsilon=self.clip_epsilon, **common)

    def acting_policy(self) -> TensorDictModuleBase:
        return as_sampling_policy(self.policy, self.samples, self.temperature)

    def prepare(self, batch: TensorDictBase, position: BatchPosition) -> TensorDictBase:
        """Return the frames ``[B]`` of a batch ``[N, T]``, with advantages ``[B, 1 + samples, 1]``."""
        data = super().prepare(batch, position)
        if self.advantages == "vine":
            return data.set("advantage", self.vine_advantages(batch.reshape(-1)))
        count = data[CANDIDATE_KEYS[0]].shape[1]
        return data.set("advantage", taken_choice_advantages(data["advantage"], count, self.normalize_advantage))

    def objective(self, data: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        total, losses = super().objective(data)
        # TorchRL's unweighted means over candidates say nothing about the policy.
        return total, losses.exclude("kl_approx", "clip_fraction")

    def memory(self, frame: int) -> dict[str, int]:
        candidates = 20 * (1 + self.samples) * self.task.batch_frames
        learning = self.learning_memory(self.policy.learning_bytes(self.samples))
        return {f"algo.samples={self.samples}": candidates, **learning}

    @torch.no_grad()
    def vine_advantages(self, frames: TensorDictBase) -> Tensor:
        """Return the weighted advantage of each candidate over its state's value, ``[B, 1 + samples, 1]``.

        A state's value is the weighted mean over its candidates. The weights of a state have a mean of 1 here, so that
        the loss, an unweighted mean over candidates, is an expectation under the policy that drew them. There is one
        exception: a candidate with a positive advantage and a weight below 1 has the square root of its weight. By the
        expectation alone a good but rare choice would stay rare for long; in a natural gradient (Kakade 2002) its step
        would not depend on its probability at all.

        Args:
            frames: observations, candidates and, in ``next``, what the taken choices led to, ``[B]``.
        """
        items = _arrivals(frames)
        parts = torch.arange(len(frames), device=items.x.device).split(self.minibatch_size)
        value = torch.cat([self._values(frames[part], items.rows(part)) for part in parts])
        weight = frames[CANDIDATE_KEYS[2]].exp()
        advantage = value - (weight * value).sum(1, keepdim=True)
        weight *= weight.shape[1]
        advantage *= torch.where(advantage > 0, weight.maximum(weight.sqrt().clamp(max=1)), weight)
        if self.normalize_advantage:
            advantage /= advantage.square().mean().sqrt().clamp(min=1e-6)
        return advantage[..., None]

    def _values(self, frames: TensorDictBase, items: Item) -> Tensor:
        """Return the reward of each candidate and the critic's value of what follows, ``[B, 1 + samples]``.

        ``items`` has the item that arrives next, the same for all candidates of a state. A failure has the value 0.
        What follows has the value 0 if that item has no feasible action.
        """
        cell, candidates = self.policy.cell, frames[CANDIDATE_KEYS[0]]
        row = torch.arange(len(frames), device=candidates.device).repeat_interleave(candidates.shape[1])
        state = State.from_observation(frames).rows(row)
        seen = frames.select(*self.policy.act_keys)[row]
        step = apply(cell, state, self.policy.to_action(candidates.flatten(), seen))
        after = state._replace(surface=step.surface, items=items.rows(row), pile=step.pile, boxes=step.boxes)
        placed = step.failure == 0
        goes_on = placed & footprint_mask(cell, placing_maps(cell, after)).flatten(1).any(1)
        value = placed * step.item.volume * self.task.reward_scale
        if goes_on.any():
            after = after.rows(goes_on.nonzero()[:, 0])
            seen = TensorDict(observe(self.task.terms, cell, after, self.critic.in_keys), [len(after.tote_height)])
            parts = [self.critic(part)["state_value"] for part in seen.split(VALUED_STATES[row.device.type])]
            value[goes_on] += self.gamma * torch.cat(parts)[:, 0]
        return value.view(candidates.shape)


def taken_choice_advantages(advantage: Tensor, candidates: int, normalize: bool) -> Tensor:
    """Return advantages ``[B, candidates, 1]`` that are zero except for the taken choice, which is the first.

    They are scaled so that the mean over candidates equals the loss of the taken choice.

    Args:
        advantage: GAE's, ``[B, 1]``.
        candidates: ``1 + samples``.
        normalize: to zero mean and unit variance first.
    """
    if normalize:
        advantage = (advantage - advantage.mean()) / advantage.std().clamp(min=1e-6)
    return torch.nn.functional.pad(candidates * advantage[:, None], (0, 0, 0, candidates - 1))


def _arrivals(frames: TensorDictBase) -> Item:
    """Draw an item for each frame, ``[B, 1]``, from those that arrived after the batch's successful actions.

    A frame keeps its own item if no action succeeded, or if the drawn item's episode has other items or rotations.
    """
    after = frames["next"]
    placed = (after["failure"] == Failure.NONE) | (after["failure"] == Failure.STUCK)
    rows = (placed & (after["bin_depth"].flatten(1) > 0).any(1, keepdim=True)).nonzero()[:, 0]
    own = State.from_observation(frames)
    if not len(rows):
        return own.items
    draw = torch.randint(len(rows), (len(frames),), device=rows.device)
    drawn = State.from_observation(after[rows[draw]])
    keep = torch.ones_like(draw, dtype=torch.bool)
    for key in ("item_mix", "turns"):
        mine, theirs = getattr(own.episode, key), getattr(drawn.episode, key)
        if mine is not None:
            keep &= mine == theirs
    return Item.from_table(torch.where(keep[:, None, None], drawn.items.table, own.items.table))
