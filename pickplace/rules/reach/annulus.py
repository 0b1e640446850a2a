"""A robot that reaches an upright hollow cylinder about its base.

All lengths, heights included, are in sides of a cell, whatever the cell's height unit is.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from pickplace.common.validate import expect, is_number
from pickplace.rules.cell import CellSpec
from pickplace.rules.gripper.base import effector_centre
from pickplace.rules.maps import NEVER
from pickplace.rules.reach.base import MAX_COORDINATE, ROUNDING, Limits, Reach, whole_heights


@dataclass(frozen=True)
class Annulus(Reach):
    """An upright hollow cylinder about the axis of the robot's base.

    The base's frame has its origin on that axis. Its x and y are parallel to those of bin and tote, z points upwards.

    Args:
        radii: least and greatest distance of the suction face's centre from the axis.
        heights: lowest and highest suction face.
        bin: near corner of the bin's floor, ``(x, y, z)`` in the base's frame.
        tote: near corner of the tote's floor, in the same frame.

    Raises:
        ValueError: naming the argument, the value received and what was expected.
    """

    radii: tuple[float, float]
    heights: tuple[float, float]
    bin: tuple[float, float, float]
    tote: tuple[float, float, float]

    def __post_init__(self):
        for key, count, expected in (
            ("radii", 2, "[least, greatest] with 0 <= least <= greatest"),
            ("heights", 2, "[lowest, highest] with lowest <= highest"),
            ("bin", 3, "[x, y, z]"),
            ("tote", 3, "[x, y, z]"),
        ):
            value = getattr(self, key)
            good = (
                isinstance(value, (list, tuple))
                and len(value) == count
                and all(map(is_number, value))
                and max(map(abs, value)) <= MAX_COORDINATE
            )
            expect(good, f"reach.{key}", value, f"{expected}, up to {MAX_COORDINATE:,.0f} sides of a cell")
            value = [*map(float, value)]
            ordered = count == 3 or (value[0] <= value[1] and (key != "radii" or value[0] >= 0))
            expect(ordered, f"reach.{key}", value, expected)
            object.__setattr__(self, key, tuple(value))

    def limits(self, cell: CellSpec) -> Limits:
        def centres(grid, sides) -> tuple[Tensor, Tensor]:
            """Return the gripper's centres for all cells of a grid: x as a column, y as a row."""
            x, y = (effector_centre(torch.arange(count), side) for count, side in zip(grid, sides, strict=False))
            return x.double()[:, None], y.double()

        lowest_pick, highest_pick = map(torch.flatten, self.picks(cell, *centres(cell.bin_size, cell.gripper.size)))
        turned = [cell.gripper.size[:: -1 if rotation % 2 else 1] for rotation in range(cell.rotations)]
        places = [self._range(cell, self.tote, *centres(cell.tote_size, sides)) for sides in turned]
        lowest, highest = (torch.stack(parts) for parts in zip(*places, strict=True))
        return Limits(lowest_pick <= highest_pick, lowest, highest, lowest_pick, highest_pick)

    def picks(self, cell: CellSpec, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return self._range(cell, self.bin, x, y)

    def _range(self, cell: CellSpec, corner: tuple[float, ...], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return lowest and highest suction face at points of a grid with that near corner, int32, in height units."""
        distance = torch.hypot(x + corner[0], y + corner[1])
        inside = (distance >= self.radii[0] - ROUNDING) & (distance <= self.radii[1] + ROUNDING)
        lowest, highest = whole_heights(cell, *torch.tensor(self.heights, dtype=torch.float64) - corner[2])
        return lowest.expand(inside.shape), torch.where(inside, highest, NEVER)
