"""The robot's reach, a setting of the cell, and the tables of limits that the rules read."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pickplace.common.capture import constant_on
from pickplace.rules.checks import is_within_reach
from pickplace.rules.maps import FAR, NEVER

#: Greatest coordinate, in sides of a cell.
MAX_COORDINATE = 1e5
#: Tolerance of limits for rounding errors: three times 0.1 is not exactly 0.3 in binary fractions.
ROUNDING = 1e-6


class Reach(ABC):
    """The robot's reach, a setting of the cell; objects of the same reach are equal, except :class:`Limits`."""

    @abstractmethod
    def limits(self, cell: Any) -> "Limits":
        """Return the limits of a robot with this reach in a :class:`~pickplace.rules.cell.CellSpec`."""

    def picks(self, cell: Any, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return the range of heights of the suction face for centres of the gripper anywhere in the bin.

        Args:
            cell: the sizes.
            x, y: from the bin's corner, in cells; float64 of one shape.

        Returns:
            Lowest and highest, in height units, integers of that shape; an empty range where the robot cannot go.
            None: unknown; a centre then counts as reached if the robot reaches all pick cells around it.
        """
        return None


@dataclass(frozen=True, eq=False)
class Limits(Reach):
    """Limits of the robot, as tables that masks and the single step read; for cells of one size and height unit.

    Attributes:
        pick_ok: bool ``[P]``, whether the robot reaches each pick cell.
        lowest_top, highest_top: int ``[R, W_T, D_T]``, the range of the item's top, which is level with the suction
            face, for each rotation and place cell; in height units. An empty range forbids the place cell.
        lowest_pick, highest_pick: int ``[P]``, the same range for each pick cell; None: any height.
    """

    pick_ok: Tensor
    lowest_top: Tensor
    highest_top: Tensor
    lowest_pick: Tensor | None = None
    highest_pick: Tensor | None = None

    @classmethod
    def of_picks(cls, cell: Any, pick_ok: Tensor) -> "Limits":
        """Return the limits that forbid some picks, and nothing else."""
        places = torch.zeros(cell.rotations, *cell.tote_size[:2], dtype=torch.int64, device=pick_ok.device)
        return cls(pick_ok, places, places + FAR)

    def limits(self, cell: Any) -> "Limits":
        return self

    def check(self, cell: Any) -> None:
        """Raise ``ValueError`` for tables of another shape or type than the cell needs, naming the table."""
        picks, places = [cell.num_picks], [cell.rotations, *cell.tote_size[:2]]
        shapes = {"pick_ok": picks, "lowest_top": places, "highest_top": places}
        if self.lowest_pick is not None or self.highest_pick is not None:
            shapes |= {"lowest_pick": picks, "highest_pick": picks}
        for name, shape in shapes.items():
            table, kind = getattr(self, name), "bool" if name == "pick_ok" else "integers"
            fits = table is not None and [*table.shape] == shape and not table.dtype.is_floating_point
            if not fits or (table.dtype == torch.bool) != (kind == "bool"):
                found = "None" if table is None else f"{table.dtype} of shape {[*table.shape]}"
                raise ValueError(f"limits.{name}: got {found}, expected {kind} of shape {shape}.")

    def to(self, device) -> "Limits":
        """Return the tables on a device."""
        tables = {name: table for name, table in vars(self).items() if table is not None}
        return replace(self, **{name: constant_on(table, torch.device(device)) for name, table in tables.items()})

    def allow_pick(self, pick: Tensor, face: Tensor) -> Tensor:
        """Return whether the suction face may be at a height over pick cells; flat indices and heights broadcast."""
        if self.lowest_pick is None or self.highest_pick is None:
            return self.pick_ok[pick]
        return self.pick_ok[pick] & is_within_reach(self.lowest_pick[pick], self.highest_pick[pick], face)


def whole_heights(cell: Any, lowest: Tensor, highest: Tensor) -> tuple[Tensor, Tensor]:
    """Convert ranges of heights from sides of a cell to whole height units, int32, rounded inwards."""
    low, high = lowest / cell.height_unit - ROUNDING, highest / cell.height_unit + ROUNDING
    return low.clamp(0, FAR).ceil().int(), high.clamp(NEVER, FAR).floor().int()
