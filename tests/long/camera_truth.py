"""Judge plans from depth images against the true scene: random boxes, a ray caster, and faults of the images.

python tests/long/camera_truth.py <scenes> [<first seed> [<kind of scene> ...]]

Things are convex: half-spaces for the rays, polygons with a top for the check of a plan. Nothing here uses the camera's
code or the rules. It prints how many plans of each kind of scene are ``ok``, refused, or false, with the reason of each
false one, and the share of good scenes that are refused although their clean images have a plan.
"""

import sys
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from plane import common, contains, disc, overlap  # noqa: E402

from pickplace import Box, Camera, CellSpec, DepthMapError, Planner, Scene  # noqa: E402

SHAPE, FOCAL, HEIGHT, NOISE, ACCURACY = (240, 320), 620.0, 1.2, 0.0015, 0.003
TOUCH = 0.0005  # depth of an overlap that is a collision, m

#: Cell, side of a cell, height of the tote's rim, diameter of the round cup or None.
CELLS = {
    "plate": (CellSpec(bin_size=(6, 6, 1), tote_size=(6, 6, 5)), 0.05, 0.25, None),
    "cup": (
        CellSpec(
            bin_size=(15, 15, 4), tote_size=(15, 12, 44), height_unit=0.25, effector_size=(7, 7), body="disc",
            cup="disc", cup_size=(3, 3), pick_rule="seal",
        ), 0.02, 0.22, 0.06,
    ),
}  # fmt: skip

STUCK = "stuck for a bad image"
KINDS = ("good", "missing", "strip", "shadow", "dark_bin", "dark_tote", "hand", "slope", "pose", "mixed")


@dataclass
class Thing:
    """A box that is turned about the vertical, with a top that may slope."""

    centre: tuple
    sides: tuple
    bottom: float
    top: float  # in the middle
    yaw: float = 0.0  # radians
    slope: tuple = (0.0, 0.0)  # of the top along its sides
    dark: bool = False  # returns no depth
    kind: str = "item"

    @property
    def corners(self) -> np.ndarray:
        return self.polygon(self.sides)

    def polygon(self, sides) -> np.ndarray:
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(sides) / 2
        return half @ turned(self.yaw).T + self.centre

    @property
    def highest(self) -> float:
        return self.top + abs(self.slope[0]) * self.sides[0] / 2 + abs(self.slope[1]) * self.sides[1] / 2

    def height_at(self, point) -> float:
        return self.top + float(np.dot((np.array(point) - self.centre) @ turned(self.yaw), self.slope))

    def planes(self):
        """Normals and distances of the half-spaces."""
        axes = turned(self.yaw).T
        for axis, side in zip(axes, self.sides, strict=True):
            for sign in (-1, 1):
                yield np.array([*(sign * axis), 0.0]), sign * axis @ self.centre + side / 2
        yield np.array([0.0, 0.0, -1.0]), -self.bottom
        tilt = -(np.array(self.slope) @ axes)
        yield np.array([*tilt, 1.0]), self.top + tilt @ self.centre


@dataclass
class Truth:
    """What really lies in the bin and the tote."""

    bin: tuple
    tote: tuple
    in_bin: list = field(default_factory=list)
    in_tote: list = field(default_factory=list)
    walls: float = 0.01  # their thickness
    table: float = -0.01  # its height beside bin and tote


def turned(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


# ---------------------------------------------------------------------------------------------------- images


def cast(rays, origin, truth: Truth, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Distance along the optical axis of each pixel, and whether a dark thing is there."""
    wide, deep, rim = getattr(truth, name)
    thick = truth.walls
    shell = [Thing((wide / 2, deep / 2), (wide + 2 * thick, deep + 2 * thick), truth.table, 0.0)]
    for x in (-thick / 2, wide + thick / 2):
        shell.append(Thing((x, deep / 2), (thick, deep + 2 * thick), truth.table, rim))
    for y in (-thick / 2, deep + thick / 2):
        shell.append(Thing((wide / 2, y), (wide, thick), truth.table, rim))
    depth = (truth.table - origin[2]) / rays[..., 2]
    dark = np.zeros(SHAPE, dtype=bool)
    for thing in [*shell, *getattr(truth, f"in_{name}")]:
        enter, leave = np.full(SHAPE, 0.0), np.full(SHAPE, np.inf)
        for normal, distance in thing.planes():
            speed, away = rays @ normal, distance - origin @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                at = away / speed
            enter = np.where(speed < 0, np.maximum(enter, at), enter)
            leave = np.where(speed > 0, np.minimum(leave, at), leave)
            leave = np.where((speed == 0) & (away < 0), -np.inf, leave)
        hit = (enter < leave) & (enter < depth)
        depth, dark = np.where(hit, enter, depth), np.where(hit, thing.dark, dark)
    return depth, dark


def shadows(depth: np.ndarray, pixels: int, one_sided: bool) -> np.ndarray:
    """Pixels within so many pixels of something nearer, as stereo cameras lose them."""
    lost = np.zeros(SHAPE, dtype=bool)
    for row in range(-pixels, pixels + 1) if not one_sided else (0,):
        for column in range(-pixels, pixels + 1) if not one_sided else range(pixels + 1):
            lost |= depth - np.roll(depth, (row, column), (0, 1)) > 0.01
    return lost


def strip(draw) -> np.ndarray:
    """A strip without depth, 1 to 20 pixels wide."""
    row, column = np.indices(SHAPE)
    angle, width = draw.choice((0.0, np.pi / 2, draw.uniform(0, np.pi))), draw.integers(1, 21)
    at = (column - SHAPE[1] / 2) * np.cos(angle) + (row - SHAPE[0] / 2) * np.sin(angle) - draw.uniform(-80, 80)
    return (at >= 0) & (at < width)


def pose_above(draw, room) -> np.ndarray:
    """A camera above a room that looks down, a little tilted."""
    pose = np.eye(4)
    pose[:3, :3] = np.diag((1.0, -1.0, -1.0)) @ about(draw.normal(size=3), draw.uniform(0, 0.02))
    pose[:3, 3] = np.array((room[0] / 2, room[1] / 2, HEIGHT)) + draw.uniform(-0.02, 0.02, 3)
    return pose


def about(axis, angle: float) -> np.ndarray:
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def wrong(draw, pose: np.ndarray, room) -> np.ndarray:
    """A pose that is wrong by 3 degrees, about the camera or the middle of the floor, or by 10 mm."""
    pose = pose.copy()
    if draw.random() < 0.5:
        axes = [*np.eye(3), draw.normal(size=3)]
        turn = about(axes[draw.integers(4)], np.radians(3) * draw.choice((-1, 1)))
        middle = pose[:3, 3] if draw.random() < 0.3 else np.array([room[0] / 2, room[1] / 2, 0.0])
        pose[:3, :3], pose[:3, 3] = turn @ pose[:3, :3], middle + turn @ (pose[:3, 3] - middle)
    else:
        axes = [*np.eye(3), draw.normal(size=3)]
        axis = axes[draw.integers(4)]
        pose[:3, 3] += 0.01 * draw.choice((-1, 1)) * axis / np.linalg.norm(axis)
    return pose


# ---------------------------------------------------------------------------------------------------- scenes


def drop(things: list, thing: Thing, rim: float) -> bool:
    """Put a thing on what is below it; one that would pass the rim stays out."""
    rest = max((each.highest for each in things if overlap(each.corners, thing.corners) > 0), default=0.0)
    if rest + thing.top - thing.bottom > rim:
        return False
    things.append(replace(thing, bottom=rest, top=rest + thing.top - thing.bottom))
    return True


def random_thing(draw, room, least, most, aligned: float, **fields) -> Thing:
    w, d, h = draw.uniform(least, most)
    yaw = 0.0 if draw.random() < aligned else draw.uniform(-np.pi, np.pi)
    half = Thing((0, 0), (w, d), 0, h, yaw).corners.max(0)
    centre = draw.uniform(half, np.maximum(half, np.array(room[:2]) - half))
    return Thing(tuple(centre), (w, d), 0.0, h, yaw, **fields)


def random_truth(draw, cell: str, kind: str) -> Truth:
    spec, side, rim, cup = CELLS[cell]
    rooms = [(*np.multiply(size[:2], side), height) for size, height in
             ((spec.bin_size, spec.bin_size[2] * spec.height_unit * side), (spec.tote_size, rim))]  # fmt: skip
    truth = Truth(*rooms, walls=draw.uniform(0.004, 0.015), table=-draw.choice((0.002, 0.01, 0.05)))
    least, most = (
        ((0.05, 0.05, 0.03), (0.138, 0.138, 0.1)) if cup is None else ((0.075, 0.075, 0.04), (0.2, 0.12, 0.12))
    )
    for number in range(20 * draw.integers(1, 4)):
        thing = random_thing(draw, truth.bin, least, most, 0.3)
        if len(truth.in_bin) > 2 or (number > 20 and truth.in_bin and draw.random() < 0.5):
            break
        grown = thing.polygon(np.add(thing.sides, draw.choice((0.006, 0.03))))
        if not any(overlap(grown, each.corners) > 0 for each in truth.in_bin):
            truth.in_bin.append(thing)
    for _ in range(draw.integers(0, 5)):
        drop(truth.in_tote, random_thing(draw, truth.tote, (0.03, 0.03, 0.02), (0.13, 0.12, 0.1), 0.8), rim)
    if kind in ("dark_bin", "mixed"):
        for _ in range(draw.integers(1, 4)):
            size = draw.uniform(0.01, 0.12, 2) if draw.random() < 0.6 else draw.uniform(0.01, 0.03, 2)
            dark = random_thing(draw, truth.bin, (*size, 0.02), (*size, 0.15), 0.3, dark=True)
            if not any(overlap(dark.corners, each.corners) > 0 for each in truth.in_bin):
                truth.in_bin.append(dark)
    if kind in ("dark_tote", "mixed"):
        for _ in range(draw.integers(1, 4)):
            size = draw.uniform(0.01, 0.12, 2) if draw.random() < 0.6 else draw.uniform(0.01, 0.03, 2)
            drop(truth.in_tote, random_thing(draw, truth.tote, (*size, 0.01), (*size, 0.12), 0.7, dark=True), rim)
        if draw.random() < 0.3:
            truth.in_tote = [replace(each, dark=draw.random() < 0.5) for each in truth.in_tote]
    if kind == "hand":
        name = str(draw.choice(("bin", "tote")))
        room, height = getattr(truth, name), draw.uniform(0.0, 0.1)
        height += getattr(truth, name)[2] + 0.045  # the arm passes over the wall
        at, angle = draw.uniform(0.1, 0.9, 2) * room[:2], draw.uniform(-np.pi, np.pi)
        palm = Thing(tuple(at), (0.1, 0.09), height - 0.03, height, angle, kind="hand", dark=draw.random() < 0.2)
        elbow = tuple(at + turned(angle) @ (0.3, 0))
        arm = replace(palm, centre=elbow, sides=(0.52, 0.07), bottom=height - 0.04, top=height + 0.02)
        getattr(truth, f"in_{name}").extend([palm, arm])
    if kind == "slope":
        for number, thing in enumerate(truth.in_bin):
            rise = draw.choice((0.0, 0.01, 0.02, 0.04))
            slope = rise / thing.sides[0] * draw.choice((-1, 1))
            truth.in_bin[number] = replace(thing, slope=(slope, 0.0), top=max(thing.top, 0.03 + rise / 2))
    return truth


def images(draw, truth: Truth, kind: str):
    """Camera and image of bin and tote, and the same without faults of the image."""
    views, clean = [], []
    spoilt = draw.choice(("bin", "tote", "both"))
    missing = {"missing": draw.uniform(0, 0.4), "good": draw.uniform(0, 0.05), "mixed": draw.uniform(0, 0.1)}.get(
        kind, 0
    )
    pixels = {"shadow": draw.integers(1, 12), "good": draw.integers(0, 3), "mixed": draw.integers(0, 6)}.get(kind, 0)
    for name in ("bin", "tote"):
        room = getattr(truth, name)
        pose = pose_above(draw, room)
        row, column = np.indices(SHAPE)
        rays = np.stack(
            [(column - (SHAPE[1] - 1) / 2) / FOCAL, (row - (SHAPE[0] - 1) / 2) / FOCAL, np.ones(SHAPE)], -1
        ) @ pose[:3, :3].T  # fmt: skip
        exact, dark = cast(rays, pose[:3, 3], truth, name)
        depth = np.where(dark, np.nan, exact + draw.normal(0, NOISE, SHAPE))
        used = wrong(draw, pose, room) if kind == "pose" and spoilt in (name, "both") else pose
        eye = [Camera(FOCAL, FOCAL, (SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2, each, SHAPE) for each in (used, pose)]
        clean.append((eye[1], depth.copy()))
        if spoilt in (name, "both") or kind == "good":
            depth[draw.random(SHAPE) < missing] = np.nan
            if pixels:
                depth[shadows(exact, int(pixels), draw.random() < 0.3)] = np.nan
            if kind in ("strip", "mixed"):
                depth[strip(draw)] = np.nan
        views.append((eye[0], depth))
    return views, clean


def record_of(draw, truth: Truth) -> list[Box]:
    """What a planner noted of the things in the tote, a little wrong."""
    return [
        Box(*(np.array(each.centre) + draw.uniform(-0.002, 0.002, 2)).tolist(), *each.sides,
            each.top + draw.uniform(-ACCURACY, ACCURACY), float(np.degrees(each.yaw)))
        for each in truth.in_tote if each.kind == "item"
    ]  # fmt: skip


# ---------------------------------------------------------------------------------------------------- the check


def fault(truth: Truth, plan, cell: str) -> str | None:
    """The first thing that goes wrong when a robot does exactly as the plan says; None if nothing does."""
    spec, side, rim, cup = CELLS[cell]
    pick, place = np.array(plan.pick.center), np.array(plan.place.center)
    wide = spec.gripper.size[0] * side
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * wide / 2
    body = square if cup is None else disc(wide - 2 * 0.005)
    at_pick = body @ turned(np.radians(plan.pick.yaw)).T + pick[:2]
    suck = at_pick if cup is None else disc(cup) + pick[:2]
    found = [
        each
        for each in truth.in_bin
        if contains(*((suck, each.corners) if cup is None else (each.corners, suck)), TOUCH)
    ]
    if not found:
        return "the cup fits on nothing"
    item = max(found, key=lambda each: each.top)
    if item.kind == "hand":
        return "a hand is gripped"
    heights = [item.height_at(point) for point in (item.corners if cup is None else suck)]
    if max(heights) > pick[2] + TOUCH or min(heights) < pick[2] - 2 * ACCURACY - 0.001:
        return "the cup does not seal at this height"
    for other in truth.in_bin:
        if other is item:
            continue
        if other.highest > pick[2] + TOUCH and overlap(at_pick, other.corners) > TOUCH:
            return f"the effector hits a {'dark ' * other.dark}{other.kind} in the bin"
        if other.highest > item.top - TOUCH and overlap(suck, other.corners) > TOUCH:
            return "two items are lifted"
    if truth.bin[2] > pick[2] + TOUCH and not inside_room(at_pick, truth.bin):
        return "the effector hits the bin's wall"
    turn = turned(np.radians(plan.rotation_degrees))
    moved, over = (each @ turn.T + place[:2] for each in (item.corners - pick[:2], at_pick - pick[:2]))
    bottom = place[2] - item.height_at(pick[:2])
    if not inside_room(moved, truth.tote):
        return "the item hits the tote's wall"
    below = [each for each in truth.in_tote if overlap(moved, each.corners) > TOUCH]
    rest = max((each.highest for each in below), default=0.0)
    hit = max(below, key=lambda each: each.highest, default=None)
    if bottom < rest - TOUCH:
        return f"the item is pressed into a {'dark ' * hit.dark}{hit.kind} in the tote" if hit else "into the floor"
    if bottom > rest + 6 * ACCURACY + 0.003:
        return "the item falls"
    if rest + item.highest > rim + TOUCH:
        return "the item passes the rim"
    for other in truth.in_tote:
        if other.highest > place[2] + TOUCH and overlap(over, other.corners) > TOUCH:
            return f"the effector hits a {'dark ' * other.dark}{other.kind} in the tote"
    if place[2] < rim - TOUCH and not inside_room(over, truth.tote):
        return "the effector hits the tote's wall"
    level = rest - 4 * ACCURACY - 0.002
    if level > 0:
        parts = [common(moved, each.corners) for each in below if each.highest >= level]
        points = np.concatenate(parts) - moved.mean(0)
        angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
        if ((points @ np.stack([np.cos(angle), np.sin(angle)])).max(0) < -1e-4).any():
            return "the item tips"
    return None


def inside_room(points: np.ndarray, room) -> bool:
    return bool((points > -TOUCH).all() and (points < np.array(room[:2]) + TOUCH).all())


# ---------------------------------------------------------------------------------------------------- the run


def outcome(planner: Planner, cell: str, views, **settings) -> tuple[str, object]:
    """``ok``, another status or ``refused``; with the plan or the error."""
    spec, side, rim, _ = CELLS[cell]
    try:
        plan = planner.plan(
            Scene.from_images(spec, *views, side, ACCURACY, tote_height=rim, **settings), alternatives=0
        )
    except DepthMapError as error:
        return "refused", error
    return plan.status, plan


def judge(planners: dict, seed: int, kinds=KINDS) -> tuple[str, str, str | None, object]:
    """Kind of a scene, the outcome, what is wrong, and for a good scene whether its clean images have a plan."""
    draw = np.random.default_rng(seed)
    cell, kind = str(draw.choice(list(CELLS))), str(draw.choice(kinds))
    truth = random_truth(draw, cell, kind)
    views, clean = images(draw, truth, kind)
    record = record_of(draw, truth) if draw.random() < 0.3 else []
    status, result = outcome(planners[cell], cell, views, placed=record)
    wrong_with = None
    if status == "ok":
        wrong_with = fault(truth, result, cell)
    elif status == "stuck" and kind != "good" and outcome(planners[cell], cell, clean, placed=record)[0] == "ok":
        wrong_with = STUCK
    is_feasible = kind == "good" and (status == "ok" or outcome(planners[cell], cell, clean, placed=record)[0] == "ok")
    return kind, status, wrong_with, (is_feasible, result)


def make_planners() -> dict:
    return {name: Planner(spec, planner="joint_dbl") for name, (spec, *_) in CELLS.items()}


def run(seeds, kinds=KINDS, report=lambda _: None) -> tuple[Counter, list[str], Counter]:
    """Counts of ``(kind, status)``, the false plans, and the counts of good scenes with a plan by their outcome."""
    planners, counts, false, good = make_planners(), Counter(), [], Counter()
    for seed in seeds:
        kind, status, wrong_with, (is_feasible, result) = judge(planners, seed, kinds)
        counts[kind, status] += 1
        if wrong_with:
            false.append(f"seed {seed}, {kind}: {wrong_with}")
            report(false[-1])
        if is_feasible:
            good[status] += 1
            if status != "ok":
                report(f"seed {seed}, good: {status}: {result if status == 'refused' else ''}")
    return counts, false, good


if __name__ == "__main__":
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    write = sys.stdout.write
    counts, false, good = run(
        range(first, first + int(sys.argv[1])), sys.argv[3:] or KINDS, lambda line: write(line + "\n")
    )
    for kind in KINDS:
        write(f"{kind} { {status: count for (each, status), count in sorted(counts.items()) if each == kind} }\n")
    stuck = sum(line.endswith(STUCK) for line in false)
    write(f"{len(false) - stuck} false of {sum(counts[kind, 'ok'] for kind in KINDS)} plans that are ok\n")
    write(f"{stuck} totes called stuck for a bad image\n")
    write(f"good scenes with a plan: {good.total()}, of which {good.total() - good['ok']} are refused\n")
