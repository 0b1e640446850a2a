"""The robot's reach as a setting of the cell: where the centre of the suction face may be.

All lengths are in sides of a cell, heights too, whatever the cell's height unit is.
"""

import csv
import io
import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pickplace.common.files import read_text
from pickplace.common.validate import excerpt, is_number
from pickplace.rules.cell import CellSpec, Limits, Reach, effector_centre
from pickplace.rules.maps import FAR, NEVER

#: Greatest coordinate, in sides of a cell, and greatest size of a table, in bytes.
MAX_COORDINATE, MAX_TEXT = 1e5, 100_000_000
#: By how much rounded numbers may pass a limit: three times 0.1 is not exactly 0.3 in binary fractions.
ROUNDING = 1e-6


def _whole_heights(cell: CellSpec, lowest: Tensor, highest: Tensor) -> tuple[Tensor, Tensor]:
    """Return the ranges of whole height units inside ranges in sides of a cell, int32; from 0 to beyond any height."""
    low = (lowest / cell.height_unit - ROUNDING).clamp(0, FAR).ceil()
    high = (highest / cell.height_unit + ROUNDING).clamp(NEVER, FAR).floor()
    return low.int(), high.int()


def _numbers(key: str, value, count: int, expected: str) -> tuple[float, ...]:
    """Return a list of numbers as a tuple."""
    good = isinstance(value, (list, tuple)) and len(value) == count and all(map(is_number, value))
    if not good or max(map(abs, value)) > MAX_COORDINATE:
        raise ValueError(f"{key}={excerpt(value)}: expected {expected}, up to {MAX_COORDINATE:,.0f} sides of a cell.")
    return tuple(map(float, value))


@dataclass(frozen=True)
class Annulus(Reach):
    """An upright hollow cylinder about the axis of the robot's base.

    The base's frame has its origin on that axis. Its x and y are parallel to those of bin and tote, z points upwards.

    Args:
        radii: least and greatest distance of the suction face's centre from the axis.
        heights: lowest and highest suction face.
        bin: near corner of the bin's floor, ``(x, y, z)`` in the base's frame.
        tote: the same of the tote.

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
            value = _numbers(f"reach.{key}", getattr(self, key), count, expected)
            if count == 2 and (value[0] > value[1] or (key == "radii" and value[0] < 0)):
                raise ValueError(f"reach.{key}={[*value]}: expected {expected}.")
            object.__setattr__(self, key, value)

    def limits(self, cell: CellSpec) -> Limits:
        def centres(grid, sides) -> tuple[Tensor, Tensor]:
            """Return the effector's centres for all cells of a grid: x as a column, y as a row."""
            x, y = (effector_centre(torch.arange(count), side) for count, side in zip(grid, sides, strict=False))
            return x.double()[:, None], y.double()

        lowest_pick, highest_pick = (
            part.flatten() for part in self.picks(cell, *centres(cell.bin_size, cell.effector_size))
        )
        turned = [cell.effector_size[:: -1 if rotation % 2 else 1] for rotation in range(cell.rotations)]
        places = [self._range(cell, self.tote, *centres(cell.tote_size, sides)) for sides in turned]
        lowest, highest = (torch.stack(parts) for parts in zip(*places, strict=True))
        return Limits(lowest_pick <= highest_pick, lowest, highest, lowest_pick, highest_pick)

    def picks(self, cell: CellSpec, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return self._range(cell, self.bin, x, y)

    def _range(self, cell: CellSpec, corner: tuple[float, ...], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return lowest and highest suction face at points of a grid with that corner, int32, in height units."""
        distance = torch.hypot(x + corner[0], y + corner[1])
        inside = (distance >= self.radii[0] - ROUNDING) & (distance <= self.radii[1] + ROUNDING)
        heights = torch.tensor(self.heights, dtype=torch.float64) - corner[2]
        lowest, highest = _whole_heights(cell, *heights)
        return lowest.expand(inside.shape), torch.where(inside, highest, NEVER)


COLUMNS = ["where", "x", "y", "rotation", "lowest", "highest"]


@dataclass(frozen=True)
class ReachTable(Reach):
    """The poses that the robot reaches, from a CSV file; all others are out of reach.

    Args:
        path: a file with the header ``where,x,y,rotation,lowest,highest`` and a row for each pose. ``where`` is
            ``bin`` or ``tote``; ``x`` and ``y`` are the pick cell or the place cell; ``rotation`` is the number of
            quarter turns in the tote, and empty in the bin; ``lowest`` and ``highest`` are the heights above the floor
            between which the suction face may be, in sides of a cell; empty: there is no limit.

    Raises:
        ValueError: for a file that cannot be used, naming the line and the value.
    """

    path: str = field(compare=False)  # of a table the content counts, not its place
    rows: tuple[tuple[str, int, int, int, float, float], ...] = field(init=False, repr=False)
    lines: dict[tuple, int] = field(init=False, repr=False, compare=False)  # of each pose

    def __post_init__(self):
        path = str(self.path)
        try:
            reader = csv.reader(io.StringIO(read_text(path, MAX_TEXT, "utf-8-sig", empty=False), newline=""))
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
        except FileNotFoundError as error:
            expected = f"a CSV with columns {','.join(COLUMNS)}"
            raise ValueError(f"reach.path={path!r}: no such file; expected {expected}.") from error
        except csv.Error as error:
            raise ValueError(f"{path}: {error}; expected a CSV in UTF-8.") from error
        header = lines[0][1] if lines else []
        if header != COLUMNS:
            raise ValueError(f"{path}: the header is {excerpt(','.join(header))}, expected {','.join(COLUMNS)!r}.")
        found: dict[tuple, int] = {}
        rows = []
        for line, texts in lines[1:]:
            if not any(texts):
                continue
            row = _row(f"{path}, line {line}", texts)
            if row[:4] in found:
                raise ValueError(
                    f"{path}, line {line}: got {excerpt(','.join(texts))}, the same pose as in line {found[row[:4]]}; "
                    "expected one row for each."
                )
            found[row[:4]] = line
            rows.append(row)
        if not rows:
            raise ValueError(f"{path}: no poses, expected at least one row below the header.")
        object.__setattr__(self, "path", path)
        object.__setattr__(self, "rows", tuple(sorted(rows)))
        object.__setattr__(self, "lines", found)

    def limits(self, cell: CellSpec) -> Limits:
        tables = {}
        for where, (wide, deep, _), turns in (("bin", cell.bin_size, 1), ("tote", cell.tote_size, 4)):
            rows = [row for row in self.rows if row[0] == where]
            for row in rows:
                if row[1] >= wide or row[2] >= deep:
                    raise ValueError(
                        f"{self.path}, line {self.lines[row[:4]]}: x={row[1]}, y={row[2]} is not in the {where}; "
                        f"expected one of its {wide}x{deep} cells."
                    )
            index = torch.tensor([(row[3], *row[1:3]) for row in rows], dtype=torch.int64).view(-1, 3).unbind(1)
            heights = torch.tensor([row[4:] for row in rows], dtype=torch.float64).view(-1, 2).unbind(1)
            lowest = torch.zeros(turns, wide, deep, dtype=torch.int32)
            highest = torch.full_like(lowest, NEVER)
            lowest[index], highest[index] = _whole_heights(cell, *heights)
            tables[where] = lowest, highest
        lowest_pick, highest_pick = (part.flatten() for part in tables["bin"])
        lowest, highest = (part[: cell.rotations] for part in tables["tote"])
        return Limits(lowest_pick <= highest_pick, lowest, highest, lowest_pick, highest_pick)


def _row(place: str, texts: list[str]) -> tuple[str, int, int, int, float, float]:
    """Return the values of a row."""

    def refuse(column: str, expected: str) -> ValueError:
        return ValueError(f"{place}: {column}={excerpt(row[column])}: expected {expected}.")

    if len(texts) != len(COLUMNS):
        raise ValueError(f"{place}: got {excerpt(','.join(texts))}, expected {','.join(COLUMNS)}.")
    row = dict(zip(COLUMNS, texts, strict=True))
    if row["where"] not in ("bin", "tote"):
        raise refuse("where", "bin or tote")
    for column in ("x", "y"):
        if not row[column].isdecimal() or len(row[column]) > 6:
            raise refuse(column, "a cell, a whole number >= 0")
    if row["rotation"] not in ([""] if row["where"] == "bin" else ["0", "1", "2", "3"]):
        raise refuse("rotation", "nothing in the bin" if row["where"] == "bin" else "0, 1, 2 or 3 quarter turns")
    heights = []
    for column, unlimited in (("lowest", 0.0), ("highest", math.inf)):
        try:
            heights.append(float(row[column]) if row[column] else unlimited)
        except ValueError:
            heights.append(math.nan)
        if row[column] and not abs(heights[-1]) <= MAX_COORDINATE:
            raise refuse(column, "a height in sides of a cell, or nothing")
    if heights[0] > heights[1]:
        raise refuse("highest", f"at least lowest={row['lowest'] or 0}")
    return row["where"], int(row["x"]), int(row["y"]), int(row["rotation"] or 0), heights[0], heights[1]
