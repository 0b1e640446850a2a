"""Base classes of policies that choose among footprints.

After a success, the tote depends on the footprint alone. The grasp only decides whether the footprint can be reached,
and the mask knows that. Where bins hold several items, a choice is a pair of an item and a footprint, with the index
``item * num_footprints + footprint``.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from pickplace.common.capture import is_capturing
from pickplace.common.validate import expect
from pickplace.envs.masks import MASKS
from pickplace.policies.base import MAP_KEYS, MASKED, Policy, Ranking, best_choice, pick_one
from pickplace.policies.depth import ScoredItems
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import footprint_index
from pickplace.rules.item import Observation, items_from_observation
from pickplace.rules.masks import (
    PlacingMaps,
    action_footprints,
    actions_reaching,
    first_action_reaching,
    placing_maps,
)
from pickplace.rules.placing import unchecked_top
from pickplace.rules.state import State
from pickplace.rules.step import apply

#: Formula of an index of the scores of all footprints.
FOOTPRINT_INDEX = (
    "(quarter_turned * W_T + x) * D_T + y: first cell of the item in the tote; quarter_turned is 1 if turned by 90 "
    "degrees; of several items one after the other"
)


def count_ways(choices: int, footprint: Tensor, allowed: Tensor) -> Tensor:
    """Return the number of allowed actions that leave each footprint, int64 ``[N, choices]``.

    Args:
        choices: the number of footprints, over all items in a bin.
        footprint: int64 ``[N, A]``, the footprint that each action leaves, or -1.
        allowed: bool ``[N, A]``.
    """
    return footprint.new_zeros(len(footprint), choices + 1).scatter_add_(1, footprint + 1, allowed.long())[:, 1:]


def rank_footprints(cell: CellSpec, maps: PlacingMaps, scores: Tensor) -> Ranking:
    """Return the ranking of footprints by their scores, float32 ``[N, footprints]``, each with its first action."""
    best = first_action_reaching(cell, maps, best_choice(scores))
    return Ranking(best, scores, lambda row, choice: first_action_reaching(cell, maps.rows(row), choice))


def every_footprint(tote_depth: Tensor, turns: int) -> tuple[Tensor, Tensor]:
    """Return row and index of every footprint of totes ``[N, W_T, D_T]``, int64 ``[N * Q * W_T * D_T]`` each."""
    batch, wide, long = tote_depth.shape  # not len(), which torch.export would turn into a constant
    row, footprint = (torch.arange(size, device=tote_depth.device) for size in (batch, turns * wide * long))
    return row[:, None].expand(batch, footprint.shape[0]).flatten(), footprint.expand(batch, -1).flatten()


class FootprintScorer(Policy):
    """Scores footprints by a network with a method ``at``; a subclass chooses among some of them.

    Args:
        cell: the sizes.
        mask_infeasible: must be true, because the choices come from a mask.
        **network: arguments of the network.

    Attributes:
        mask: the mask that it needs in training.
        network_class: makes the network; None: a subclass sets ``network`` itself.

    Raises:
        ValueError: without a mask.
    """

    choice_key = "footprint"
    map_keys: tuple[str, ...] = MAP_KEYS
    mask: str
    network_class: Callable[..., torch.nn.Module] | None = None

    def __init__(self, cell: CellSpec, mask_infeasible: bool = True, **network):
        expected = f"true with {type(self).__name__}; its choices are feasible ones"
        expect(mask_infeasible, "model.mask_infeasible", mask_infeasible, expected)
        super().__init__(cell, masks=(self.mask,))
        self.in_keys += self.item_keys(cell)
        if self.network_class is not None:
            self.network = self.network_class(**network)

    def scores(self, observation: Observation, row: Tensor, footprint: Tensor) -> Tensor:
        """Return the scores of some footprints, float32 ``[M]``; a subclass may use further terms of the observation.

        Args:
            row: int64 ``[M]``, index of the problem.
            footprint: int64 ``[M]``, index ``(quarter_turned * W_T + x) * D_T + y``; with several items,
                index of the choice.
        """
        bins, totes, bearing = (observation[key] for key in MAP_KEYS)
        places = self.cell.footprint_turns * totes.shape[1] * totes.shape[2]
        contents = ScoredItems(items_from_observation(observation), footprint // places)
        own = footprint - contents.number * places
        return self.network.footprint_scores(bins, totes, bearing, row, own, contents)[:, 0]

    def footprint_logits(self, observation: Observation, mask: Tensor) -> Tensor:
        """Return logits of footprints, computed only where a mask ``[N, M * Q * W_T * D_T]`` allows them; else
        :data:`MASKED`."""
        if is_capturing():
            return torch.where(mask, self.unmasked_scores(observation), MASKED)
        row, footprint = mask.nonzero(as_tuple=True)
        scores = self.scores(observation, row, footprint)
        return scores.new_full(mask.shape, MASKED).index_put((row, footprint), scores)

    def unmasked_scores(self, observation: Observation) -> Tensor:
        """Return the scores of all footprints, float32 ``[N, scores]``; bins and totes may have any size."""
        totes, items = observation["tote_depth"], items_from_observation(observation)
        turns = self.cell.footprint_turns * items.x.shape[1]  # of each item
        return self.scores(observation, *every_footprint(totes, turns)).view(totes.shape[0], -1)

    def choice_logits(self, observation: Observation, choices: Tensor) -> Tensor:
        row = torch.arange(len(choices), device=choices.device).repeat_interleave(choices.shape[1])
        return self.scores(observation, row, choices.flatten()).view(choices.shape)

    def to_choice(self, action: Tensor, observation: Observation) -> Tensor:
        step = apply(self.cell, State.from_observation(observation), action)
        x, y, w, _ = step.footprint.unbind(-1)
        turned = (w != step.item.w).long()  # a square item is the same either way
        return footprint_index(self.cell.tote_size, turned, x, y) + step.taken * self.cell.num_footprints


class FootprintPolicy(FootprintScorer):
    """Chooses among the footprints that its mask allows; arguments as in :class:`FootprintScorer`."""

    mask = "footprint"
    excludes: str | None = "failed picks and footprints outside the tote"

    def ranked(self, maps: PlacingMaps) -> Tensor:
        return MASKS[self.mask].make(self.cell, maps)

    def logits(self, observation: Observation) -> Tensor:
        return self.footprint_logits(observation, observation[f"{self.mask}_mask"])

    def to_action(self, choice: Tensor, observation: Observation) -> Tensor:
        maps = placing_maps(self.cell, State.from_observation(observation), unchecked_top)  # the mask has checked
        return pick_one(actions_reaching(self.cell, maps, choice))

    def action_log_probs(self, observation: Observation) -> Tensor:
        # An action whose pick misses, or whose item leaves the tote, has no footprint, so probability 0.
        footprint = action_footprints(self.cell, items_from_observation(observation))
        scores = self.unmasked_scores(observation)
        ways = count_ways(scores.shape[1], footprint, footprint >= 0)
        share = torch.where(ways > 0, scores, MASKED).log_softmax(-1) - ways.clamp(min=1).log()
        return torch.where(footprint >= 0, share.gather(1, footprint.clamp(min=0)), MASKED)

    def rank(self, observation: Observation, maps: PlacingMaps) -> Ranking:
        return rank_footprints(self.cell, maps, self.footprint_logits(observation, self.ranked(maps)))
