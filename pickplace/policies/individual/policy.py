"""Individual planning: the pick is heuristic and does not look at the tote; a policy chooses place and rotation."""

from abc import abstractmethod

import torch
from torch import Tensor

from pickplace.policies.base import MASKED, Policy, Ranking, best_choice, pick_one, refuse_several_items
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.policies.fcn_grasp.network import FootprintFcn
from pickplace.policies.fcn_grasp.policy import UnmaskedFcnGrasp
from pickplace.policies.footprints import FOOTPRINT_INDEX, FootprintScorer, count_ways
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import heuristic_pick, join_pick, pick_classes, select_pick
from pickplace.rules.item import Observation, item_from_depth, items_from_observation
from pickplace.rules.masks import PlacingMaps, action_footprints, action_mask

EXCLUDES = "every pick but the heuristic one"


def spread_over_actions(cell: CellSpec, log_probs: Tensor, pick: Tensor) -> Tensor:
    """Return log-probabilities ``[N, W_T * D_T * R]`` for the pick cells ``[N]`` as ``[N, N_a]``; minus infinity for
    other picks."""
    number = torch.arange(log_probs.shape[1], device=pick.device)
    out = log_probs.new_full((len(log_probs), cell.num_actions), -torch.inf)
    return out.scatter_(1, join_pick(cell, pick[:, None], number), log_probs)


class PlaceRotationPolicy(Policy):
    """Chooses place and rotation with the heuristic pick; subclasses score them.

    With a mask, a state stays unmasked if nothing can be placed with the heuristic pick. Then the action fails.
    """

    choice_key = "place_rotation"
    excludes: str | None = EXCLUDES
    check_cell = refuse_several_items

    @abstractmethod
    def place_scores(self, observation: Observation, pick: Tensor) -> Tensor:
        """Return a logit for each place and rotation with the pick cells ``[N]``, ``[N, W_T * D_T * R]``."""

    def _pick(self, observation: Observation) -> Tensor:
        return heuristic_pick(self.cell, item_from_depth(observation["bin_depth"]))

    def logits(self, observation: Observation) -> Tensor:
        pick = self._pick(observation)
        logits = self.place_scores(observation, pick)
        if "action" not in self.masks:
            return logits
        allowed = select_pick(self.cell, observation["action_mask"], pick)
        return torch.where(allowed | ~allowed.any(1, keepdim=True), logits, MASKED)

    def to_action(self, choice: Tensor, observation: Observation) -> Tensor:
        return join_pick(self.cell, self._pick(observation), choice)

    def to_choice(self, action: Tensor, observation: Observation) -> Tensor:
        return action % (self.cell.num_places * self.cell.rotations)

    def action_log_probs(self, observation: Observation) -> Tensor:
        pick = self._pick(observation)
        return spread_over_actions(self.cell, self.place_scores(observation, pick).log_softmax(-1), pick)

    rank = Policy.rank  # Fcn4d.rank scores every pick


class IndividualRl(PlaceRotationPolicy, Fcn4d):
    """``individual_rl``, with which the paper compares: only place and rotation are learnt (Sec. IV).

    The network is that of ``fcn4d``. Its features after the last ``3x3x3x3`` convolution are computed at the pick cell
    only.

    Args: as in :class:`~pickplace.policies.fcn4d.policy.Fcn4d`.
    """

    def choice_logits(self, observation: Observation, choices: Tensor) -> Tensor:
        return Fcn4d.choice_logits(self, observation, join_pick(self.cell, self._pick(observation)[:, None], choices))

    def place_scores(self, observation: Observation, pick: Tensor) -> Tensor:
        logits = self.network(observation["bin_depth"], observation["tote_depth"], pick).unflatten(1, (-1, 4))
        return logits[..., : self.cell.rotations].flatten(1)


class UnmaskedIndividualGrasp(PlaceRotationPolicy, UnmaskedFcnGrasp):
    """``individual_grasp`` without a mask: the network of ``fcn_grasp`` scores the placements of the heuristic pick.

    Args: as in :class:`~pickplace.policies.fcn_grasp.policy.UnmaskedFcnGrasp`.
    """

    def place_scores(self, observation: Observation, pick: Tensor) -> Tensor:
        row = torch.arange(len(pick), device=pick.device)[:, None]
        classes = pick_classes(self.cell, item_from_depth(observation["bin_depth"]))[row[:, 0], pick]  # [N, R]
        return self.class_scores(observation)[row, classes].transpose(1, 2).flatten(1)


class IndividualGrasp(FootprintScorer):
    """``individual_grasp`` with a mask: chooses among the distinct footprints that the heuristic pick reaches.

    If none of them is feasible, it chooses among all of them. Then the action fails.

    Args: as in :class:`~pickplace.policies.fcn_grasp.policy.FcnGrasp`.
    """

    mask = "action"
    excludes = EXCLUDES
    check_cell = refuse_several_items
    network_class = FootprintFcn
    score_index = FOOTPRINT_INDEX

    def _reached(self, observation: Observation, mask: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the heuristic pick, the footprints that it leaves, and those to choose among.

        Returns:
            the pick cell, int64 ``[N]``; the footprint of each place and rotation, int64 ``[N, W_T * D_T * R]``, -1
            outside the tote; and a mask of those to choose among, bool of the same shape.
        """
        pick = heuristic_pick(self.cell, item_from_depth(observation["bin_depth"]))
        footprint = select_pick(self.cell, action_footprints(self.cell, items_from_observation(observation)), pick)
        if mask is None:
            return pick, footprint, footprint >= 0
        allowed = select_pick(self.cell, mask, pick)
        return pick, footprint, torch.where(allowed.any(1, keepdim=True), allowed, footprint >= 0)

    def logits(self, observation: Observation) -> Tensor:
        _, footprint, allowed = self._reached(observation, observation["action_mask"])
        return self.footprint_logits(observation, count_ways(self.cell.num_footprints, footprint, allowed) > 0)

    def to_action(self, choice: Tensor, observation: Observation) -> Tensor:
        pick, footprint, allowed = self._reached(observation, observation["action_mask"])
        number = torch.arange(footprint.shape[1], device=choice.device)
        place_rotation = pick_one(torch.where(allowed & (footprint == choice[:, None]), number, -1))
        return join_pick(self.cell, pick, place_rotation.clamp(min=0))

    def rank(self, observation: Observation, maps: PlacingMaps) -> Ranking:
        seen = {**observation, "action_mask": action_mask(self.cell, maps)}
        scores = self.logits(seen)

        def reach(row: Tensor, choice: Tensor) -> Tensor:
            return self.to_action(choice, {key: value[row] for key, value in seen.items()})

        return Ranking(self.to_action(best_choice(scores), seen), scores, reach)

    def action_log_probs(self, observation: Observation) -> Tensor:
        pick, footprint, allowed = self._reached(observation)
        ways = count_ways(self.cell.num_footprints, footprint, allowed)
        share = self.footprint_logits(observation, ways > 0).log_softmax(-1) - ways.clamp(min=1).log()
        score = torch.where(allowed, share.gather(1, footprint.clamp(min=0)), -torch.inf)
        return spread_over_actions(self.cell, score, pick)


def individual_grasp(cell: CellSpec, mask_infeasible: bool, **network) -> IndividualGrasp | UnmaskedIndividualGrasp:
    """Return individual planning with the network of ``fcn_grasp`` (config ``model=individual_grasp``)."""
    return (IndividualGrasp if mask_infeasible else UnmaskedIndividualGrasp)(cell, **network)
