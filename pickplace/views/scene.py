"""Drawing of a packed tote: boxes in isometric projection, and the height map from above."""

import numpy as np

from pickplace.rules.cell import CellSpec
from pickplace.views.figures import COLOURS, INK, WALL, figure_of
from pickplace.views.recording import Box, Recording

#: Size of an item ``(w, d, h)`` with ``w <= d``, so that it does not depend on how the item is turned.
Kind = tuple[int, int, int]


def draw_scene(recording: Recording, cell: CellSpec, colours: dict[Kind, str], moves: int | None = None):
    """Return a matplotlib figure of the tote of a recorded episode, beside its height map.

    Args:
        recording: the episode.
        cell: the sizes.
        colours: of the kinds of items, see :func:`item_colours`.
        moves: how many moves have been made; None: all, and the caption says how the episode ended.
    """
    done = recording.moves if moves is None else recording.moves[:moves]
    boxes = recording.boxes[: sum(not move.failure for move in done)]
    heights = np.zeros(cell.tote_size[:2], dtype=int)
    for x, y, z, w, d, h in boxes:
        heights[x : x + w, y : y + d] = z + h
    size = (*cell.tote_size[:2], recording.tote_height)
    figure = figure_of(12, 6)
    solid, plan = figure.subplots(1, 2, width_ratios=[1.2, 1])
    draw_tote(solid, (*size[:2], size[2] * cell.height_unit))
    if cell.height_unit == 1:
        draw_boxes(solid, boxes, colours, size)
    else:
        draw_blocks(solid, boxes, colours, size, cell.height_unit)
    if 0 < len(colours) <= 20:
        _draw_legend(figure, colours, cell)
    _draw_plan(plan, heights, recording.tote_height, cell)
    share = 100 * sum(box.volume for box in boxes) / np.prod(size)
    share = np.floor(10 * share + 1e-9) / 10  # never rounded up: 100% is full
    caption = f"{_sides(size, cell)} tote, {share:.1f}% full, {len(boxes)} items placed"
    if len(done) == len(recording.moves) and recording.ending is not None:
        caption += f". {recording.describe_ending(cell.num_places)}"
    figure.suptitle(caption, color=INK, fontsize="x-large")
    return figure


def kind_of(box: Box) -> Kind:
    """Return the size of a box, whichever way it is turned."""
    *_, w, d, h = box
    return min(w, d), max(w, d), h


def item_colours(boxes: list[Box]) -> dict[Kind, str]:
    """Return a colour for each kind of item, the small ones first; many kinds share a spectrum."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    kinds = sorted({kind_of(box) for box in boxes}, key=lambda kind: (np.prod(kind), kind))
    few = len(kinds) <= len(COLOURS)
    colours = COLOURS if few else [to_hex(c) for c in colormaps["Spectral"](np.linspace(0, 1, len(kinds)))]
    return dict(zip(kinds, colours, strict=False))


#: Faces of a unit cube that the viewer sees: outward normal, share of the light, corners as a cycle. The diagonal from
#: the first corner to the third runs along the lattice that the corners of all cubes project onto.
FACES = [
    ((0, 0, 1), 1.0, [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]),
    ((1, 0, 0), 0.72, [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)]),
    ((0, 1, 0), 0.86, [(0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1)]),
]


def visible_triangles(boxes) -> dict:
    """Return what is visible of boxes on a unit grid from the direction (1, 1, 1), exactly.

    In this projection the corners of all cells fall on one triangular lattice, so each of its triangles shows one face
    of one box, or nothing.

    Args:
        boxes: ``(x, y, z, w, d, h)`` each, whole numbers, not overlapping.

    Returns:
        ``{triangle: (box, face)}``: three lattice points ``(x - z, y - z)``; indices into ``boxes`` and ``FACES``.
    """
    cells = {}
    for number, (x, y, z, w, d, h) in enumerate(boxes):
        cells.update(dict.fromkeys([(x + i, y + j, z + k) for i, j, k in np.ndindex(w, d, h)], number))
    nearest: dict[tuple, tuple[int, int, int]] = {}  # triangle -> depth, box, face
    for (x, y, z), number in cells.items():
        for face, ((i, j, k), _, corners) in enumerate(FACES):
            if (x + i, y + j, z + k) in cells:
                continue  # the next cell covers it
            points = [(x + a - z - c, y + b - z - c, z + c) for a, b, c in corners]
            for triangle in (points[:3], [points[0], *points[2:]]):
                key = tuple(sorted((a, b) for a, b, _ in triangle))
                depth = sum(c for *_, c in triangle)  # along one line of sight, the higher the nearer
                if key not in nearest or depth > nearest[key][0]:
                    nearest[key] = depth, number, face
    return {key: (number, face) for key, (_, number, face) in nearest.items()}


def _to_paper(a, b) -> tuple[float, float]:
    """Return where a lattice point ``(x - z, y - z)`` lies on paper."""
    return (a - b) * 3**0.5 / 2, -(a + b) / 2


def draw_tote(axes, size: tuple[float, float, float]) -> None:
    """Draw a tote in isometric projection, seen from above the corner with the greatest x and the least y."""
    from matplotlib.collections import LineCollection, PolyCollection

    wide, deep, high = size

    def corner(x, y, z):
        return _to_paper(x - z, deep - y - z)  # y turned around, so that the viewer is at (1, 1, 1)

    floor = [corner(x, y, 0) for x, y in ((0, 0), (wide, 0), (wide, deep), (0, deep))]
    near_to_far = [((x, y), (0, deep)) for x, y in ((0, 0), (wide, deep))]
    far_walls = [[corner(*a, 0), corner(*b, 0), corner(*b, high), corner(*a, high)] for a, b in near_to_far]
    tints = ["#e4e8eb", "#f4f6f7", "#eceff1"]
    axes.add_collection(PolyCollection([floor, *far_walls], facecolors=tints, edgecolors=WALL, zorder=1))
    rim = [corner(x, y, high) for x, y in ((0, 0), (wide, 0), (wide, deep), (0, deep), (0, 0))]
    near_edges = [[corner(x, y, 0), corner(x, y, high)] for x, y in ((0, 0), (wide, 0), (wide, deep))]
    axes.add_collection(LineCollection([rim, *near_edges], colors=WALL, linewidths=1.2, zorder=4))
    gap = 0.05 * (wide + deep)
    for label, (x, y) in (("x", corner(wide / 2, 0, 0)), ("y", corner(wide, deep / 2, 0))):
        axes.text(x + (gap if label == "y" else -gap) / 2, y - gap / 2, label, ha="center", va="top", color=INK)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()


def far_to_near(low: np.ndarray, sides: np.ndarray) -> list[int]:
    """Return the order in which boxes hide each other, seen from the direction (1, 1, 1): their numbers.

    A box can hide another one only if it is nowhere wholly beyond it; so there is an order, unless three or more hide
    each other in a circle, which one of them then ends.

    Args:
        low, sides: ``[n, 3]``, of boxes that do not overlap.
    """
    hides = ((low + sides)[:, None] > low + 1e-9).all(2) & ~np.eye(len(low), dtype=bool)  # [nearer, farther]
    order, left = [], list(range(len(low)))
    while left:
        free = (number for number in left if not hides[number, left].any())
        order.append(next(free, min(left, key=lambda index: low[index].sum())))
        left.remove(order[-1])
    return order


def draw_blocks(axes, boxes: list[Box], colours: dict[Kind, str], size: tuple[int, int, int], unit: float) -> None:
    """Draw the items one over the other, the farthest first: for heights in units that are no cells."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgb

    wide, deep, _ = size
    low = np.array([(x, deep - y - d, z * unit) for x, y, z, _, d, _ in boxes]).reshape(-1, 3)
    sides = np.array([(w, d, h * unit) for *_, w, d, h in boxes]).reshape(-1, 3)
    faces, fills = [], []
    for number in far_to_near(low, sides):
        for _, light, corners in FACES:
            points = low[number] + np.array(corners) * sides[number]
            faces.append([_to_paper(x - z, y - z) for x, y, z in points])
            fills.append(np.array(to_rgb(colours[kind_of(boxes[number])])) * light)
    width = float(np.clip(10 / (wide + deep), 0.35, 1.1))
    axes.add_collection(PolyCollection(faces, facecolors=fills, edgecolors=INK, linewidths=width, zorder=2))


def draw_boxes(axes, boxes: list[Box], colours: dict[Kind, str], size: tuple[int, int, int]) -> None:
    """Draw the items in a tote of this size, in the projection of :func:`draw_tote`; heights are in cells."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgb

    wide, deep, _ = size
    seen = visible_triangles([(x, deep - y - d, z, w, d, h) for x, y, z, w, d, h in boxes])
    fills = []
    owners: dict[tuple, list[tuple[int, int]]] = {}  # side of a triangle -> box and face on either hand
    for triangle, (number, face) in seen.items():
        fills.append(np.array(to_rgb(colours[kind_of(boxes[number])])) * FACES[face][1])
        for i, j in ((0, 1), (1, 2), (0, 2)):
            owners.setdefault((triangle[i], triangle[j]), []).append((number, face))
    triangles = [[_to_paper(*point) for point in triangle] for triangle in seen]
    # A stroke of the fill's own colour closes the seams between triangles.
    axes.add_collection(PolyCollection(triangles, facecolors=fills, edgecolors=fills, linewidths=0.6, zorder=2))
    # A line where a face ends: nothing beyond, or another face.
    ends = [side for side, faces in owners.items() if len(faces) == 1 or faces[0] != faces[1]]
    edges = [[_to_paper(*p), _to_paper(*q)] for p, q in ends]
    width = float(np.clip(10 / (wide + deep), 0.35, 1.1))
    axes.add_collection(LineCollection(edges, colors=INK, linewidths=width, capstyle="round", zorder=3))


def _sides(size: tuple[int, ...], cell: CellSpec) -> str:
    """Return a size ``(w, d, h)`` in cells, as ``WxDxH``."""
    w, d, h = size
    return f"{w}x{d}x{h * cell.height_unit:g}"


def _draw_legend(figure, colours: dict[Kind, str], cell: CellSpec) -> None:
    """Draw which colour stands for which kind of item."""
    from matplotlib.patches import Patch

    patches = [Patch(facecolor=c, edgecolor=INK, label=_sides(kind, cell)) for kind, c in colours.items()]
    figure.legend(handles=patches, title="items (cells)", loc="outside left upper", frameon=False, alignment="left")


def _draw_plan(axes, heights: np.ndarray, limit: int, cell: CellSpec) -> None:
    """Draw a height map ``[W_T, D_T]`` from above, in one colour for each whole height up to ``limit``."""
    from matplotlib import colormaps
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.ticker import MaxNLocator

    colours = ListedColormap(colormaps["YlGnBu"](np.linspace(0, 0.75, limit + 1)))
    norm = BoundaryNorm(np.arange(limit + 2) - 0.5, colours.N)
    image = axes.imshow(heights.T, origin="lower", cmap=colours, norm=norm)
    if max(heights.shape) <= 12:
        for (x, y), height in np.ndenumerate(heights):
            red, green, blue, _ = colours(norm(height))
            dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.55
            axes.text(x, y, str(int(height)), ha="center", va="center", color="white" if dark else INK)
        axes.set_xticks(np.arange(heights.shape[0] + 1) - 0.5, minor=True)
        axes.set_yticks(np.arange(heights.shape[1] + 1) - 0.5, minor=True)
        axes.grid(which="minor", color="white", lw=1)
        axes.tick_params(which="minor", length=0)
    axes.set_xlabel("x (cells)")
    axes.set_ylabel("y (cells)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(12, integer=True, min_n_ticks=1))
    axes.set_title("height map from above")
    every = limit // 12 + 1
    unit = "cells" if cell.height_unit == 1 else f"units of {cell.height_unit:g} cells"
    axes.figure.colorbar(image, ax=axes, label=f"height ({unit})", shrink=0.8, ticks=range(0, limit + 1, every))
