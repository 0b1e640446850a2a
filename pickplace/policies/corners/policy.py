"""The policy for fine grids: it chooses among the footprints that occupy a corner."""

from pickplace.policies.corners.network import CornerNet
from pickplace.policies.footprints import FOOTPRINT_INDEX, FootprintPolicy
from pickplace.rules.cell import CellSpec


class Corners(FootprintPolicy):
    """``corners``: as ``fcn_grasp`` with a mask, but among some dozens of footprints (:mod:`pickplace.rules.corners`).

    Args:
        cell: the sizes.
        mask_infeasible: must be true.
        network: arguments of :class:`~pickplace.policies.corners.network.CornerNet`.
    """

    mask = "corner"
    score_index = FOOTPRINT_INDEX
    network: CornerNet

    def __init__(self, cell: CellSpec, mask_infeasible: bool = True, **network):
        super().__init__(cell, mask_infeasible)
        self.network = CornerNet(**network)
