"""Plane geometry of convex polygons, whose corners ``[K, 2]`` go round counter-clockwise; for checks of plans."""

import numpy as np


def normals_of(polygon: np.ndarray) -> np.ndarray:
    """The outer unit normals of a polygon's edges, ``[K, 2]``."""
    edges = np.roll(polygon, -1, 0) - polygon
    return np.stack([edges[:, 1], -edges[:, 0]], -1) / np.linalg.norm(edges, axis=1, keepdims=True)


def distances(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """How far points ``[P, 2]`` are outside each edge of a polygon, ``[P, K]``; below 0: inside."""
    normals = normals_of(polygon)
    return points @ normals.T - (polygon * normals).sum(1)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """How deep two polygons overlap; below 0 if they are apart."""
    return -max(float(distances(other, one).min(0).max()) for one, other in ((a, b), (b, a)))


def contains(polygon: np.ndarray, points: np.ndarray, tolerance: float) -> bool:
    """Whether points are at most so far outside a polygon."""
    return bool((distances(points, polygon) <= tolerance).all())


def common(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The part of a polygon that lies in another."""
    for start, end in zip(b, np.roll(b, -1, 0), strict=True):
        edge, kept = end - start, []
        side = edge[0] * (a[:, 1] - start[1]) - edge[1] * (a[:, 0] - start[0])
        for number in range(len(a)):
            here, there = side[number], side[(number + 1) % len(a)]
            if here >= 0:
                kept.append(a[number])
            if (here >= 0) != (there >= 0):
                kept.append(a[number] + (a[(number + 1) % len(a)] - a[number]) * here / (here - there))
        a = np.array(kept)
        if len(a) < 3:
            return np.zeros((0, 2))
    return a


def disc(diameter: float) -> np.ndarray:
    """A circle around the origin, as a polygon."""
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], -1) * diameter / 2
