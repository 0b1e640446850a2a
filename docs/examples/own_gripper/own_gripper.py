"""A grip rule of your own: the cup must hold an item with two cells, or with its whole top if that is smaller."""

from dataclasses import dataclass

from pickplace.rules.gripper.base import Gripper


@dataclass(frozen=True)
class TwoCells(Gripper):
    """Grips an item on which a number of the cup's cells lies, or all cells of a smaller item.

    Args:
        cells: that number.
    """

    cells: int = 2

    @property
    def least_cells(self):
        """The least number of the cup's cells that can grip any item."""
        return 1

    def is_gripped(self, near_x, near_y, w, d, inset):
        """Return whether items ``[...]`` are gripped; ``near`` is from the gripper's minimum corner to the item's.

        ``inset`` is how many cells along each edge a measured item may not cover; only the others count.
        """
        x, y = inset
        w, d = w - 2 * x, d - 2 * y
        held = self.count_cells(self.shared_sides(near_x + x, near_y + y, w, d))
        return held >= (w * d).clamp(1, self.cells)
