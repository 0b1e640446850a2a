"""The policy for fine grids: it chooses among the footprints that occupy a corner."""

from torch import Tensor

from pickplace.policies.corners.network import CornerNet
from pickplace.policies.fcn_grasp.policy import FootprintPolicy
from pickplace.rules.cell import CellSpec
from pickplace.rules.corners import corner_mask
from pickplace.rules.masks import PlacingMaps


class CornerPolicy(FootprintPolicy):
    """``corners``: as ``fcn_grasp`` with a mask, but among some dozens of footprints (:mod:`pickplace.rules.corners`).

    Args:
        cell: the sizes.
        network: arguments of :class:`~pickplace.policies.corners.network.CornerNet`.
    """

    masks: tuple[str, ...] = ("corner",)
    network: CornerNet  # type: ignore[assignment]

    def make_network(self, **network) -> CornerNet:
        return CornerNet(**network)

    def ranked(self, maps: PlacingMaps) -> Tensor:
        return maps.join(corner_mask(self.cell, maps))


def corners(cell: CellSpec, mask_infeasible: bool, **network) -> CornerPolicy:
    """Return the policy for fine grids (config ``model=corners``).

    Raises:
        ValueError: without a mask, as its few choices come from what is feasible.
    """
    if not mask_infeasible:
        raise ValueError(
            "model.mask_infeasible=False: with model=corners expected true; its choices are feasible ones."
        )
    return CornerPolicy(cell, **network)
