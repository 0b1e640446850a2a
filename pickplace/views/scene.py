"""Drawing of a packed tote: boxes in isometric projection, and the height map from above."""

from collections.abc import Iterable, Sequence

import numpy as np

from pickplace.rules.cell import CellSpec
from pickplace.views.figures import COLOURS, INK, WALL, figure_of
from pickplace.views.recording import PlacedItem, Recording

#: ColorBrewer's diverging scheme "Spectral"; matplotlib has it, but a page without figures need not import that.
SPECTRUM = (
    "#9e0142", "#d53e4f", "#f46d43", "#fdae61", "#fee08b", "#ffffbf", "#e6f598", "#abdda4", "#66c2a5", "#3288bd",
    "#5e4fa2",
)  # fmt: skip

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
    from matplotlib.patches import Patch

    done = recording.moves[:moves]
    boxes = recording.boxes[: sum(not move.failure for move in done)]
    heights, highest = (np.zeros(cell.tote_size[:2], dtype=int) for _ in range(2))  # and the number of the item there
    for number, (x, y, z, w, d, h) in enumerate(boxes, 1):
        heights[x : x + w, y : y + d], highest[x : x + w, y : y + d] = z + h, number
    size = (*cell.tote_size[:2], recording.tote_height)
    figure = figure_of(12, 6)
    solid, plan = figure.subplots(1, 2, width_ratios=[1.2, 1])
    draw_tote(solid, (*size[:2], size[2] * cell.height_unit))
    if boxes:
        draw_items(solid, boxes, colours, size, cell.height_unit)
    if 0 < len(colours) <= 20:
        patches = [Patch(facecolor=c, edgecolor=INK, label=_sides(kind, cell)) for kind, c in colours.items()]
        figure.legend(handles=patches, title="items (cells)", loc="outside left upper", frameon=False, alignment="left")
    _draw_plan(plan, heights, highest, recording.tote_height, cell)
    share = np.floor(1000 * sum(box.volume for box in boxes) / np.prod(size) + 1e-9) / 10  # not rounded: 100% is full
    caption = f"{_sides(size, cell)} tote, {share:.1f}% full, {len(boxes)} items placed"
    if len(done) == len(recording.moves) and recording.ending is not None:
        caption += f". {recording.describe_ending(cell.num_places)}"
    figure.suptitle(caption, color=INK, fontsize="x-large")
    return figure


def kind_of(item: Sequence[int]) -> Kind:
    """Return the size of an item ``(..., w, d, h)``, whichever way it is turned."""
    *_, w, d, h = item
    return min(w, d), max(w, d), h


def item_colours(items: Iterable[Sequence[int]]) -> dict[Kind, str]:
    """Return a colour for each kind of items ``(..., w, d, h)``, the small ones first; many kinds share a spectrum."""
    kinds = sorted(set(map(kind_of, items)), key=lambda kind: (np.prod(kind), kind))
    if len(kinds) <= len(COLOURS):
        return dict(zip(kinds, COLOURS, strict=False))
    stops = np.array([[*bytes.fromhex(colour[1:])] for colour in SPECTRUM])
    at, places = np.linspace(0, len(stops) - 1, len(kinds)), np.arange(len(stops))
    shades = np.stack([np.interp(at, places, channel) for channel in stops.T], 1).round().astype(np.uint8)
    return {kind: f"#{shade.tobytes().hex()}" for kind, shade in zip(kinds, shades, strict=True)}


#: Faces of a unit cube that the viewer sees: outward normal, share of the light, corners as a cycle.
FACES = [
    ((0, 0, 1), 1.0, [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]),
    ((1, 0, 0), 0.72, [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)]),
    ((0, 1, 0), 0.86, [(0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1)]),
]


def _to_paper(a, b) -> tuple[float, float]:
    """Return where a lattice point ``(x - z, y - z)`` lies on paper."""
    return (a - b) * 3**0.5 / 2, -(a + b) / 2


def draw_tote(axes, size: tuple[float, float, float]) -> None:
    """Draw a tote in isometric projection, seen from above the corner with the greatest x and the least y."""
    from matplotlib.collections import LineCollection, PolyCollection

    wide, deep, high = size

    def corner(x, y, z):
        return _to_paper(x - z, deep - y - z)  # y turned around, so that the viewer is at (1, 1, 1)

    floor, rim = ([corner(x, y, z) for x, y in ((0, 0), (wide, 0), (wide, deep), (0, deep))] for z in (0, high))
    far_walls = [[floor[near], floor[3], rim[3], rim[near]] for near in (0, 2)]
    axes.add_collection(
        PolyCollection([floor, *far_walls], facecolors=["#e4e8eb", "#f4f6f7", "#eceff1"], edgecolors=WALL, zorder=1)
    )
    near_edges = zip(floor[:3], rim, strict=False)
    axes.add_collection(LineCollection([[*rim, rim[0]], *near_edges], colors=WALL, linewidths=1.2, zorder=4))
    gap = 0.05 * (wide + deep)
    for label, (x, y) in (("x", corner(wide / 2, 0, 0)), ("y", corner(wide, deep / 2, 0))):
        axes.text(x + (gap if label == "y" else -gap) / 2, y - gap / 2, label, ha="center", va="top", color=INK)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()


def draw_items(axes, items: list[PlacedItem], colours: dict[Kind, str], size: tuple[int, ...], unit: float) -> None:
    """Draw items in a tote of this size, in the projection of :func:`draw_tote`; ``unit`` is a height unit in cells.

    They are drawn in columns of one cell by one cell. From the direction (1, 1, 1) a column can hide only those that
    are farther along x + y, and lower parts of its own cell. So there is an order in which all of them are drawn right.
    """
    from matplotlib import collections, colors

    wide, deep, _ = size
    pen = (*colors.to_rgb(INK), 1.0), float(np.clip(10 / (wide + deep), 0.35, 1.1))  # colour and width
    spans: dict[tuple[int, int], list[tuple[int, int]]] = {}  # cell -> heights that are filled; y is turned around
    columns = []
    for item in items:
        x, y = item.x, deep - item.y - item.d
        for i, j in np.ndindex(item.w, item.d):
            spans.setdefault((x + i, y + j), []).append((item.z, item.z + item.h))
            columns.append((x + i + y + j, item.z, (x + i, y + j), (i, j), item))

    def is_covered(x: int, y: int, low: int, high: int) -> bool:
        return sum(max(0, min(high, top) - max(low, z)) for z, top in spans.get((x, y), ())) == high - low

    drawn: list[tuple] = []  # polygon, fill, colour and width of its line
    for _, low, cell, place, item in sorted(columns):
        top = low + item.h
        for (i, j, k), light, corners in FACES:
            if is_covered(cell[0] + i, cell[1] + j, *((top, top + 1) if k else (low, top))):
                continue
            heights = [unit * (top if c else low) for *_, c in corners]
            points = [
                _to_paper(cell[0] + a - z, cell[1] + b - z) for (a, b, _), z in zip(corners, heights, strict=True)
            ]
            fill = (*np.multiply(colors.to_rgb(colours[kind_of(item)]), light), 1.0)
            drawn.append((points, fill, fill, 0.6))  # the line closes the seam between columns
            for start, end in ((0, 1), (1, 2), (2, 3), (3, 0)):
                if _is_edge(place, corners[start], corners[end], item):
                    drawn.append(([points[start], points[end]], (0.0, 0.0, 0.0, 0.0), *pen))
    polygons, fills, lines, widths = zip(*drawn, strict=True)
    axes.add_collection(
        collections.PolyCollection(
            polygons, facecolors=fills, edgecolors=lines, linewidths=widths, capstyle="round", zorder=2
        )
    )


def _is_edge(place, start, end, item: PlacedItem) -> bool:
    """Return whether a side of a column's face, between two corners, is part of an edge of its item.

    Args:
        place: the column's cell in its item, along x and y.
    """
    fixed = [(axis, place[axis] + start[axis]) for axis in (0, 1) if start[axis] == end[axis]]
    return all(at in (0, (item.w, item.d)[axis]) for axis, at in fixed)


def _sides(size: tuple[int, ...], cell: CellSpec) -> str:
    return f"{size[0]}x{size[1]}x{size[2] * cell.height_unit:g}"


def _draw_plan(axes, heights: np.ndarray, highest: np.ndarray, limit: int, cell: CellSpec) -> None:
    """Draw a height map ``[W_T, D_T]`` from above, in one colour for each whole height up to ``limit``.

    Where the number of the ``highest`` item changes from one cell to the next, a line shows the items' sides.
    """
    from matplotlib import collections, colormaps, colors, ticker

    colours = colors.ListedColormap(colormaps["YlGnBu"](np.linspace(0, 0.6, limit + 1)))
    norm = colors.BoundaryNorm(np.arange(limit + 2) - 0.5, colours.N)
    image = axes.imshow(heights.T, origin="lower", cmap=colours, norm=norm)
    if max(heights.shape) <= 12:
        for (x, y), height in np.ndenumerate(heights):
            red, green, blue, _ = colours(norm(height))
            dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.55
            axes.text(x, y, str(int(height)), ha="center", va="center", color="white" if dark else INK)
    sides = [((x + 0.5, y - 0.5), (x + 0.5, y + 0.5)) for x, y in np.argwhere(highest[1:] != highest[:-1])]
    sides += [((x - 0.5, y + 0.5), (x + 0.5, y + 0.5)) for x, y in np.argwhere(highest[:, 1:] != highest[:, :-1])]
    axes.add_collection(collections.LineCollection(sides, colors=INK, linewidths=2, capstyle="projecting"))
    axes.set(title="height map and items from above", xlabel="x (cells)", ylabel="y (cells)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(ticker.MaxNLocator(12, integer=True, min_n_ticks=1))
    unit = "cells" if cell.height_unit == 1 else f"units of {cell.height_unit:g} cells"
    axes.figure.colorbar(
        image, ax=axes, label=f"height ({unit})", shrink=0.8, ticks=range(0, limit + 1, limit // 12 + 1)
    )
