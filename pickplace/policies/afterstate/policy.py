"""The policies that judge a placement by the tote that it leaves."""

import torch
from torch import Tensor

from pickplace.common.validate import number
from pickplace.policies.afterstate.cells import CellsValue
from pickplace.policies.afterstate.picture import PictureValue
from pickplace.policies.afterstate.value import ToteValue
from pickplace.policies.base import MASKED
from pickplace.policies.footprints import FOOTPRINT_INDEX, FootprintPolicy, count_ways
from pickplace.rules.bin import remove_item
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Observation, coming_from_observation, items_from_observation
from pickplace.rules.masks import action_footprints, action_mask, placing_maps
from pickplace.rules.observation import STANDARD_TERMS, SeenItems, observe, seen_items
from pickplace.rules.state import State
from pickplace.rules.step import put_down


class Afterstate(FootprintPolicy):
    """``afterstate``: chooses the item and the footprint with the greatest sum of the item's volume and the value of
    the tote after it. It considers footprints that occupy a corner.

    The reward of an item is its volume, wherever it lies. So placements of one item differ only in the tote that they
    leave, the *afterstate* (Sutton & Barto 2018, section 6.8). ``algo=td`` learns the values of afterstates. The logit
    is the sum, scaled as rewards are, divided by a temperature. The value also depends on the set of items that wait:
    those left in the bin and those in the preview.

    Args:
        cell: the sizes.
        mask_infeasible: must be true.
        temperature: of the softmax over the values in training, in units of the scaled reward.
        **network: arguments of the network, :class:`~pickplace.policies.afterstate.picture.PictureValue`.
    """

    map_keys = tuple(STANDARD_TERMS)
    mask = "corner"
    network_class: type[ToteValue] = PictureValue
    excludes = "actions that fail, and footprints that occupy no corner"

    def __init__(self, cell: CellSpec, mask_infeasible: bool = True, temperature: float = 0.003, **network):
        super().__init__(cell, mask_infeasible, **network)
        self.temperature = number("model.actor.temperature", temperature, 1e-6)

    def value_network(self) -> ToteValue:
        return self.network

    def learning_bytes(self, samples: int | None = None) -> int:
        """Return the approximate bytes of a frame, measured at totes of 10 to 100 cells."""
        return self.network.learning_bytes(*self.cell.tote_size[:2])

    def item_keys(self, cell: CellSpec) -> tuple[str, ...]:
        return (*super().item_keys(cell), "coming") if cell.preview else super().item_keys(cell)

    def items_left(self, observation: Observation, choice: Tensor) -> Tensor:
        left = remove_item(self.cell, items_from_observation(observation), choice // self.cell.num_footprints)
        return seen_items(left, coming_from_observation(observation))

    def evaluate_choices(self, before: State, choice: Tensor) -> tuple[State, Tensor, Tensor]:
        after, item = put_down(self.cell, before, choice)
        seen = observe({**STANDARD_TERMS, "items": SeenItems()}, self.cell, after, self.network.in_keys)
        value = self.network.judge(before, *(seen[key] for key in self.network.in_keys))[:, 0]
        return after, item.volume, value

    def scores(self, observation: Observation, row: Tensor, footprint: Tensor) -> Tensor:
        state = State.from_observation(observation)._replace(pile=None, boxes=None)  # which the networks do not see
        before = state.rows(row)
        _, volume, value = self.evaluate_choices(before, footprint)
        less = before.items.volume.amax(1) - volume  # relative to the largest item: exactly 0 with one in the bin
        return (value - self.network.reward_scale * less) / self.temperature

    def action_log_probs(self, observation: Observation) -> Tensor:
        """Return the distribution over flat actions ``[N, N_a]``. Actions that fail leave no tote to judge: they have
        probability 0."""
        state = State.from_observation(observation)
        maps = placing_maps(self.cell, state)
        log_probs = self.footprint_logits(observation, self.ranked(maps)).log_softmax(-1)
        footprint = torch.where(action_mask(self.cell, maps), action_footprints(self.cell, state.items), -1)
        ways = count_ways(log_probs.shape[1], footprint, footprint >= 0)
        share = (log_probs - ways.clamp(min=1).log()).gather(1, footprint.clamp(min=0))
        return torch.where(footprint >= 0, share, MASKED)


class AfterstateFcn(Afterstate):
    """``afterstate_fcn``: :class:`Afterstate` with a fully convolutional network, which serves any tote.

    Args:
        cell, mask_infeasible, temperature: as in :class:`Afterstate`.
        **network: arguments of the network, :class:`~pickplace.policies.afterstate.cells.CellsValue`.
    """

    network_class = CellsValue
    score_index = FOOTPRINT_INDEX
    any_bin = False  # the rules look at squares of the largest item that the cell's bin can hold

    def __init__(self, cell: CellSpec, mask_infeasible: bool = True, **settings):
        super().__init__(cell, mask_infeasible, **settings)
        self.least_tote = max(self.least_tote, self.network.joined + 1)  # one cell of its coarsest grid is too few
