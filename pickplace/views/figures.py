"""Figures and tables of a run: learning curve, evaluation table, picture of a packed tote."""

from pathlib import Path

import numpy as np

from pickplace.runs.loggers import read_csv

WALL, INK, POINT, LINE = "#9aa3ab", "#263238", "#c2410c", "#0072b2"
# Okabe and Ito's colours, told apart by colour-blind readers too; one for each size of item.
COLOURS = ["#56b4e9", "#e69f00", "#009e73", "#f0e442", "#cc79a7", "#0072b2", "#d55e00", "#8c8c8c"]

# Of the reasons for which episodes end, by their names in the metrics; stuck, the good one, is grey.
FAILURES = {
    "stuck": "#cfd5da", "none": "#eceff1", "pick_miss": "#d55e00", "bin_collision": "#e69f00",
    "tote_collision": "#0072b2", "overflow": "#56b4e9", "item_collision": "#009e73", "unstable": "#cc79a7",
}  # fmt: skip


def figure_of(width: float, height: float):
    """A figure that needs no display; matplotlib is imported here, so that importing pickplace stays fast."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def learning_curve(metrics: Path, path: Path) -> None:
    """Draw occupancy over frames, and below it the tote height that the curriculum had reached.

    Whatever the table lacks is left out: a run that was stopped early has no validation, one batch may end no episode.

    Args:
        metrics: a ``metrics.csv``, see :class:`pickplace.runs.loggers.CsvLogger`.
        path: the PNG or SVG to write.
    """
    from matplotlib.ticker import EngFormatter, MaxNLocator

    rows = read_csv(metrics)

    def columns(*keys):
        """Frames and these metrics, of the rows that have them all."""
        table = [[row[key] for key in ("frames", *keys)] for row in rows if all(key in row for key in keys)]
        return np.array(table, dtype=float).reshape(-1, 1 + len(keys)).T

    steps, level = columns("curriculum/level")
    figure = figure_of(8, 5 if len(steps) else 4)
    if len(steps):
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[4, 1])
    else:
        upper = lower = figure.subplots()

    frames, occupancy = columns("train/occupancy")
    if len(frames):
        window = max(1, len(frames) // 100)  # a running mean over the latest 1% of the batches
        smooth = np.convolve(occupancy, np.ones(window) / window, mode="valid")
        upper.plot(
            frames[window - 1 :], smooth, ".-" if len(smooth) < 20 else "-", color=LINE,
            label="training episodes, at the curriculum's height, actions sampled",
        )  # fmt: skip
    at, mean = columns("eval/occupancy")
    if len(at):
        upper.plot(at, mean, "o-", color=POINT, label="validation at full height, 95% interval")
    at, mean, low, high = columns("eval/occupancy", "eval/ci95_low", "eval/ci95_high")
    if len(at):
        # The mean of few episodes may lie on the edge of its interval by rounding; a bar has no negative length.
        bars = [np.maximum(mean - low, 0), np.maximum(high - mean, 0)]
        upper.errorbar(at, mean, yerr=bars, fmt="none", ecolor=POINT, capsize=3)
    upper.set_title("Learning curve: share of the tote's volume filled when an episode ends")
    upper.set_ylabel("occupancy (0 to 1)")
    upper.set_ylim(0, 1.02)
    upper.grid(alpha=0.3)
    if upper.lines:
        upper.legend(loc="best")
    else:
        upper.text(0.5, 0.5, "no episode has ended yet", transform=upper.transAxes, ha="center", color=INK)

    if len(steps):
        for frame in steps[1:][np.diff(level) != 0]:
            upper.axvline(frame, color=WALL, lw=0.8, ls=":", zorder=0)
        lower.step(steps, level, ".-" if len(steps) < 20 else "-", where="post", color=INK)
        lower.set_ylabel("tote height\n(cells)")
        lower.set_ylim(0, level.max() + 0.5)
        lower.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        lower.grid(alpha=0.3)
    lower.set_xlabel("frames (environment steps)")
    lower.set_xlim(0, 1.02 * max([row["frames"] for row in rows], default=100))
    lower.xaxis.set_major_formatter(EngFormatter(sep=""))
    figure.savefig(path, dpi=120)


def failure_mix(metrics: Path, path) -> None:
    """Draw the share of training episodes that ended for each reason, over frames.

    Args:
        metrics: a ``metrics.csv``.
        path: the PNG or SVG to write, or a file object.
    """
    from matplotlib.ticker import EngFormatter, PercentFormatter

    prefix = "train/failure_"
    rows = [row for row in read_csv(metrics) if any(key.startswith(prefix) for key in row)]
    names = [name for name in FAILURES if any(row.get(prefix + name, 0) > 0 for row in rows)]
    figure = figure_of(8, 3.2)
    axes = figure.subplots()
    if rows:
        frames = np.array([row["frames"] for row in rows])
        shares = np.array([[row.get(prefix + name, 0.0) for row in rows] for name in names]).reshape(len(names), -1)
        weights = np.array([row.get("train/episodes", 1.0) for row in rows])
        window = max(1, len(rows) // 100)  # as in the learning curve: a running mean over the latest 1%

        def smooth(values):
            return np.convolve(values, np.ones(window), mode="valid")

        total = np.maximum(smooth(weights), 1e-9)
        stack = [smooth(share * weights) / total for share in shares]
        axes.stackplot(
            frames[window - 1 :], stack, labels=[name.replace("_", " ") for name in names],
            colors=[FAILURES[name] for name in names],
        )  # fmt: skip
        axes.set_xlim(0, 1.02 * frames[-1])
        axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    else:
        axes.text(0.5, 0.5, "no episode has ended yet", transform=axes.transAxes, ha="center", color=INK)
    axes.set_ylim(0, 1)
    axes.yaxis.set_major_formatter(PercentFormatter(1))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("frames (environment steps)")
    axes.set_ylabel("training episodes")
    figure.savefig(path, dpi=120, format=None if isinstance(path, Path) else "png")


def draw_scene(recording, cell, colours, moves: int | None = None):
    """Draw the tote of a recorded episode, beside its height map.

    Args:
        recording: a :class:`pickplace.views.recording.Recording`.
        cell: the sizes.
        colours: of the kinds of items, see :func:`item_colours`.
        moves: how many moves have been made; None: all, and the caption says how the episode ended.

    Returns:
        A matplotlib figure.
    """
    done = recording.moves if moves is None else recording.moves[:moves]
    boxes = recording.boxes[: sum(not move.failure for move in done)]
    heights = np.zeros(cell.tote_size[:2], dtype=int)
    for x, y, z, w, d, h in boxes:
        heights[x : x + w, y : y + d] = z + h
    size = (*cell.tote_size[:2], recording.tote_height)
    figure = figure_of(12, 6)
    solid, plan = figure.subplots(1, 2, width_ratios=[1.2, 1])
    _draw_boxes(solid, boxes, colours, size)
    _draw_plan(plan, heights, recording.tote_height)
    share = 100 * sum(w * d * h for *_, w, d, h in boxes) / np.prod(size)
    share = np.floor(10 * share + 1e-9) / 10  # never rounded up: 100% is full
    caption = f"{'x'.join(map(str, size))} tote, {share:.1f}% full, {len(boxes)} items placed"
    if len(done) == len(recording.moves) and recording.ending is not None:
        caption += f". {recording.describe_ending(cell.num_places)}"
    figure.suptitle(caption, color=INK, fontsize="x-large")
    return figure


def _kind(box) -> tuple[int, int, int]:
    """The size of an item, whichever way it was turned."""
    *_, w, d, h = box
    return min(w, d), max(w, d), h


def item_colours(boxes) -> dict[tuple[int, int, int], str]:
    """A colour for each kind of item, the small ones first; many kinds share a spectrum."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    kinds = sorted({_kind(box) for box in boxes}, key=lambda kind: (np.prod(kind), kind))
    few = len(kinds) <= len(COLOURS)
    colours = COLOURS if few else [to_hex(c) for c in colormaps["Spectral"](np.linspace(0, 1, len(kinds)))]
    return dict(zip(kinds, colours, strict=False))


# Faces that the viewer sees, of a unit cube: outward normal, share of the light, corners as a cycle. The cut from the
# first corner to the third runs along the lattice that the corners of all cubes project onto.
FACES = [
    ((0, 0, 1), 1.0, [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]),
    ((1, 0, 0), 0.72, [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)]),
    ((0, 1, 0), 0.86, [(0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1)]),
]


def visible_triangles(boxes) -> dict:
    """What is seen of boxes on a unit grid from the direction (1, 1, 1), exactly, with no order of painting.

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


def _draw_boxes(axes, placed, colours, size) -> None:
    """The items as boxes in isometric projection, from the corner with the greatest x and the least y, from above."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    wide, deep, high = size

    def paper(a, b):
        return (a - b) * 3**0.5 / 2, -(a + b) / 2

    def corner(x, y, z):
        return paper(x - z, deep - y - z)

    # The tote: floor and the two far walls, tinted.
    lo, hi = (0, 0), (wide, deep)
    floor = [corner(x, y, 0) for x, y in ((0, 0), (wide, 0), (wide, deep), (0, deep))]
    walls = [
        [corner(*lo, 0), corner(0, deep, 0), corner(0, deep, high), corner(*lo, high)],
        [corner(*hi, 0), corner(0, deep, 0), corner(0, deep, high), corner(*hi, high)],
    ]
    axes.add_collection(
        PolyCollection([floor, *walls], facecolors=["#e4e8eb", "#f4f6f7", "#eceff1"], edgecolors=WALL, zorder=1)
    )

    # The items, y turned around so that the viewer is at (1, 1, 1).
    seen = visible_triangles([(x, deep - y - d, z, w, d, h) for x, y, z, w, d, h in placed])
    fills = []
    sides: dict[tuple, list[tuple[int, int]]] = {}  # of triangles -> box and face at each
    for triangle, (number, face) in seen.items():
        fills.append(np.array(to_rgb(colours[_kind(placed[number])])) * FACES[face][1])
        for i, j in ((0, 1), (1, 2), (0, 2)):
            sides.setdefault((triangle[i], triangle[j]), []).append((number, face))
    triangles = [[paper(*point) for point in triangle] for triangle in seen]
    # A stroke of the fill's own colour closes the seams between triangles.
    axes.add_collection(PolyCollection(triangles, facecolors=fills, edgecolors=fills, linewidths=0.6, zorder=2))
    # Lines where a face ends: both sides of it, or nothing beyond, shown as something else.
    edges = [[paper(*p), paper(*q)] for (p, q), owners in sides.items() if len(owners) == 1 or owners[0] != owners[1]]
    width = float(np.clip(10 / (wide + deep), 0.35, 1.1))
    axes.add_collection(LineCollection(edges, colors=INK, linewidths=width, capstyle="round", zorder=3))

    # The near edges of the tote.
    rim = [corner(x, y, high) for x, y in (lo, (wide, 0), hi, (0, deep), lo)]
    posts = [[corner(x, y, 0), corner(x, y, high)] for x, y in (lo, (wide, 0), hi)]
    axes.add_collection(LineCollection([rim, *posts], colors=WALL, linewidths=1.2, zorder=4))
    gap = 0.05 * (wide + deep)
    for label, (x, y) in (("x", corner(wide / 2, 0, 0)), ("y", corner(wide, deep / 2, 0))):
        axes.text(x + (gap if label == "y" else -gap) / 2, y - gap / 2, label, ha="center", va="top", color=INK)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    if 0 < len(colours) <= 20:
        patches = [Patch(facecolor=c, edgecolor=INK, label="x".join(map(str, kind))) for kind, c in colours.items()]
        axes.figure.legend(
            handles=patches, title="items (cells)", loc="outside left upper", frameon=False, alignment="left"
        )


def _draw_plan(axes, heights, limit) -> None:
    """The height map ``[W_T, D_T]`` from above, in one colour for each whole height."""
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
    axes.figure.colorbar(image, ax=axes, label="height (cells)", shrink=0.8, ticks=range(0, limit + 1, every))


def evaluation_table(result: dict) -> str:
    """The figures of an ``evaluation.json`` as a Markdown table."""
    env, occupancy, latency = result["env"], result["occupancy"], result["latency_ms"]
    low, high = occupancy["ci95"]
    failures = ", ".join(f"{name} {count}" for name, count in result["failures"].items())
    same = ", all of the same items" if result.get("same_items") else ""
    rows = [
        ("planner", result["planner"]),
        ("tote, rotations", f"{'x'.join(map(str, env['tote_size']))}, R={env['rotations']}"),
        ("episodes", f"{result['episodes']} of the {result['stream']} stream, seed {result['seed']}{same}"),
        ("occupancy", f"{occupancy['mean']:.4f} (95% interval {low:.4f} to {high:.4f}), least {occupancy['min']:.4f}"),
        ("items placed", f"{result['items_placed']:.1f} an episode"),
        ("episodes ended by", failures),
        ("feasible actions", f"{result['feasible_action_share']:.2%} of all, mean over decisions"),
    ]
    if paired := result.get("paired_difference"):
        low, high = paired["ci95"]
        text = f"{paired['mean']:+.4f} (95% interval of the paired difference {low:+.4f} to {high:+.4f})"
        rows.append((f"minus {paired['against']}", text))
    if latency:
        rows.append(("one decision", f"{latency['p50']:.1f} ms (median), {latency['p95']:.1f} ms (95th percentile)"))
    if result.get("checkpoint"):
        trained = result["trained"]
        rows.append(("checkpoint", f"{result['checkpoint']} ({trained['frames']:,} frames, seed {trained['seed']})"))
        if result.get("warm_start"):
            rows.append(("warm start", f"imitated {result['warm_start']}"))
    if "candidates" in result:
        in_training, at_decision = (
            {True: "yes", False: "no", None: "unknown"}.get(mask, mask)
            for mask in (result.get("mask_in_training"), result["mask_at_decision"])
        )
        masks = f"in training {in_training}, at decision {at_decision}"
        rows.append(("mask; candidates K", f"{masks}; {result['candidates']}"))
    width = max(len(name) for name, _ in rows)
    values = max(len(value) for _, value in rows)
    lines = [f"| {name:<{width}} | {value:<{values}} |" for name, value in rows]
    return "\n".join([lines[0], f"|{'-' * (width + 2)}|{'-' * (values + 2)}|", *lines[1:]]) + "\n"
