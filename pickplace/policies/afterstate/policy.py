"""The policy that judges a placement by the tote that it leaves."""

import torch
from torch import Tensor

from pickplace.common.validate import number
from pickplace.policies.afterstate.network import ToteValue
from pickplace.policies.base import refuse_several_items
from pickplace.policies.footprints import FootprintPolicy
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import split_footprint, turned_size
from pickplace.rules.item import Observation, item_from_depth
from pickplace.rules.maps import FAR, rectangle


class Afterstate(FootprintPolicy):
    """``afterstate``: chooses, among the footprints that occupy a corner, the one whose tote is worth most.

    The reward of an item is its volume wherever it lies, so that placements differ only in the tote that they leave,
    the *afterstate* (Sutton & Barto 2018, section 6.8). Its value is what ``algo=td`` learns; the logit of a footprint
    is the value of its afterstate, divided by a temperature.

    Args:
        cell: the sizes.
        mask_infeasible: must be true.
        temperature: of the softmax over the values in training, in units of the scaled reward.
        **network: arguments of :class:`~pickplace.policies.afterstate.network.ToteValue`.
    """

    map_keys = ("bin_depth", "tote_depth", "tote_height")
    mask = "corner"
    network_class = ToteValue
    check_cell = refuse_several_items

    def __init__(self, cell: CellSpec, mask_infeasible: bool = True, temperature: float = 0.003, **network):
        super().__init__(cell, mask_infeasible, **network)
        self.temperature = number("model.actor.temperature", temperature, 1e-6)

    def value_network(self) -> ToteValue:
        return self.network

    def learning_bytes(self, samples: int | None = None) -> int:
        """Return about how many bytes a frame takes, measured at totes of 10 to 100 cells."""
        wide, deep, steps = self.network.grid
        tote_w, tote_d, _ = self.cell.tote_size
        return 8 * (tote_w * tote_d + wide * deep * (steps + 3 + self.network.around.out_channels))

    def scores(self, observation: Observation, row: Tensor, footprint: Tensor) -> Tensor:
        after = depth_after(observation["bin_depth"], observation["tote_depth"], row, footprint)
        return self.network(after, observation["tote_height"][row])[:, 0] / self.temperature


def depth_after(bin_depth: Tensor, tote_depth: Tensor, row: Tensor, footprint: Tensor) -> Tensor:
    """Return the remaining height of totes after the item came to rest on a footprint, ``[M, W_T, D_T]``.

    Args:
        bin_depth, tote_depth: ``[N, W_B, D_B]``, ``[N, W_T, D_T]``.
        row: int64 ``[M]``, which problem.
        footprint: int64 ``[M]``, index ``(parity * W_T + x) * D_T + y``; what leaves the tote is cut off.
    """
    item, depth = item_from_depth(bin_depth).rows(row), tote_depth[row]
    parity, x, y = split_footprint(depth.shape[1:], footprint)
    inside = rectangle(depth.shape[1:], x, y, *turned_size(item, parity == 1)).permute(2, 0, 1)
    rest = torch.where(inside, depth, FAR).amin((1, 2))
    return torch.where(inside, (rest - item.h)[:, None, None], depth)
