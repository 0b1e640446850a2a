"""The live page of a service: the last plans in 3D, in the style of the replay page."""

import base64
import hashlib
import json
import re
import time

import numpy as np

from pickplace.common.validate import excerpt
from pickplace.robot.measure import patches
from pickplace.rules.cell import CellSpec
from pickplace.serve.request import PlanRequest
from pickplace.views.replay import effector_parts, fill_template

MAX_COLUMNS = 60  # greatest number of columns along a side of the tote that the page draws


def page(cell: CellSpec) -> str:
    """Return the page of a service for a cell; it loads only ``/plans`` of this service."""
    wide, deep, height = cell.bin_size
    data = {
        "bin": [wide, deep, height * cell.height_unit],
        "tote": cell.tote_size[:2],
        **effector_parts(cell),
        "height": cell.tote_size[2] * cell.height_unit,
    }
    return fill_template("live.html", data=json.dumps(data))


def content_policy(html: str) -> str:
    """Return the ``Content-Security-Policy`` of a page: only its own scripts may run."""
    digests = [hashlib.sha256(script.encode()).digest() for script in re.findall(r"(?s)<script>(.*?)</script>", html)]
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; connect-src 'self'; img-src data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def entry(cell: CellSpec, number: int, request: PlanRequest | None, reply: dict, seconds: float) -> dict:
    """Return the content of the page for an answer, as plain values; lengths are in cells.

    Args:
        cell: the sizes.
        number: of the answer, from 1.
        request: None if it could not be read.
        reply: a plan, or an error.
        seconds: time that it took.
    """
    return {
        "number": number,
        "time": time.time(),
        "milliseconds": round(1e3 * seconds, 1),
        "id": excerpt(reply["id"]) if "id" in reply else None,
        "status": reply.get("status", "refused"),
        "error": reply.get("error"),
        "scene": None if "error" in reply or request is None else _scene(cell, request, reply),
    }


def _scene(cell: CellSpec, request: PlanRequest, plan: dict) -> dict:
    """Return the bin, the tote and the move of a plan; lengths in cells, angles in degrees."""
    side = request.cell_size
    along, up = (1.0, cell.height_unit) if side is None else (1 / side, 1 / side)  # cells per unit of length
    height = cell.tote_size[2] * cell.height_unit if request.tote_height is None else request.tote_height * up
    sides = cell.tote_size[:2]
    heights, _ = patches(height - np.asarray(request.tote_depth, float) * up, sides, max(1, MAX_COLUMNS // max(sides)))
    box, item = plan["box"], plan["item"]  # both None if there are several items and none is taken
    if item and not box:
        box = {**item, "x": item["x"] + item["w"] / 2, "y": item["y"] + item["d"] / 2, "yaw": 0.0}

    def pose(key: str) -> list[float] | None:
        x, y, z = plan[key]["center"] if plan[key] else (0, 0, 0)
        return plan[key] and [x * along, y * along, z * up, plan[key]["yaw"]]

    return {
        "height": height,
        "heights": heights.clip(0, None).round(3).tolist(),
        "item": box and [*(box[key] * along for key in "xywd"), box["h"] * up, box["yaw"]],
        "lengths": box and [box["w"], box["d"], box["h"]],
        "coming": [[box.w, box.d, box.h] for box in request.coming or ()],
        "unit": "cells" if side is None else "m",
        "pick": pose("pick"),
        "place": pose("place"),
        "turn": plan["rotation_degrees"],
        "rest": None if plan["drop_height"] is None else plan["drop_height"] * up,
        "drop_height": plan["drop_height"],
        "occupancy": [plan["occupancy_before"], plan["occupancy_after"]],
        "reasons": plan["reasons"],
        "warnings": plan["warnings"],
    }
