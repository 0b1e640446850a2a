"""A robot that reaches the poses in a file, which its inverse kinematics may have made."""

import math
from dataclasses import dataclass, field

import torch

from pickplace.common.files import read_table
from pickplace.common.validate import excerpt, expect
from pickplace.rules.cell import CellSpec
from pickplace.rules.maps import NEVER
from pickplace.rules.reach.base import MAX_COORDINATE, Limits, Reach, whole_heights

HEADER = "where,x,y,rotation,lowest,highest"


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

    path: str = field(compare=False)  # tables with the same content are equal
    rows: tuple[tuple[str, int, int, int, float, float], ...] = field(init=False, repr=False)
    lines: dict[tuple, int] = field(init=False, repr=False, compare=False)  # line number of each pose

    def __post_init__(self):
        path, rows = str(self.path), []
        found: dict[tuple, int] = {}
        for line, texts in read_table("reach.path", path, HEADER)[1]:
            row = _row(f"{path}, line {line}", texts)
            if (first := found.setdefault(row[:4], line)) != line:
                raise ValueError(
                    f"{path}, line {line}: got {excerpt(','.join(texts))}, the same pose as in line {first}; "
                    "expected one row for each."
                )
            rows.append(row)
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
            lowest[index], highest[index] = whole_heights(cell, *heights)
            tables[where] = lowest, highest
        lowest_pick, highest_pick = (part.flatten() for part in tables["bin"])
        lowest, highest = (part[: cell.rotations] for part in tables["tote"])
        return Limits(lowest_pick <= highest_pick, lowest, highest, lowest_pick, highest_pick)


def _row(place: str, texts: list[str]) -> tuple[str, int, int, int, float, float]:
    columns = HEADER.split(",")
    if len(texts) != len(columns):
        raise ValueError(f"{place}: got {excerpt(','.join(texts))}, expected {HEADER}.")
    row = dict(zip(columns, texts, strict=True))

    def check(column: str, good: bool, expected: str) -> None:
        expect(good, f"{place}: {column}", row[column], expected)

    check("where", row["where"] in ("bin", "tote"), "bin or tote")
    for column in ("x", "y"):
        check(column, row[column].isdecimal() and len(row[column]) <= 6, "a cell, a whole number >= 0")
    turns, expected = {
        "bin": ([""], "nothing in the bin"),
        "tote": (["0", "1", "2", "3"], "0, 1, 2 or 3 quarter turns"),
    }[row["where"]]
    check("rotation", row["rotation"] in turns, expected)
    heights = []
    for column, unlimited in (("lowest", 0.0), ("highest", math.inf)):
        try:
            heights.append(float(row[column]) if row[column] else unlimited)
        except ValueError:
            heights.append(math.nan)
        check(column, not row[column] or abs(heights[-1]) <= MAX_COORDINATE, "a height in sides of a cell, or nothing")
    check("highest", heights[0] <= heights[1], f"at least lowest={row['lowest'] or 0}")
    return row["where"], int(row["x"]), int(row["y"]), int(row["rotation"] or 0), heights[0], heights[1]
