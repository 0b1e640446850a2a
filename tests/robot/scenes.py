"""Random scenes of boxes, and a check of a plan in plane geometry with floats, which knows no grid and no rules."""

from dataclasses import dataclass, field
from math import cos, radians, sin

import numpy as np

EPSILON = 1e-6  # m


@dataclass
class Scene:
    """A bin with one box and a tote with boxes, in metres."""

    bin: tuple[float, float, float]
    tote: tuple[float, float, float]
    effector: tuple[float, float]
    item: tuple[float, float, float]  # w, d, h
    centre: tuple[float, float]
    yaw: float  # degrees
    boxes: list[tuple[float, ...]] = field(default_factory=list)  # x0, y0, x1, y1, top of what is in the tote

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


def random_scene(draw: np.random.Generator, tote: tuple[float, float, float]) -> Scene:
    """A bin with one box, turned at random or not, and up to a dozen boxes dropped into the tote at random.

    Some totes are hardly higher than the item, or too low for it.
    """
    item = tuple(draw.uniform((0.02, 0.02, 0.02), (0.14, 0.14, 0.1)).round(draw.choice((2, 6))))
    yaw = float(draw.choice((0, draw.uniform(-180, 180))))
    tote = (*tote[:2], float(draw.choice((tote[2], tote[2], item[2] + draw.uniform(-0.005, 0.01)))))
    scene = Scene((0.25, 0.25, 0.05), tote, (0.15, 0.15), item, tuple(draw.uniform(0.07, 0.18, 2)), yaw)
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


def fault(scene: Scene, plan, accuracy: float = 0.002) -> str | None:
    """The first thing that goes wrong when a robot does exactly as the plan says; None if nothing does.

    What lies further below the highest thing under an item than heights may be wrong does not carry it.
    """
    w, d, h = scene.item
    pick, place = np.array(plan.pick.center), np.array(plan.place.center)
    # Over the bin.
    effector = rectangle(pick[:2], scene.effector, plan.pick.yaw)
    item = rectangle(scene.centre, (w, d), scene.yaw)
    if not inside(item, effector):
        return "the effector does not cover the item"
    if pick[2] < h - EPSILON:
        return "the effector ends inside the item"
    if scene.bin[2] > h + EPSILON and not within(effector, scene.bin):
        return "the effector hits the bin's wall"
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
    if any(overlaps(box, effector.min(0), effector.max(0)) and box[4] > place[2] + EPSILON for box in scene.boxes):
        return "the effector hits an item"
    if place[2] < scene.tote[2] - EPSILON and not within(effector, scene.tote):
        return "the effector hits the tote's wall"
    # Support.
    level = rest - 4 * accuracy - 0.002
    if level > 0:  # else the floor does, too
        touching = [box for box in below if box[4] >= level]
        points = np.concatenate([
            [(max(x0, low[0]), max(y0, low[1])), (max(x0, low[0]), min(y1, high[1])),
             (min(x1, high[0]), max(y0, low[1])), (min(x1, high[0]), min(y1, high[1]))]
            for x0, y0, x1, y1, _ in touching
        ])  # fmt: skip
        angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
        reach = (points - (low + high) / 2) @ np.stack([np.cos(angles), np.sin(angles)])
        if (reach.max(0) < -1e-4).any():
            return "the item's centre overhangs"
    return None


def over_the_tote(scene: Scene, plan) -> list[np.ndarray]:
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
    edges = np.roll(polygon, -1, 0) - polygon
    away = corners[:, None] - polygon
    return bool((edges[:, 0] * away[..., 1] - edges[:, 1] * away[..., 0] >= -EPSILON).all())
