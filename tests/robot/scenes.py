"""Random scenes of boxes, and a check of a plan in plane geometry with floats, which knows no grid and no rules."""

from dataclasses import dataclass, field, replace
from math import cos, radians, sin

import numpy as np
from plane import contains, overlap

from pickplace import Scene

EPSILON = 1e-6  # m


def plan_for(
    planner, bin_depth=None, tote_depth=None, tote_height=None, cell_size=None, *, items=None,
    bin_labels=None, alternatives: int = 10, **settings,
):  # fmt: skip
    """The plan for boxes, or for maps."""
    settings |= {"tote_height": tote_height, "cell_size": cell_size}
    if items is not None:
        return planner.plan(Scene(items, tote_depth, **settings), alternatives=alternatives)
    return planner.plan(Scene.from_maps(bin_depth, tote_depth, bin_labels, **settings), alternatives=alternatives)


@dataclass
class World:
    """A bin with one box, or with several of which a plan takes one, and a tote with boxes, in metres."""

    bin: tuple[float, float, float]
    tote: tuple[float, float, float]
    effector: tuple[float, float]
    item: tuple[float, float, float]  # w, d, h
    centre: tuple[float, float]
    yaw: float  # degrees
    boxes: list[tuple[float, ...]] = field(default_factory=list)  # x0, y0, x1, y1, top of what is in the tote
    gripper: "Gripper | None" = None  # None: the effector's rectangle, which covers the item
    others: list[tuple] = field(default_factory=list)  # size, centre and yaw of what else is in the bin

    def in_bin(self) -> list[tuple]:
        """Size, centre and yaw of everything in the bin."""
        return [(self.item, self.centre, self.yaw), *self.others]

    def taking(self, number: int) -> "World":
        """Return the scene with another box as the item."""
        (item, centre, yaw), *others = (self.in_bin()[at] for at in (number, *range(number), *range(number + 1, 9))
                                        if at <= len(self.others))  # fmt: skip
        return replace(self, item=item, centre=centre, yaw=yaw, others=others)

    def add_others(self, draw: np.random.Generator, count: int, most: tuple) -> None:
        """Put more boxes into the bin, where they overlap none; many are as high as another, or nearly."""
        for _ in range(100 * count):
            if len(self.others) == count:
                return
            size = draw.uniform((0.02, 0.02, 0.02), most)
            known = self.in_bin()[draw.integers(0, 1 + len(self.others))][0][2]
            size[2] = draw.choice((size[2], known, max(0.012, known + draw.uniform(-0.01, 0.01))))
            yaw = float(draw.choice((0, draw.uniform(-180, 180))))
            corners = rectangle((0, 0), size[:2], yaw)
            centre = draw.uniform(corners.max(0), np.array(self.bin[:2]) - corners.max(0))
            shapes = [rectangle(at, sides[:2], turn) for sides, at, turn in self.in_bin()]
            if not any(meet(corners + centre, shape) for shape in shapes):
                self.others.append((tuple(size), tuple(centre), yaw))

    def drop(self, low, high, height: float) -> bool:
        """Let a box fall into the tote; one that would pass the rim stays out."""
        rest = max((box[4] for box in self.boxes if overlaps(box, low, high)), default=0.0)
        if rest + height > self.tote[2]:
            return False
        self.boxes.append((*low, *high, rest + height))
        return True

    def carry_out(self, plan) -> None:
        """Put the item into the tote as a plan that has no fault says."""
        item, _ = over_the_tote(self, plan)
        assert self.drop(item.min(0), item.max(0), self.item[2])

    def tote_map(self, pixels: int, noise: np.ndarray) -> np.ndarray:
        """Remaining height in each of ``pixels`` squares along a metre, the least in each, and noise."""
        shape = [round(side * pixels) for side in self.tote[:2]]
        heights = np.zeros(shape)
        for x0, y0, x1, y1, top in self.boxes:
            i0, j0 = (int(np.floor(at * pixels + 1e-9)) for at in (x0, y0))
            i1, j1 = (int(np.ceil(at * pixels - 1e-9)) for at in (x1, y1))
            part = heights[i0:i1, j0:j1]
            np.maximum(part, top, out=part)
        return self.tote[2] - (heights + noise)


@dataclass
class Gripper:
    """Convex parts of an end effector, ``[n, 2]`` each, from its centre, in metres: what may hit, and what seals."""

    body: list[np.ndarray]
    cups: list[np.ndarray]
    least: float | None  # share of the cups that must lie on the item; None: the one cup covers the item

    def grips(self, item: np.ndarray, pick: np.ndarray, yaw: float) -> bool:
        """Whether it lifts an item with these corners."""
        cups = [moved(cup, pick, yaw) for cup in self.cups]
        if self.least is None:
            return inside(item, cups[0])
        return sum(inside(cup, item) for cup in cups) / len(cups) >= self.least - 1e-9


def moved(corners: np.ndarray, centre, yaw: float) -> np.ndarray:
    """Corners from a centre, turned about it."""
    turn = radians(yaw)
    return np.array(centre) + corners @ np.array([[cos(turn), sin(turn)], [-sin(turn), cos(turn)]])


def squares(cells, size, side: float) -> list[np.ndarray]:
    """The cells ``(x, y)`` of a rectangle of ``size`` cells, from its centre."""
    return [rectangle((np.array(cell) + 0.5 - np.array(size) / 2) * side, (side, side), 0) for cell in cells]


def meet(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two convex polygons, counter-clockwise, share more than an edge."""
    return overlap(a, b) > EPSILON


def random_scene(
    draw: np.random.Generator, tote: tuple[float, float, float], most: tuple = (0.14, 0.14, 0.1), **fields
) -> World:
    """A bin with one box, turned at random or not, and up to a dozen boxes dropped into the tote at random.

    Some totes are hardly higher than the item, or too low for it.
    """
    item = tuple(draw.uniform((0.02, 0.02, 0.02), most).round(draw.choice((2, 6))))
    yaw = float(draw.choice((0, draw.uniform(-180, 180))))
    tote = (*tote[:2], float(draw.choice((tote[2], tote[2], item[2] + draw.uniform(-0.005, 0.01)))))
    sizes = {"bin": (0.25, 0.25, 0.05), "effector": (0.15, 0.15)} | fields
    scene = World(tote=tote, item=item, centre=tuple(draw.uniform(0.07, 0.18, 2)), yaw=yaw, **sizes)
    for _ in range(draw.integers(0, 12)):
        size = draw.uniform((0.02, 0.02, 0.004), (0.15, 0.15, 0.08))
        corner = draw.uniform((0, 0), np.array(tote[:2]) - size[:2])
        if draw.random() < 0.3:  # hardly more than whole centimetres
            size[:2], corner = size[:2].round(2) + 0.001, corner.round(2).clip(0, np.array(tote[:2]) - size[:2] - 0.01)
        scene.drop(corner, corner + size[:2], size[2])
    return scene


def rectangle(centre, sides, yaw) -> np.ndarray:
    """The corners of a rectangle, counter-clockwise, ``[4, 2]``."""
    turn = radians(yaw)
    axes = np.array([[cos(turn), sin(turn)], [-sin(turn), cos(turn)]])
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(sides) / 2
    return np.array(centre) + half @ axes


def fault(scene: World, plan, accuracy: float = 0.002, error: float = 0.005) -> str | None:
    """The first thing that goes wrong when a robot does as the plan says; None if nothing does.

    It may set the item down by ``error`` off its place.

    What lies further below the highest thing under an item than heights may be wrong does not carry it.
    """
    w, d, h = scene.item
    pick, place = np.array(plan.pick.center), np.array(plan.place.center)
    # Over the bin.
    item = rectangle(scene.centre, (w, d), scene.yaw)
    gripper = scene.gripper or Gripper(
        [rectangle((0, 0), scene.effector, 0)], [rectangle((0, 0), scene.effector, 0)], None
    )
    if not gripper.grips(item, pick[:2], plan.pick.yaw):
        return "the effector does not grip the item"
    if pick[2] < h - EPSILON:
        return "the effector ends inside the item"
    body = np.concatenate([moved(part, pick[:2], plan.pick.yaw) for part in gripper.body])
    if scene.bin[2] > h + EPSILON and not within(body, scene.bin):
        return "the effector hits the bin's wall"
    for (*sides, top), centre, yaw in scene.others:
        box = rectangle(centre, sides, yaw)
        if top < h:  # in nobody's way
            continue
        if gripper.grips(box, pick[:2], plan.pick.yaw):
            return "the effector lifts two items"
        if any(meet(moved(part, pick[:2], plan.pick.yaw), box) for part in gripper.body):
            return "the effector hits another item in the bin"
    # Over the tote.
    item, effector = over_the_tote(scene, plan)
    if abs(np.ptp(item, 0).prod() - w * d) > 1e-6:
        return "the item is not parallel to the walls"
    low, high = item.min(0), item.max(0)
    if not within(item, scene.tote):
        return "the item hits the tote's wall"
    below = [box for box in scene.boxes if overlaps(box, low, high)]
    rest = max([top for *_, top in below], default=0.0)
    if place[2] - h < rest - EPSILON:
        return "the item is pressed into what is below it"
    if rest + h > scene.tote[2] + EPSILON:
        return "the item passes the rim"
    if place[2] - h > rest + 6 * accuracy + 0.003:
        return "the item falls"
    parts = [moved(part, place[:2], plan.pick.yaw + plan.rotation_degrees) for part in gripper.body]
    walls = [rectangle(((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0, y1 - y0), 0) for x0, y0, x1, y1, top in scene.boxes
            if top > place[2] + EPSILON]  # fmt: skip
    if any(meet(part, box) for part in parts for box in walls):
        return "the effector hits an item"
    if place[2] < scene.tote[2] - EPSILON and not within(effector, scene.tote):
        return "the effector hits the tote's wall"
    # Support, of the item in its place and off it in any direction.
    angles = np.arange(8) * np.pi / 4
    for shift in ((0, 0), *(error * np.stack([np.cos(angles), np.sin(angles)], -1))):
        if overhangs(scene.boxes, low + shift, high + shift, 4 * accuracy + 0.002):
            return "the item's centre overhangs"
    return None


def overhangs(boxes, low, high, step: float) -> bool:
    """Whether the centre of an item is beside the hull of what carries it: all up to a step below the highest."""
    below = [box for box in boxes if overlaps(box, low, high)]
    level = max([top for *_, top in below], default=0.0) - step
    if level <= 0:  # the floor does, too
        return False
    points = np.concatenate([
        [(max(x0, low[0]), max(y0, low[1])), (max(x0, low[0]), min(y1, high[1])),
         (min(x1, high[0]), max(y0, low[1])), (min(x1, high[0]), min(y1, high[1]))]
        for x0, y0, x1, y1, top in below if top >= level
    ])  # fmt: skip
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    reach = (points - (low + high) / 2) @ np.stack([np.cos(angles), np.sin(angles)])
    return bool((reach.max(0) < -1e-4).any())


def over_the_tote(scene: World, plan) -> list[np.ndarray]:
    """The corners of item and effector over the tote: they turned together about the effector's centre."""
    pick, place = np.array(plan.pick.center[:2]), np.array(plan.place.center[:2])
    turn = radians(plan.rotation_degrees)
    matrix = np.array([[cos(turn), sin(turn)], [-sin(turn), cos(turn)]])
    shapes = rectangle(scene.centre, scene.item[:2], scene.yaw), rectangle(pick, scene.effector, plan.pick.yaw)
    return [(corners - pick) @ matrix + place for corners in shapes]


def overlaps(box, low, high) -> bool:
    x0, y0, x1, y1, _ = box
    return min(x1, high[0]) - max(x0, low[0]) > EPSILON and min(y1, high[1]) - max(y0, low[1]) > EPSILON


def within(corners: np.ndarray, room) -> bool:
    return bool((corners >= -EPSILON).all() and (corners <= np.array(room[:2]) + EPSILON).all())


def inside(corners: np.ndarray, polygon: np.ndarray) -> bool:
    """Whether points lie in a convex polygon, counter-clockwise."""
    return contains(polygon, corners, EPSILON)
