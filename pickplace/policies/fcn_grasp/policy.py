"""The default policy: 2D convolutions over the tote around each footprint, as the item there would see it."""

import torch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from pickplace.policies.base import MASKED, Policy, pick_one, refuse_several_items
from pickplace.policies.depth import Contents
from pickplace.policies.fcn_grasp.network import MAP_KEYS, FootprintFcn, every_footprint
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import (
    class_index,
    footprint_index,
    is_outside,
    join_action,
    num_grasp_turns,
    pick_classes,
    split_flat,
)
from pickplace.rules.masks import (
    PlacingMaps,
    action_footprints,
    actions_reaching,
    choice_mask,
    first_action_reaching,
    unchecked_maps,
)
from pickplace.rules.state import Observation, State, item_from_depth, items_from_observation, listed_items
from pickplace.rules.step import apply


def count_ways(choices: int, footprint: Tensor, allowed: Tensor) -> Tensor:
    """Return how many of the allowed actions, bool ``[N, A]``, leave each footprint, int64 ``[N, choices]``.

    Args:
        choices: the number of footprints, over all items in a bin.
        footprint: int64 ``[N, A]``, the footprint that each action leaves, or -1.
    """
    ways = footprint.new_zeros(len(footprint), choices + 1)
    return ways.scatter_add_(1, footprint + 1, allowed.long())[:, 1:]


class FootprintPolicy(Policy):
    """``fcn_grasp`` with a mask: chooses among the distinct footprints that some action reaches.

    A success leaves a tote that depends on the footprint alone; the grasp only decides whether it can be reached, and
    the mask knows that. Where bins hold several items, a choice is a pair of an item and a footprint, with the index
    ``item * num_footprints + footprint``.

    Args:
        cell: the sizes.
        network: arguments of :class:`~pickplace.policies.fcn_grasp.network.FootprintFcn`.
    """

    choice_key = "footprint"
    map_keys = MAP_KEYS
    masks: tuple[str, ...] = ("footprint",)
    excludes: str | None = "failed picks and footprints outside the tote"
    ranks_footprints = True
    score_index: str | None = (
        "(parity * W_T + x) * D_T + y: minimum corner of the item in the tote; parity 1: turned by 90 degrees; of "
        "several items one after the other"
    )
    network: FootprintFcn

    def __init__(self, cell: CellSpec, **network):
        super().__init__(cell)
        if cell.bin_items > 1:
            self.in_keys.append("items")
        self.network = self.make_network(**network)

    def make_network(self, **network):
        """Return the network, which scores footprints by ``at``."""
        return FootprintFcn(several_items=self.cell.bin_items > 1, **network)

    def ranked(self, maps: PlacingMaps) -> Tensor:
        """Return the footprints among which it chooses, bool ``[N, M * Q * W_T * D_T]``; some, if any is feasible."""
        return choice_mask(self.cell, maps)

    def scores(self, observation: Observation, row: Tensor, footprint: Tensor) -> Tensor:
        """Return the scores of some footprints, float32 ``[M]``; a subclass may add what further terms tell.

        Args:
            row: int64 ``[M]``, index of the problem.
            footprint: int64 ``[M]``, index ``(parity * W_T + x) * D_T + y``; of several items that of a choice.
        """
        bins, totes, bearing = (observation[key] for key in MAP_KEYS)
        contents = None
        if (items := listed_items(observation)) is not None:
            places = self.cell.parities * totes.shape[1] * totes.shape[2]
            number = footprint // places
            contents = Contents(items, number)
            footprint = footprint - number * places
        return self.network.at(bins, totes, bearing, row, footprint, contents)[:, 0]

    def footprint_logits(self, observation: Observation, mask: Tensor) -> Tensor:
        """Return logits of the footprints that a mask ``[N, M * Q * W_T * D_T]`` allows; the others are not
        computed."""
        row, footprint = mask.nonzero(as_tuple=True)
        scores = self.scores(observation, row, footprint)
        return scores.new_full(mask.shape, MASKED).index_put((row, footprint), scores)

    def logits(self, observation: Observation) -> Tensor:
        return self.footprint_logits(observation, observation[f"{self.masks[0]}_mask"])

    def unmasked_scores(self, observation: Observation) -> Tensor:
        totes, items = observation["tote_depth"], listed_items(observation)
        parities = self.cell.parities * (1 if items is None else items.x.shape[1])  # of each item
        return self.scores(observation, *every_footprint(totes, parities)).view(totes.shape[0], -1)

    def choice_logits(self, observation: Observation, choices: Tensor) -> Tensor:
        row = torch.arange(len(choices), device=choices.device).repeat_interleave(choices.shape[1])
        return self.scores(observation, row, choices.flatten()).view(choices.shape)

    def to_action(self, choice: Tensor, observation: Observation) -> Tensor:
        maps = unchecked_maps(self.cell, State.from_observation(observation))  # the mask has looked
        return pick_one(actions_reaching(self.cell, maps, choice))

    def to_choice(self, action: Tensor, observation: Observation) -> Tensor:
        step = apply(self.cell, State.from_observation(observation), action)
        x, y, w, _ = step.footprint.unbind(-1)
        turned = (w != step.item.w).long()  # a square item is the same either way
        footprint = footprint_index(self.cell.tote_size, turned, x, y)
        return footprint if step.taken is None else footprint + step.taken * self.cell.num_footprints

    def action_log_probs(self, observation: Observation) -> Tensor:
        """Return the distribution over flat actions ``[N, N_a]``.

        An action whose pick misses, or whose item leaves the tote, has no footprint, so probability 0.
        """
        footprint = action_footprints(self.cell, items_from_observation(observation))
        scores = self.unmasked_scores(observation)
        ways = count_ways(scores.shape[1], footprint, footprint >= 0)
        logits = torch.where(ways > 0, scores, MASKED)
        share = logits.log_softmax(-1) - ways.clamp(min=1).log()
        return torch.where(footprint >= 0, share.gather(1, footprint.clamp(min=0)), MASKED)

    def best_feasible(self, observation: Observation, maps: PlacingMaps | None = None) -> Tensor:
        maps = self.maps_of(observation) if maps is None else maps
        choice = self.footprint_logits(observation, self.ranked(maps)).argmax(1)
        return first_action_reaching(self.cell, maps, choice)


class GraspPolicy(Policy):
    """``fcn_grasp`` without a mask: chooses among (grasp class, place cell), feasible or not, or to miss the item.

    The grasp class says how the item lies under the rotated end effector. All picks that lift nothing are one more
    choice, which the policy must learn to avoid, as it must learn walls, collisions and support.

    Args:
        cell: the sizes.
        network: arguments of :class:`~pickplace.policies.fcn_grasp.network.FootprintFcn`, which scores each
            footprint once for every offset of the item under the end effector.
    """

    choice_key = "grasp"
    map_keys = MAP_KEYS
    scored: Tensor  # see `_scored`

    def __init__(self, cell: CellSpec, **network):
        super().__init__(cell)
        refuse_several_items(cell, "model=fcn_grasp and model.mask_infeasible=False")
        self.classes = num_grasp_turns(cell) * cell.num_offsets**2
        self.network = FootprintFcn(cell.num_offsets**2, **network)
        self.miss, self.outside = (nn.Parameter(torch.zeros(())) for _ in range(2))
        self.register_buffer("scored", self._scored(), persistent=False)

    def _scored(self) -> Tensor:
        """Return where among the network's scores each (grasp class, place cell) is found, int64 ``[C, W_T * D_T]``.

        The last score is that of every footprint whose corner is not in the tote.
        """
        (tote_w, tote_d, _), offsets, low = self.cell.tote_size, self.cell.num_offsets, self.cell.min_offset
        step, x, y = torch.arange(offsets), torch.arange(tote_w), torch.arange(tote_d)
        found = []
        for turn in range(num_grasp_turns(self.cell)):  # those of one parity have the same scores
            parity, shape = turn % 2, self.cell.effector(turn)
            left = x[:, None] + (step[:, None, None, None] + low - shape.ref_x)  # [O, 1, W_T, 1]
            front = y + (step[:, None, None] + low - shape.ref_y)  # [O, 1, D_T]
            # The network sees a turned footprint along the item's own axes.
            along, across = (step[:, None], step) if parity == 0 else (step, step[:, None])
            channel = class_index(self.cell, 0, along, across)
            inside = ~is_outside(left, 1, tote_w) & ~is_outside(front, 1, tote_d)
            index = footprint_index(self.cell.tote_size, parity, left, front) * offsets**2 + channel[:, :, None, None]
            last = self.cell.num_footprints * offsets**2
            found.append(torch.where(inside, index, last).flatten(2).flatten(0, 1))
        return torch.cat(found)

    def class_scores(self, observation: Observation) -> Tensor:
        """Return a logit for every (grasp class, place cell), ``[N, C, W_T * D_T]``."""
        bins, totes, bearing = (observation[key] for key in MAP_KEYS)
        scores = self.network(bins, totes, bearing, self.cell.parities).flatten(1)
        return torch.cat([scores, self.outside.expand(len(scores), 1)], 1)[:, self.scored]

    def _choices(self, observation: Observation) -> tuple[Tensor, Tensor, Tensor]:
        """Return per choice a logit for each of its flat actions, and how many these are; and each pick's class."""
        maps, places = self.class_scores(observation), self.cell.num_places
        logits = torch.cat([maps.flatten(1), self.miss.expand(len(maps), 1)], 1)
        picks = pick_classes(self.cell, item_from_depth(observation["bin_depth"]))
        missing = (picks < 0).sum((1, 2)) * places
        counts = maps.new_zeros(len(maps), maps.shape[1] + 1).scatter_add_(
            1, picks.flatten(1) + 1, torch.ones_like(picks, dtype=maps.dtype).flatten(1)
        )
        ways = torch.cat([counts[:, 1:].repeat_interleave(places, 1), missing[:, None]], 1)
        return logits, ways, picks

    def logits(self, observation: Observation) -> Tensor:
        logits, ways, _ = self._choices(observation)
        return torch.where(ways > 0, logits + ways.clamp(min=1).log(), MASKED)

    def to_action(self, choice: Tensor, observation: Observation) -> Tensor:
        cell, places = self.cell, self.cell.num_places
        missed = choice == self.classes * places
        wanted = torch.where(missed, -1, choice // places)
        classes = pick_classes(cell, item_from_depth(observation["bin_depth"])).flatten(1)
        pairs = classes == wanted[:, None]  # [N, P * R]
        pair = pick_one(torch.where(pairs, torch.arange(pairs.shape[1], device=choice.device), -1))
        anywhere = torch.zeros_like(choice)
        if exploration_type() == ExplorationType.RANDOM:
            anywhere = torch.randint(places, choice.shape, device=choice.device)
        place = torch.where(missed, anywhere, choice % places)
        return join_action(cell, pair // cell.rotations, place, pair % cell.rotations)

    def to_choice(self, action: Tensor, observation: Observation) -> Tensor:
        places = self.cell.num_places
        pick, place, rotation = split_flat(self.cell, action)
        classes = pick_classes(self.cell, item_from_depth(observation["bin_depth"]))
        grasp = classes[torch.arange(len(action), device=action.device), pick, rotation]
        return torch.where(grasp < 0, self.classes * places, grasp * places + place)

    def action_log_probs(self, observation: Observation) -> Tensor:
        logits, ways, picks = self._choices(observation)
        total = torch.where(ways > 0, logits + ways.clamp(min=1).log(), MASKED).logsumexp(1, keepdim=True)
        maps = (logits - total)[:, :-1].unflatten(1, (-1, self.cell.num_places))
        missed = (logits - total)[:, -1:, None].expand(-1, 1, self.cell.num_places)
        rows = torch.cat([missed, maps], 1)  # row 0 is a miss
        batch = torch.arange(len(rows), device=rows.device)[:, None, None]
        return rows[batch, picks + 1].transpose(2, 3).flatten(1)  # [N, P, R, places] -> [N, N_a]


def fcn_grasp(cell: CellSpec, mask_infeasible: bool, **network) -> FootprintPolicy | GraspPolicy:
    """Return the default policy (config ``model=fcn_grasp``): over footprints with a mask, over grasps without."""
    return (FootprintPolicy if mask_infeasible else GraspPolicy)(cell, **network)
