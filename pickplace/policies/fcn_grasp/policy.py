"""The default policy: 2D convolutions over the tote around each footprint, relative to the item."""

import torch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from pickplace.policies.base import MAP_KEYS, MASKED, Policy, pick_one, refuse_several_items
from pickplace.policies.depth import ScoredItems
from pickplace.policies.fcn_grasp.network import FootprintFcn
from pickplace.policies.footprints import FOOTPRINT_INDEX, FootprintPolicy, every_footprint
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import (
    footprint_index,
    is_outside,
    join_action,
    num_grasp_turns,
    pick_classes,
    split_flat,
)
from pickplace.rules.item import Observation, item_from_depth, items_from_observation


class FcnGrasp(FootprintPolicy):
    """``fcn_grasp`` with a mask: chooses among the distinct footprints that some action reaches.

    Args:
        cell: the sizes.
        mask_infeasible: must be true.
        **network: arguments of :class:`~pickplace.policies.fcn_grasp.network.FootprintFcn`.
    """

    network_class = FootprintFcn
    score_index = FOOTPRINT_INDEX


class UnmaskedFcnGrasp(Policy):
    """``fcn_grasp`` without a mask: chooses a (grasp class, place cell), feasible or not, or to miss the item.

    The grasp class says how the item lies under the rotated end effector. All picks that lift nothing are one more
    choice. The policy must learn to avoid it, and it must learn walls, collisions and support.

    Args:
        cell: the sizes.
        **network: arguments of :class:`~pickplace.policies.fcn_grasp.network.FootprintFcn`, which scores each
            footprint once for every offset of the item under the end effector.
    """

    choice_key = "grasp"
    map_keys = MAP_KEYS
    check_cell = refuse_several_items
    scored: Tensor  # see `_scored`

    def __init__(self, cell: CellSpec, **network):
        super().__init__(cell)
        self.classes = num_grasp_turns(cell) * cell.num_offsets**2
        self.network = FootprintFcn(cell.num_offsets**2, **network)
        self.miss, self.outside = (nn.Parameter(torch.zeros(())) for _ in range(2))
        self.register_buffer("scored", self._scored(), persistent=False)

    def _scored(self) -> Tensor:
        """Return the index of each (grasp class, place cell) among the network's scores, int64 ``[C, W_T * D_T]``.

        The last score is that of all footprints that do not begin in the tote.
        """
        (tote_w, tote_d, _), offsets, low = self.cell.tote_size, self.cell.num_offsets, self.cell.min_offset
        step, x, y = torch.arange(offsets), torch.arange(tote_w), torch.arange(tote_d)
        channel, found = torch.arange(offsets**2).view(offsets, offsets, 1, 1), []
        for turn in range(num_grasp_turns(self.cell)):  # turns that differ by 180 degrees have the same scores
            quarter_turned, shape = turn % 2, self.cell.effector(turn)
            left = x[:, None] + (step[:, None, None, None] + low - shape.ref_x)  # [O, 1, W_T, 1]
            front = y + (step[:, None, None] + low - shape.ref_y)  # [O, 1, D_T]
            inside = ~is_outside(left, 1, tote_w) & ~is_outside(front, 1, tote_d)
            footprint = footprint_index(self.cell.tote_size, quarter_turned, left, front)
            # The network sees a turned footprint along the item's own axes.
            index = footprint * offsets**2 + (channel.transpose(0, 1) if quarter_turned else channel)
            found.append(torch.where(inside, index, self.cell.num_footprints * offsets**2).flatten(2).flatten(0, 1))
        return torch.cat(found)

    def class_scores(self, observation: Observation) -> Tensor:
        """Return a logit for every (grasp class, place cell), ``[N, C, W_T * D_T]``."""
        bins, totes, bearing = (observation[key] for key in MAP_KEYS)
        row, footprint = every_footprint(totes, self.cell.footprint_turns)
        contents = ScoredItems(items_from_observation(observation), torch.zeros_like(row))
        scores = self.network.footprint_scores(bins, totes, bearing, row, footprint, contents).view(len(totes), -1)
        return torch.cat([scores, self.outside.expand(len(scores), 1)], 1)[:, self.scored]

    def _choices(self, observation: Observation) -> tuple[Tensor, Tensor, Tensor]:
        """Return the logit of each choice, the logit of each of its flat actions, and the class of each pick."""
        maps, places = self.class_scores(observation), self.cell.num_places
        logits = torch.cat([maps.flatten(1), self.miss.expand(len(maps), 1)], 1)
        picks = pick_classes(self.cell, item_from_depth(observation["bin_depth"]))
        missing = (picks < 0).sum((1, 2)) * places
        counts = maps.new_zeros(len(maps), maps.shape[1] + 1).scatter_add_(
            1, picks.flatten(1) + 1, torch.ones_like(picks, dtype=maps.dtype).flatten(1)
        )
        ways = torch.cat([counts[:, 1:].repeat_interleave(places, 1), missing[:, None]], 1)
        return torch.where(ways > 0, logits + ways.clamp(min=1).log(), MASKED), logits, picks

    def logits(self, observation: Observation) -> Tensor:
        return self._choices(observation)[0]

    def to_action(self, choice: Tensor, observation: Observation) -> Tensor:
        cell, places = self.cell, self.cell.num_places
        missed = choice == self.classes * places
        wanted = torch.where(missed, -1, choice // places)[:, None]
        pairs = pick_classes(cell, item_from_depth(observation["bin_depth"])).flatten(1) == wanted  # [N, P * R]
        pair = pick_one(torch.where(pairs, torch.arange(pairs.shape[1], device=choice.device), -1))
        explores = exploration_type() == ExplorationType.RANDOM
        anywhere = torch.randint(places, choice.shape, device=choice.device) if explores else 0
        place = torch.where(missed, anywhere, choice % places)
        return join_action(cell, pair // cell.rotations, place, pair % cell.rotations)

    def to_choice(self, action: Tensor, observation: Observation) -> Tensor:
        places = self.cell.num_places
        pick, place, rotation = split_flat(self.cell, action)
        classes = pick_classes(self.cell, item_from_depth(observation["bin_depth"]))
        grasp = classes[torch.arange(len(action), device=action.device), pick, rotation]
        return torch.where(grasp < 0, self.classes * places, grasp * places + place)

    def action_log_probs(self, observation: Observation) -> Tensor:
        logits, each, picks = self._choices(observation)
        log_probs = each - logits.logsumexp(1, keepdim=True)
        maps = log_probs[:, :-1].unflatten(1, (-1, self.cell.num_places))
        rows = torch.cat([log_probs[:, -1:, None].expand_as(maps[:, :1]), maps], 1)  # row 0 is a miss
        batch = torch.arange(len(rows), device=rows.device)[:, None, None]
        return rows[batch, picks + 1].transpose(2, 3).flatten(1)  # [N, P, R, places] -> [N, N_a]


def fcn_grasp(cell: CellSpec, mask_infeasible: bool, **network) -> FcnGrasp | UnmaskedFcnGrasp:
    """Return the default policy (config ``model=fcn_grasp``): over footprints with a mask, over grasps without."""
    return (FcnGrasp if mask_infeasible else UnmaskedFcnGrasp)(cell, **network)
