"""Count scenes that the planner refuses although a brute-force search finds a motion with half a cell to spare.

python tests/long/refusals.py [scenes of each cell, 1000] [seed, 0]

The search knows no grid of the planner and none of its rules. It tries poses of gripper and item a quarter of a cell
apart, in plane geometry, with the gripper's true shape: a motion keeps the clearance and half a cell from everything,
at the pick and at the place. Heights keep four times their error. A line for each cell: plans by status; how many of
the refused scenes have such a motion; mean time of a plan, without the reasons for a refusal.
"""

import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS / "robot")]

from scenes import World, random_scene, rectangle  # noqa: E402

from pickplace import Box, CellSpec, Planner, Scene  # noqa: E402
from pickplace.robot import planner as robot_planner  # noqa: E402

ACCURACY, CLEARANCE = 0.002, 0.005  # m


@dataclass
class Case:
    """A cell, and its gripper in metres."""

    cell: CellSpec
    side: float  # of a cell, m
    least: tuple[float, float, float]  # least sides and height of an item, m
    most: tuple[float, float, float]
    body: float  # diameter or side
    cup: float  # diameter or side
    is_round: bool  # body and cup; a round cup seals, a square one covers the item
    others: int = 0  # most boxes beside the item


SEAL = {"effector_size": (7, 7), "body": "disc", "cup": "disc", "cup_size": (3, 3), "pick_rule": "seal"}
WAREHOUSE = CellSpec(bin_size=(20, 20, 8), tote_size=(20, 15, 44), height_unit=0.25, **SEAL)
PLATE = CellSpec(bin_size=(6, 6, 1), tote_size=(6, 6, 5))
CASES = {
    "round cup": Case(WAREHOUSE, 0.02, (0.07, 0.07, 0.03), (0.2, 0.2, 0.12), 0.12, 0.06, True),
    "round cup, several items": Case(WAREHOUSE, 0.02, (0.07, 0.07, 0.03), (0.18, 0.18, 0.12), 0.12, 0.06, True, 3),
    "plate": Case(PLATE, 0.05, (0.02, 0.02, 0.02), (0.14, 0.14, 0.1), 0.14, 0.14, False),
}  # fmt: skip


def away_from(points: np.ndarray, centre, sides, yaw: float) -> np.ndarray:
    """Return the distance of points ``[..., 2]`` from a rectangle; 0 inside of it."""
    turn = np.radians(yaw)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    beyond = np.abs((points - centre) @ axes.T) - np.array(sides) / 2
    return np.hypot(*np.moveaxis(beyond.clip(0), -1, 0))


def touches(case: Case, points: np.ndarray, yaw: float, centre, sides, box_yaw: float, spare: float) -> np.ndarray:
    """Return at which points the gripper's body is nearer to a rectangle than ``spare``, bool ``[...]``."""
    if case.is_round:
        return away_from(points, centre, sides, box_yaw) < case.body / 2 + spare
    # Two rectangles, the body's larger: apart if they are along one of their four axes.
    corners = rectangle((0, 0), sides, box_yaw)
    body = rectangle((0, 0), (case.body + 2 * spare,) * 2, yaw)
    apart = np.zeros(points.shape[:-1], dtype=bool)
    for turn in (yaw, yaw + 90, box_yaw, box_yaw + 90):
        axis = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
        apart |= np.abs((points - centre) @ axis) >= np.abs(corners @ axis).max() + np.abs(body @ axis).max()
    return ~apart


def grips(case: Case, scene: World, spare: float) -> np.ndarray:
    """Return the places of the gripper on the item, from its centre and along its sides, ``[n, 2]``; m."""
    (w, d, h), step = scene.item, case.side / 4
    if case.is_round:
        reach = [side / 2 - case.cup / 2 - spare for side in (w, d)]
    else:
        reach = [case.cup / 2 - side / 2 - spare for side in (w, d)]
    if min(reach) < 0:
        return np.zeros((0, 2))
    x, y = (np.arange(-int(most / step), int(most / step) + 1) * step for most in reach)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    turn = np.radians(scene.yaw)
    points = np.array(scene.centre) + places @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    body = (case.body,) * 2
    reached = np.divide(body, 2) if case.is_round else rectangle((0, 0), body, scene.yaw).max(0)
    inside = ((points >= reached + spare) & (points <= np.array(scene.bin[:2]) - reached - spare)).all(1)
    good = inside if h - ACCURACY < scene.bin[2] else np.ones(len(points), dtype=bool)
    for (*sides, top), centre, yaw in scene.others:
        if top > h - 4 * ACCURACY:
            good &= ~touches(case, points, scene.yaw, centre, sides, yaw, spare)
    return places[good]


def is_in_hull(points: np.ndarray, margin: float) -> bool:
    """Return whether the hull of points ``[n, 2]`` reaches beyond the origin by a margin in every direction."""
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    return len(points) > 0 and bool(((points @ np.stack([np.cos(angle), np.sin(angle)])).max(0) > margin).all())


def resting(scene: World, sides: np.ndarray, places: np.ndarray, spare: float, margin: float) -> np.ndarray:
    """Return the height on which an item comes to rest at each place ``[n, 2]``; infinite where it is not stable.

    Nothing is higher within ``spare`` of it. What carries it counts if it is under it by the clearance, too, and its
    centre keeps ``spare`` and ``margin`` from the edge of that.
    """
    boxes = np.array(scene.boxes).reshape(-1, 5)
    low, high = places - sides / 2, places + sides / 2
    share = np.minimum(boxes[:, 2:4], high[:, None]) - np.maximum(boxes[:, :2], low[:, None])  # [n, boxes, 2]
    rest = np.where((share > -spare).all(2), boxes[:, 4], 0).max(1, initial=0)
    carries = (share > CLEARANCE).all(2) & (boxes[:, 4] >= rest[:, None] - 1e-6)
    inside = ((low >= spare) & (high <= np.array(scene.tote[:2]) - spare)).all(1)
    rest[~inside | (rest + scene.item[2] + 4 * ACCURACY + 0.003 > scene.tote[2])] = np.inf
    for number in np.flatnonzero(np.isfinite(rest) & (rest > 0)):
        part = boxes[carries[number]]
        near = np.maximum(part[:, :2], low[number] + CLEARANCE) - places[number]
        far = np.minimum(part[:, 2:4], high[number] - CLEARANCE) - places[number]
        corners = np.concatenate(
            [near, far, np.stack([near[:, 0], far[:, 1]], 1), np.stack([far[:, 0], near[:, 1]], 1)]
        )
        if not is_in_hull(corners, spare + margin):
            rest[number] = np.inf
    return rest


def is_feasible(case: Case, scene: World, spare: float) -> bool:
    """Return whether some motion keeps the clearance and ``spare`` from everything."""
    spare, step = spare + CLEARANCE, case.side / 4
    held = grips(case, scene, spare)
    if not len(held):
        return False
    count = [round(side / step) for side in scene.tote[:2]]
    places = np.stack(np.meshgrid(*(np.arange(n + 1) * step for n in count), indexing="ij"), -1)  # [X, Y, 2]
    # The least height of the suction face over each place.
    walled = ((places < case.body / 2 + spare) | (places > np.array(scene.tote[:2]) - case.body / 2 - spare)).any(2)
    least = np.where(walled, scene.tote[2], 0.0)
    for x0, y0, x1, y1, top in scene.boxes:
        near = touches(case, places, 0, ((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0, y1 - y0), 0, spare)
        least = np.where(near, np.maximum(least, top), least)
    shape = np.array(least.shape)
    for rotation in range(case.cell.rotations):
        sides = np.array(scene.item[:2])[:: -1 if rotation % 2 else 1]
        margin = case.cell.support.margin * case.side
        face = resting(scene, sides, places.reshape(-1, 2), spare, margin).reshape(least.shape) + scene.item[2]
        at = np.argwhere(np.isfinite(face))
        turn = rotation * np.pi / 2
        moved = np.rint(held @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) / step).astype(
            int
        )
        for offset in moved:
            over = at + offset
            inside = ((over >= 0) & (over < shape)).all(1)
            if (least[tuple(over[inside].T)] <= face[tuple(at[inside].T)]).any():
                return True
    return False


def random_world(case: Case, draw: np.random.Generator) -> World:
    """Return a random scene for a cell: one item or several in the bin, and up to a dozen boxes in the tote."""
    rooms = {
        name: np.multiply(size, case.side) * (1, 1, case.cell.height_unit)
        for name, size in (("bin", case.cell.bin_size), ("tote", case.cell.tote_size))
    }
    scene = random_scene(draw, tuple(rooms["tote"]), case.most, bin=tuple(rooms["bin"]))
    scene.item = tuple(draw.uniform(case.least, case.most))
    corners = rectangle((0, 0), scene.item[:2], scene.yaw).max(0)
    scene.centre = tuple(draw.uniform(corners, rooms["bin"][:2] - corners))
    scene.add_others(draw, int(draw.integers(0, case.others + 1)), case.most)
    return scene


def measured(case: Case, scene: World, draw: np.random.Generator) -> Scene:
    """Return the scene as boxes and a map with 2.5 mm a value, both with errors of height."""
    boxes = [
        Box(*centre, w, d, h + draw.uniform(-ACCURACY, ACCURACY), yaw) for (w, d, h), centre, yaw in scene.in_bin()
    ]
    shape = np.rint(np.array(scene.tote[:2]) * 400).astype(int)
    tote = scene.tote_map(400, draw.uniform(-ACCURACY, ACCURACY, shape))
    return Scene(boxes, tote, case.side, ACCURACY, CLEARANCE, tote_height=float(scene.tote[2]))


def count(case: Case, scenes: int, seed: int, spare: float = 0.5) -> tuple[Counter, Counter, float]:
    """Return plans by status, the feasible ones of the refused scenes by status, and the mean seconds of a plan.

    Args:
        spare: to everything beside the clearance, in cells.
    """
    draw, planner = np.random.default_rng(seed), Planner(case.cell, planner="joint_dbl")
    found, missed, seconds = Counter(), Counter(), 0.0
    for _ in range(scenes):
        world = random_world(case, draw)
        scene = measured(case, world, draw)
        start = time.perf_counter()
        plan = planner.plan(scene, alternatives=0)
        seconds += time.perf_counter() - start
        found[plan.status] += 1
        if plan.status != "ok":
            each = range(len(scene.items))
            missed[plan.status] += any(is_feasible(case, world.taking(number), spare * case.side) for number in each)
    return found, missed, seconds / scenes


if __name__ == "__main__":
    robot_planner._reasons = lambda *_: {}  # most of the time of a refusal
    wanted, first = map(int, (sys.argv[1:] + ["1000", "0"][len(sys.argv) - 1 :])[:2])
    for name, case in CASES.items():
        found, missed, seconds = count(case, wanted, first)
        share = sum(missed.values()) / max(1, wanted - found["ok"])
        sys.stdout.write(
            f"{name}: {dict(found)}; feasible: {dict(missed)}, {share:.1%}; {1000 * seconds:.0f} ms a plan\n"
        )
