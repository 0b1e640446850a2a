"""Loads on the items in a tote, from the record of the placed items."""

import math
from typing import cast

import torch

from pickplace.robot.box import MILLIMETRE, Box, DepthMapError
from pickplace.robot.scene import BinMap, Scene
from pickplace.rules.measured import MeasuredTote, level_step
from pickplace.rules.measured_loads import ANY_LOAD, UNKNOWN_MASS, MeasuredLoads


def grams_of(box: Box) -> int:
    """Return the mass of a box, rounded up; grams. An unknown mass counts as more than any limit."""
    return math.ceil(1000 * box.mass - 1e-6) if box.mass > 0 else UNKNOWN_MASS


def read_loads(scene: Scene, tote: MeasuredTote, per_cell: int) -> MeasuredLoads | None:
    """Return the loads on the items in the tote; None if no box has a ``max_load``, and there is no mass or no record.

    Args:
        scene: in metres, with the record of the tote.
        tote: the same tote, as measured.
        per_cell: number of patches of its map along the side of a cell.

    Raises:
        DepthMapError: if an item has a ``max_load``, and the scene has no record.
    """
    items = () if isinstance(scene.items, BinMap) else scene.items
    placed, side = scene.placed, cast(float, scene.cell_size)
    boxes = (*items, *(placed or ()))
    has_limits = any(box.max_load is not None for box in boxes)
    if not has_limits and (placed is None or not any(box.mass for box in boxes)):
        return None
    if placed is None:
        raise DepthMapError(
            "placed=None: some items have a max_load; expected what lies in the tote, plan.placed of the plans before, "
            "or [] for an empty one."
        )
    bounds = []
    for box in placed:
        cos, sin = abs(math.cos(math.radians(box.yaw))), abs(math.sin(math.radians(box.yaw)))
        sides = box.w * cos + box.d * sin, box.w * sin + box.d * cos
        reach = [along / 2 / side + tote.placement_error for along in sides]
        x, y = box.x / side, box.y / side
        bounds.append([x - reach[0], x + reach[0], y - reach[1], y + reach[1]])
    limits = [ANY_LOAD if box.max_load is None else math.floor(1000 * box.max_load + 1e-6) for box in placed]
    columns = [round(box.h / MILLIMETRE) for box in placed], [*map(grams_of, placed)], limits
    device, step = tote.highest.device, level_step(tote.accuracy)
    tops, grams, max_load = (torch.tensor(column, dtype=torch.int64, device=device) for column in columns)
    spans = torch.tensor(bounds, dtype=torch.float64, device=device).reshape(-1, 4)
    return MeasuredLoads.of(spans, tops, grams, max_load, tote.highest, per_cell, step)
