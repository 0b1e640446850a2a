"""Measured depth maps and lengths: checked, and rounded to whole height units."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from pickplace.task.cell import CellSpec
from pickplace.task.checks import excerpt
from pickplace.task.maps import FAR
from pickplace.task.state import item_from_depth

#: Added to the tolerance, in height units: three cells of 0.05 m are not exactly 0.15 m in binary fractions.
ROUNDING = 1e-6


class DepthMapError(ValueError):
    """A depth map, or an argument beside it, that cannot be planned with; the message is one sentence."""


class Lengths:
    """Conversion between measured lengths and the cells and height units of a cell.

    Args:
        cell: the sizes.
        cell_size: side of a cell in metres, for lengths in metres; None: lengths along x and y are in cells, and
            heights in height units.
        tolerance: how far a measured height may be from a whole number of height units; below 0.5.

    Raises:
        DepthMapError: for a ``cell_size`` or a ``tolerance`` out of range.
    """

    def __init__(self, cell: CellSpec, cell_size: float | None, tolerance: float = 0.25):
        self.metric = cell_size is not None
        self.unit_name = "cells" if cell.height_unit == 1 else "height units"
        self.cell_size = 1.0
        if cell_size is not None:
            wanted = "a length in metres, 1e-6 to 1e6"
            self.cell_size = checked_number("cell_size", cell_size, wanted, lambda v: 1e-6 <= v <= 1e6)
        self.height_unit = self.cell_size * cell.height_unit if self.metric else 1.0
        wanted = f"a number of {self.unit_name} >= 0 and < 0.5"
        self.tolerance = checked_number("tolerance", tolerance, wanted, lambda v: 0 <= v < 0.5)

    def horizontal(self, cells: float) -> float:
        """Return a length along x or y."""
        return round(cells * self.cell_size, 9)  # without the tail of binary fractions

    def vertical(self, units: float) -> float:
        """Return a height."""
        return round(units * self.height_unit, 9)

    def units_of_tote_height(self, tote_height) -> int:
        """Return the measured height of a tote's rim in height units."""
        wanted = f"a whole number of {self.unit_name}, 1 to {FAR - 1}, within {self.tolerance:g}"
        wanted += ", in metres" if self.metric else ""

        def is_whole_number_in_range(length: float) -> bool:
            units = length / self.height_unit
            # The range first: a number far beyond it cannot be rounded.
            return 0.5 < units < FAR - 0.5 and abs(units - round(units)) <= self.tolerance + ROUNDING

        return round(checked_number("tote_height", tote_height, wanted, is_whole_number_in_range) / self.height_unit)

    def units_of_map(self, name: str, values, grid: tuple[int, int], highest: int) -> Tensor:
        """Return a measured map in whole height units, int64 ``grid``.

        Args:
            name: the argument's name, for messages.
            values: numpy, torch or lists.
            grid: the expected shape.
            highest: the greatest value.

        Raises:
            DepthMapError: naming the first cell that is out of range, or too far from a whole number.
        """
        array = _as_array(name, values, grid)
        with np.errstate(all="ignore"):
            units = array.astype(np.float64) / self.height_unit
            whole = np.round(units)
            precision = np.finfo(array.dtype if array.dtype.kind == "f" else float).eps  # metres may be float32
            near = np.abs(units - whole) <= self.tolerance + ROUNDING + precision * np.abs(units)  # False for NaN
            inside = (whole >= 0) & (whole <= highest)
        if not (near & inside).all():
            x, y = np.argwhere(~(near & inside))[0].tolist()
            found = f"{units[x, y]:g} {self.unit_name}" + (f" ({array[x, y]:g} m)" if self.metric else "")
            wanted = f"0 to {highest} {self.unit_name}"
            if not near[x, y]:
                wanted = f"a whole number of {self.unit_name}, within {self.tolerance:g}"
            raise DepthMapError(f"{name}[{x}, {y}]: got {found}, expected {wanted}.")
        return torch.from_numpy(whole.astype(np.int64))


def flags_of_map(name: str, values, grid: tuple[int, int]) -> Tensor:
    """Return a map of 0 and 1, int64 ``grid``; arguments and errors as of :meth:`Lengths.units_of_map`."""
    array = _as_array(name, values, grid, "biuf")
    if (bad := (array != 0) & (array != 1)).any():
        x, y = np.argwhere(bad)[0].tolist()
        raise DepthMapError(f"{name}[{x}, {y}]: got {array[x, y]:g}, expected 0 or 1.")
    return torch.from_numpy(array.astype(np.int64))


def checked_number(name: str, value, wanted: str, accepts: Callable[[float], bool]) -> float:
    """Return a value as a finite number that ``accepts`` accepts; ``wanted`` describes such numbers."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if isinstance(value, (bool, np.bool_, str, bytes)) or not np.isfinite(number) or not accepts(number):
        raise DepthMapError(f"{name}={excerpt(value)}: expected {wanted}.")
    return number


def check_one_cuboid(bin_map: Tensor, unit_name: str) -> None:
    """Refuse a bin ``[W_B, D_B]`` that does not show one cuboid: its bounding box, filled at one height."""
    if not (bin_map > 0).any():
        raise DepthMapError("bin_depth: got no cell above 0, expected one item.")
    x, y, w, d, h = (int(value) for value in item_from_depth(bin_map[None].float()))
    box = bin_map[x : x + w, y : y + d]
    if (box != h).any():
        i, j = (box != h).nonzero()[0].tolist()
        raise DepthMapError(
            f"bin_depth[{x + i}, {y + j}]: got {int(box[i, j])} {unit_name}, expected {h}: one cuboid that fills its "
            f"bounding box, {w}x{d} cells from [{x}, {y}]."
        )


def _as_array(name: str, values, grid: tuple[int, int], kinds: str = "iuf") -> np.ndarray:
    """Return a map as a numpy array in the shape of the grid; ``kinds`` are those of numpy's types."""
    try:
        if isinstance(values, Tensor):
            values = values.detach().cpu()
            values = values.float() if values.dtype == torch.bfloat16 else values  # numpy has no bfloat16
        array = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise DepthMapError(f"{name}: expected an array of {grid[0]}x{grid[1]} numbers ({error}).") from error
    if array.shape != tuple(grid):
        raise DepthMapError(
            f"{name}: got shape {list(array.shape)}, expected {list(grid)}, the grid that the planner was loaded for."
        )
    if array.dtype.kind not in kinds:
        raise DepthMapError(f"{name}: got values of type {array.dtype}, expected numbers.")
    if isinstance(values, np.ma.MaskedArray) and np.ma.getmaskarray(values).any():
        x, y = np.argwhere(np.ma.getmaskarray(values))[0].tolist()
        raise DepthMapError(f"{name}[{x}, {y}]: got a masked value, expected a measured one.")
    return array
