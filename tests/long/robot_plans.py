"""Print plans of robot cells as JSON lines, so that two versions of the package can be compared.

python tests/long/robot_plans.py <scenes of each of 16 planners> <plans.jsonl>

Each line is a plan with every field, or the key that an error names. The scenes are random: boxes in bin and tote,
measured as boxes, as maps in metres, as maps of whole cells, or by cameras; several planners, policies, grippers and
reaches. Run it with ``PYTHONPATH`` set to each version, then compare the files with ``diff``.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS / "robot")]

import scenes  # noqa: E402

from pickplace import Box, Camera, CellSpec, Planner, Scene  # noqa: E402
from pickplace.rules.reach.annulus import Annulus  # noqa: E402

TOTE, ACCURACY = (0.3, 0.3, 0.25), 0.002
IMAGE = (120, 160)

MIXED = {"bin_size": (8, 8, 1), "tote_size": (6, 6, 5)}
DISC = {"bin_size": (12, 12, 2), "tote_size": (15, 15, 12), "effector_size": (7, 7), "body": "disc", "cup": "disc",
        "cup_size": (3, 3), "pick_rule": "seal"}  # fmt: skip
ARRAY = {"bin_size": (6, 6, 1), "tote_size": (6, 6, 5), "cup": [[1, 0, 1], [0, 0, 0], [1, 0, 1]], "pick_rule": "seal",
         "min_seal": 0.25}  # fmt: skip
MASKS = {"body": [[1, 1, 1], [1, 0, 0], [1, 1, 0]], "cup": [[0, 0, 1], [0, 0, 0], [1, 0, 0]], "pick_rule": "overlap",
         "longest_side": 4, "support": "half"}  # fmt: skip

#: Name of the planner or checkpoint, options of the planner, sizes and options of the cell, side of a cell in metres.
CELLS = [
    ("joint_dbl", {}, MIXED, 0.05),
    ("pretrained/mixed", {}, MIXED, 0.05),
    ("joint_dbl", {}, DISC, 0.02),
    ("pretrained/r4", {}, {}, 0.05),
    ("joint_dbl", {}, ARRAY, 0.05),
    ("pretrained/mixed", {"planner": "corner"}, MIXED | {"support": "hull"}, 0.05),
    ("joint_dbl", {}, MASKS, 0.05),
    ("pretrained/unmasked", {"candidates": 5}, {}, 0.05),
    ("pretrained/paper", {}, {}, 0.05),
    ("joint_dbl", {}, MIXED | {"support": "half_or_hull", "rotations": 2, "height_unit": 0.5}, 0.05),
    ("joint_dbl", {}, MIXED | {"reach": ([0, 7.3], [-0.3, 3.7], [-7.1, -2.3, -0.7], [1.7, -3.2, 0.4])}, 0.05),
    ("individual_heuristic", {}, {"rotations": 1, "support": "full", "effector_size": (2, 3)}, 0.05),
    ("pretrained/paper", {"candidates": 7}, {}, 0.05),
    ("best_fit", {}, MIXED, 0.05),
    ("pretrained/warehouse", {}, {"bin_size": (12, 12, 5), "tote_size": (10, 9, 20)}, 0.02),
    ("pretrained/mixed", {"planner": "lookahead"}, {"tote_size": (4, 4, 5), "bin_size": (5, 5, 1)}, 0.05),
]


def plan(planner, alternatives: int, **seen):
    """Return the plan for what is seen, in the keys of a line of ``pickplace-plan``, or for the map of a camera."""
    tote = seen.pop("tote") if "tote" in seen else seen.pop("tote_depth")
    if "items" in seen:
        return planner.plan(Scene(seen.pop("items"), tote, **seen), alternatives=alternatives)
    return planner.plan(Scene.from_maps(seen.pop("bin_depth"), tote, **seen), alternatives=alternatives)


def make_planner(name: str, options: dict, sizes: dict):
    """Return a planner of a name, or of a checkpoint."""
    if "reach" in sizes:
        sizes = sizes | {"reach": Annulus(*sizes["reach"])}
    if "/" in name:
        return Planner.load(name, **options, **sizes)
    return Planner(CellSpec(**sizes), planner=name)


def random_world(draw: np.random.Generator, cell, side: float) -> scenes.World:
    """Return boxes in bin and tote of a cell, in metres."""
    sizes = {name: tuple(np.multiply(getattr(cell, f"{name}_size")[:2], side)) for name in ("bin", "tote")}
    bin_height, tote_height = (size[2] * cell.height_unit * side for size in (cell.bin_size, cell.tote_size))
    longest = draw.choice((0.25, 0.4)) * min(sizes["bin"])
    most = (longest, longest, min(0.12, tote_height / 2))
    world = scenes.random_scene(draw, (*sizes["tote"], tote_height), most, bin=(*sizes["bin"], bin_height))
    room = np.array(sizes["bin"])
    corners = scenes.rectangle((0, 0), world.item[:2], world.yaw)
    yaw = world.yaw if cell.rotations > 1 and (corners.max(0) < room / 2).all() else 0.0
    half = scenes.rectangle((0, 0), world.item[:2], yaw).max(0)
    world.yaw, world.centre = yaw, tuple(draw.uniform(half, room - half))
    if cell.rotations > 1:
        world.add_others(draw, max(0, int(draw.integers(-2, 4))), most)
    return world


def as_boxes(draw: np.random.Generator, world: scenes.World, cell, side: float) -> dict:
    """Return the scene as boxes and a tote map of 1 to 8 values along a cell, with noise."""
    along = int(draw.choice((1, 2, 5, 8)))
    heights = tote_heights(world, cell, side, along)
    boxes = []
    for (w, d, h), centre, yaw in world.in_bin():
        x, y = centre + draw.uniform(-0.003, 0.003, 2)
        boxes.append(Box(float(x), float(y), float(w), float(d), float(h + draw.uniform(-ACCURACY, ACCURACY)), yaw))
    noise = draw.uniform(-ACCURACY, ACCURACY, heights.shape)
    return {"items": boxes, "tote_depth": world.tote[2] - (heights + noise)} | metres(draw, world, cell, side)


def as_maps(draw: np.random.Generator, world: scenes.World, cell, side: float) -> dict:
    """Return the scene as maps in metres, with labels if there are several items."""
    along = int(draw.choice((1, 5)))
    shape = [size * along for size in cell.bin_size[:2]]
    square = side / along
    centres = (np.indices(shape).transpose(1, 2, 0) + 0.5) * square
    heights, labels = np.zeros(shape), np.zeros(shape, dtype=int)
    for number, ((w, d, h), centre, yaw) in enumerate(world.in_bin()):
        turn, away = math.radians(yaw), centres - centre
        over = np.abs(away @ (math.cos(turn), math.sin(turn))) < w / 2
        over &= np.abs(away @ (-math.sin(turn), math.cos(turn))) < d / 2
        heights[over], labels[over] = h, 7 - number
    tote = tote_heights(world, cell, side, along)
    seen = {"bin_depth": heights, "tote_depth": world.tote[2] - tote} | metres(draw, world, cell, side)
    return seen | ({"bin_labels": labels} if world.others else {})


def as_cells(draw: np.random.Generator, world: scenes.World, cell, side: float) -> dict:
    """Return maps of whole cells."""
    depth = np.zeros(cell.bin_size[:2], dtype=int)
    labels = np.zeros_like(depth)
    longest = min(3, *cell.bin_size[:2])
    for label in draw.permutation(np.arange(1, 9))[: 1 + len(world.others)]:
        w, d = draw.integers(1, longest + 1, 2)
        x, y = (int(draw.integers(0, most - size + 1)) for most, size in zip(depth.shape, (w, d), strict=True))
        if not labels[x : x + w, y : y + d].any():
            depth[x : x + w, y : y + d], labels[x : x + w, y : y + d] = draw.integers(1, 4), label
    rim = cell.tote_size[2]
    heights = np.minimum(np.round(tote_heights(world, cell, side, 1) / (side * cell.height_unit)), rim).astype(int)
    bearing = draw.integers(0, 2, heights.shape) if cell.support.marks_bearing and draw.random() < 0.5 else None
    seen = {"bin_depth": depth, "tote_depth": rim - heights, "tote_bearing": bearing}
    return seen | ({"bin_labels": labels} if world.others else {})


def as_images(draw: np.random.Generator, world: scenes.World, cell, side: float) -> dict:
    """Return what cameras see: in each image the highest box along a vertical line, with noise."""
    shown = {}
    for name, room in (("bin", world.bin), ("tote", world.tote)):
        focal = 0.8 * IMAGE[0] * 1.2 / (max(room[:2]) + 0.1)
        eye = Camera.looking_down((room[0] / 2, room[1] / 2), 1.2, focal, IMAGE)
        row, column = np.indices(IMAGE)
        points = np.stack(
            [room[0] / 2 + (column - eye.cx) * 1.2 / focal, room[1] / 2 - (row - eye.cy) * 1.2 / focal], -1
        )
        heights = np.zeros(IMAGE)
        boxes = [((x1 - x0, y1 - y0, h), ((x0 + x1) / 2, (y0 + y1) / 2), 0.0) for x0, y0, x1, y1, h in world.boxes]
        for (w, d, h), centre, yaw in world.in_bin() if name == "bin" else boxes:
            away = (points * (1.2 - h) / 1.2 + np.array(room[:2]) / 2 * h / 1.2) - centre
            turn = math.radians(yaw)
            over = np.abs(away @ (math.cos(turn), math.sin(turn))) < w / 2
            over &= np.abs(away @ (-math.sin(turn), math.cos(turn))) < d / 2
            heights = np.where(over, np.maximum(heights, h), heights)
        beside = (points < 0).any(-1) | (points > room[:2]).any(-1)
        heights[beside & (heights == 0)] = np.nan  # nothing is known of the walls
        shown[name] = eye, 1.2 - heights + draw.normal(0, 0.001, IMAGE)
    (eye, image), (other, tote_image) = shown["bin"], shown["tote"]
    tote_height = float(world.tote[2])
    return {
        "items": eye.items(image, cell, side, accuracy=ACCURACY),
        "tote": other.tote_map(tote_image, cell, side, tote_height),
    } | metres(draw, world, cell, side)


def tote_heights(world: scenes.World, cell, side: float, along: int) -> np.ndarray:
    """Return the greatest height in each square of the tote, with ``along`` squares along a cell."""
    return world.tote[2] - world.tote_map(along / side, 0.0)


def metres(draw: np.random.Generator, world: scenes.World, cell, side: float) -> dict:
    """Return the settings of a scene in metres."""
    shape = cell.tote_size[:2]
    bearing = draw.integers(0, 4, shape) > 0 if cell.support.marks_bearing and draw.random() < 0.5 else None
    return {
        "cell_size": side, "tote_height": float(world.tote[2]), "accuracy": ACCURACY,
        "clearance": float(draw.choice((0.0, 0.003, 0.005))), "tote_bearing": None if bearing is None else bearing * 1,
    }  # fmt: skip


VIEWS = [as_boxes, as_boxes, as_maps, as_cells, as_images]


def plans(scenes: int):
    """Yield one dict for each scene: a plan with every field, or the key that an error names."""
    for at, (name, options, sizes, side) in enumerate(CELLS):
        planner = make_planner(name, options, sizes)
        for number in range(scenes):
            draw, view = np.random.default_rng((at, number)), VIEWS[number % len(VIEWS)]
            world = random_world(draw, planner.cell, side)
            start = {"planner": name, "cell": at, "number": number, "view": view.__name__}
            try:
                found = plan(planner, int(draw.integers(0, 4)), **view(draw, world, planner.cell, side))
            except Exception as error:  # a fault must not hide what comes after it
                key = str(error).partition(":")[0].partition("=")[0] if isinstance(error, ValueError) else repr(error)
                yield {**start, "error": key}
            else:
                yield {**start, **found.as_dict()}


if __name__ == "__main__":
    with Path(sys.argv[2]).open("w") as file:
        for line in plans(int(sys.argv[1])):
            file.write(json.dumps(line) + "\n")
            file.flush()
