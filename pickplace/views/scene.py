"""Draw a packed tote: boxes in isometric projection, and the height map from above."""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial

import numpy as np

from pickplace.rules.cell import CellSpec
from pickplace.views.figures import COLOURS, INK, WALL, figure_of
from pickplace.views.recording import PlacedItem, Recording

#: ColorBrewer's diverging scheme "Spectral". It is copied here, so that a page without figures imports no matplotlib.
SPECTRUM = (
    "#9e0142", "#d53e4f", "#f46d43", "#fdae61", "#fee08b", "#ffffbf", "#e6f598", "#abdda4", "#66c2a5", "#3288bd",
    "#5e4fa2",
)  # fmt: skip

#: Size of an item ``(w, d, h)`` with ``w <= d``, so that it does not depend on the item's rotation.
Kind = tuple[int, int, int]


def draw_scene(recording: Recording, cell: CellSpec, colours: dict[Kind, str], moves: int | None = None):
    """Return a matplotlib figure of the tote of a recorded episode, beside its height map.

    Args:
        recording: the episode.
        cell: the sizes.
        colours: of the kinds of items, see :func:`item_colours`.
        moves: number of moves made; None: all, and the caption names the end of the episode.
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
    share = np.floor(1000 * sum(box.volume for box in boxes) / np.prod(size) + 1e-9) / 10  # down: 100% is full
    caption = f"{_sides(size, cell)} tote, {share:.1f}% full, {len(boxes)} items placed"
    if len(done) == len(recording.moves) and recording.ending is not None:
        caption += f". {recording.describe_ending(cell)}"
    figure.suptitle(caption, color=INK, fontsize="x-large")
    return figure


def kind_of(item: Sequence[int]) -> Kind:
    """Return the kind of an item ``(..., w, d, h)``: its size, independent of its rotation."""
    *_, w, d, h = item
    return min(w, d), max(w, d), h


def item_colours(items: Iterable[Sequence[int]]) -> dict[Kind, str]:
    """Return a colour for each kind of items ``(..., w, d, h)``, small ones first; many kinds get a spectrum."""
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
    """Return the position on paper of a lattice point ``(x - z, y - z)``."""
    return (a - b) * 3**0.5 / 2, -(a + b) / 2


def draw_tote(axes, size: tuple[float, float, float]) -> None:
    """Draw a tote in isometric projection, seen from above the corner with the greatest x and the least y."""
    from matplotlib.collections import LineCollection, PolyCollection

    wide, deep, high = size

    def corner(x, y, z):
        return _to_paper(x - z, deep - y - z)  # y mirrored, so that the viewer is at (1, 1, 1)

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
    """Draw items in a tote of ``size``, in the projection of :func:`draw_tote`; ``unit`` is a height unit in cells."""
    from matplotlib import collections, colors

    wide, deep, _ = size
    table = np.array(items)
    table[:, 1] = deep - table[:, 1] - table[:, 4]  # y mirrored, as in draw_tote
    low, high = table[:, :3], table[:, :3] + table[:, 3:]
    side = np.sqrt(table[:, 3] * table[:, 4]).mean() / (wide + deep)
    pen = (*colors.to_rgb(INK), 1.0), float(np.clip(5 * side, 0.35, 1.1))  # colour and width
    fills = [np.array(colors.to_rgb(colours[kind_of(item)])) for item in items]
    seen = [[not _is_covered(low, high, number, axis) for axis in range(3)] for number in range(len(items))]
    drawn: list[tuple] = []  # polygon, fill, colour and width of its line
    for number, *ends in _back_to_front(np.hstack([np.arange(len(items))[:, None], low, high])):
        for normal, light, corners in FACES:
            axis = normal.index(1)
            if not seen[number][axis] or ends[3 + axis] < high[number][axis]:  # a cut through the item
                continue
            places = [[ends[axis + 3 * end] for axis, end in enumerate(corner)] for corner in corners]
            points = [_to_paper(x - z * unit, y - z * unit) for x, y, z in places]
            fill = (*fills[number] * light, 1.0)
            drawn.append((points, fill, fill, 0.6))  # the line closes the seam between parts of an item
            for start, end in ((0, 1), (1, 2), (2, 3), (3, 0)):
                if _is_edge(places[start], places[end], low[number], high[number]):
                    drawn.append(([points[start], points[end]], (0.0, 0.0, 0.0, 0.0), *pen))
    polygons, faces, lines, widths = zip(*drawn, strict=True)
    axes.add_collection(
        collections.PolyCollection(
            polygons, facecolors=faces, edgecolors=lines, linewidths=widths, capstyle="round", zorder=2
        )
    )


def _back_to_front(parts: np.ndarray) -> Iterator[list[int]]:
    """Yield boxes from back to front as seen from the direction (1, 1, 1); some boxes are cut.

    A plane between boxes splits them into those behind it and those before it, and each part is split again. If every
    such plane passes through a box, the plane that passes through the fewest cuts them.

    Args:
        parts: number, least x, y, z and greatest x, y, z of each box, ``[N, 7]``; the boxes do not overlap.
    """
    waiting = [parts]
    while waiting:
        parts = waiting.pop()
        if len(parts) == 1:
            yield parts[0].tolist()
            continue
        planes = []
        for axis in range(3):
            low, high = parts[:, 1 + axis], parts[:, 4 + axis]
            at = np.unique(low)
            behind, before = (high <= at[:, None]).sum(1), (low >= at[:, None]).sum(1)
            cut = len(parts) - behind - before
            planes += [(c, abs(n - f), axis, a) for c, n, f, a in zip(cut, before, behind, at, strict=True) if n and f]
        _, _, axis, at = min(planes)
        low, high = parts[:, 1 + axis], parts[:, 4 + axis]
        far, near = parts[low < at].copy(), parts[high > at].copy()
        far[:, 4 + axis], near[:, 1 + axis] = np.minimum(far[:, 4 + axis], at), np.maximum(near[:, 1 + axis], at)
        waiting += [near, far]


def _is_covered(low: np.ndarray, high: np.ndarray, number: int, axis: int) -> bool:
    """Return whether other boxes cover a box's face at its greatest coordinate of an axis; corners are ``[N, 3]``."""
    others = [other for other in range(3) if other != axis]
    touching = low[:, axis] == high[number, axis]
    shared = np.minimum(high[touching], high[number]) - np.maximum(low[touching], low[number])
    return shared[:, others].clip(0).prod(1).sum() == (high[number] - low[number])[others].prod()


def _is_edge(start: list[int], end: list[int], low: np.ndarray, high: np.ndarray) -> bool:
    """Return whether the line between two corners of a part's face lies on an edge of the item, not on a cut."""
    return all(at in (low[axis], high[axis]) for axis, at in enumerate(start) if at == end[axis])


def _sides(size: tuple[int, ...], cell: CellSpec) -> str:
    return f"{size[0]}x{size[1]}x{size[2] * cell.height_unit:g}"


def _draw_plan(axes, heights: np.ndarray, highest: np.ndarray, limit: int, cell: CellSpec) -> None:
    """Draw a height map ``[W_T, D_T]`` from above, in at most 256 colours up to ``limit``.

    A line shows the side of an item between two cells whose ``highest`` items differ.
    """
    from matplotlib import collections, colormaps, colors, ticker

    colours = colors.ListedColormap(colormaps["YlGnBu"](np.linspace(0, 0.6, min(limit + 1, 256))))
    norm = colors.Normalize(-0.5, limit + 0.5)
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
    whole = partial(ticker.MaxNLocator, 12, integer=True, min_n_ticks=1)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(whole())
    unit = "cells" if cell.height_unit == 1 else f"units of {cell.height_unit:g} cells"
    axes.figure.colorbar(image, ax=axes, label=f"height ({unit})", shrink=0.8, ticks=whole())
