"""Plan picks and places for the items of an order list, which arrive one by one: python order_to_robot.py orders.csv

Prints a CSV in millimetres. Items that find no place are listed with the reason, and the next ones are tried. The
robot turns items about the vertical only; a column ``orientations`` is not read.
"""

import csv
import math
import sys

import numpy as np

from pickplace import Box, DepthMapError, Planner, Scene
from pickplace.items.order_file import read_orders
from pickplace.rules.item import NO_LIMIT

CELL, SQUARE = 0.02, 0.01  # sides of a cell of the planner, and of a square of the tote's map; m
CUP = {"effector_size": (6, 6), "cup_size": (2, 2)}  # your gripper, in cells: a round body of 110 mm, a cup of 40 mm


def plan_order(planner, items):
    """Yield each item with its plan, or the error if it does not fit the bin; update the map of the tote."""
    wide, deep, high = planner.cell.tote_size
    height = high * planner.cell.height_unit * CELL
    free = np.full((round(wide * CELL / SQUARE), round(deep * CELL / SQUARE)), height)  # up to the rim
    x, y = (side * CELL / 2 for side in planner.cell.bin_size[:2])  # each item lies in the middle of the bin
    placed, bearing = [], None
    for item in items:
        w, d, h = (side / 1000 for side in (item.length, item.width, item.height))
        load = None if item.max_load == NO_LIMIT else item.max_load / 1000
        box = Box(x, y, w, d, h, mass=item.grams / 1000, max_load=load)
        try:
            plan = planner.plan(Scene([box], free, CELL, placed=placed, tote_bearing=bearing), alternatives=0)
        except DepthMapError as error:
            yield item, error
            continue
        if plan.status == "ok":
            at = plan.placed
            along_x, along_y = (
                slice(math.floor((centre - side / 2) / SQUARE + 1e-6), math.ceil((centre + side / 2) / SQUARE - 1e-6))
                for centre, side in ((at.x, at.w), (at.y, at.d))
            )
            free[along_x, along_y] = height - at.h  # h: height of its top
            placed, bearing = [*placed, at], plan.tote_bearing
        yield item, plan


def row_of(order, item, plan):
    """Return a row of the table; the tool's positions are those of docs/robot.md."""
    if isinstance(plan, DepthMapError):
        return {"order": order, "id": item.id, "status": "refused", "reason": plan}
    row = {"order": order, "id": item.id, "status": plan.status}
    if plan.status == "ok":
        points = {"pick": plan.pick.center, "place": plan.place.center}
        places = {f"{name}_{axis}/mm": round(1000 * value) for name, point in points.items() for axis, value in
                  zip("xyz", point, strict=True)}  # fmt: skip
        return row | places | {"turn/degrees": plan.rotation_degrees, "fill": f"{plan.occupancy_after:.1%}"}
    return row | {"reason": " ".join(plan.hints) or f"no place: {', '.join(plan.reasons)}"}


def main(path):
    planner = Planner.load("pretrained/warehouse", **CUP)
    table = csv.DictWriter(sys.stdout, [
        "order", "id", "status", *(f"{what}_{axis}/mm" for what in ("pick", "place") for axis in "xyz"),
        "turn/degrees", "fill", "reason",
    ])  # fmt: skip
    table.writeheader()
    for order in read_orders(path, key="order"):
        for item, plan in plan_order(planner, order.items):
            table.writerow(row_of(order.name, item, plan))


if __name__ == "__main__":
    main(sys.argv[1])
