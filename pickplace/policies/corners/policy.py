"""The policy for fine grids: it chooses among the footprints that occupy a corner."""

from pickplace.policies.corners.network import CornerNet
from pickplace.policies.footprints import FOOTPRINT_INDEX, FootprintPolicy


class Corners(FootprintPolicy):
    """``corners``: as ``fcn_grasp`` with a mask, but among some dozens of footprints, see
    :func:`~pickplace.rules.masks.corner_mask`.

    Args:
        cell: the sizes.
        mask_infeasible: must be true.
        **network: arguments of :class:`~pickplace.policies.corners.network.CornerNet`.
    """

    mask = "corner"
    network_class = CornerNet
    score_index = FOOTPRINT_INDEX
