"""Figures and tables of a run: learning curve, evaluation table, picture of a packed tote."""

from pathlib import Path

import numpy as np

from pickplace.metrics import read_csv

WALL, INK, POINT = "#9aa3ab", "#263238", "#c2410c"
# Okabe and Ito's colours, told apart by colour-blind readers too; one for each size of item.
COLOURS = ["#56b4e9", "#e69f00", "#009e73", "#f0e442", "#cc79a7", "#0072b2", "#d55e00", "#8c8c8c"]


def _figure(width: float, height: float):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def learning_curve(metrics: Path, path: Path) -> None:
    """Draw occupancy and the curriculum's level over frames.

    Args:
        metrics: a ``metrics.csv``, see :class:`pickplace.metrics.CsvLogger`.
        path: the PNG or SVG to write.
    """
    rows = read_csv(metrics)
    figure = _figure(8, 5)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])

    def column(key):
        points = [(row["frames"], row[key]) for row in rows if key in row]
        return np.array(points, dtype=float).reshape(-1, 2).T

    frames, occupancy = column("train/occupancy")
    window = max(1, len(frames) // 100)
    kernel = np.ones(window) / window
    if len(frames):
        smooth = np.convolve(occupancy, kernel, mode="valid")
        label = "training episodes, at the curriculum's height, actions sampled"
        upper.plot(frames[window - 1 :], smooth, color="#0072b2", label=label)
    at, mean = column("eval/occupancy")
    if len(at):
        low, high = column("eval/ci95_low")[1], column("eval/ci95_high")[1]
        # The mean of few episodes may lie on the edge of its interval by rounding; a bar has no negative length.
        bars = [np.maximum(mean - low, 0), np.maximum(high - mean, 0)]
        label = "validation at full height, 95% interval"
        upper.errorbar(at, mean, yerr=bars, fmt="o-", color=POINT, capsize=3, label=label)
    upper.set_ylabel("occupancy")
    upper.set_ylim(0, 1.02)
    upper.grid(alpha=0.3)
    upper.legend(loc="lower right")
    upper.set_title("Share of the tote's volume filled")
    at, level = column("curriculum/level")
    lower.step(at, level, where="post", color=INK)
    lower.set_ylabel("tote height\n(cells)")
    lower.set_ylim(0, (level.max() if len(level) else 1) + 0.5)
    lower.yaxis.get_major_locator().set_params(integer=True)
    lower.set_xlabel("frames (environment steps)")
    lower.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def tote_picture(episodes, rules, path: Path) -> None:
    """Draw the packed tote of the first episode in perspective, beside its height map.

    Args:
        episodes: an :class:`pickplace.evaluate.Episodes`.
        rules: the task's sizes.
        path: the PNG or SVG to write.
    """
    figure = _figure(12, 6)
    solid, plan = figure.subplots(1, 2, width_ratios=[1.15, 1])
    colours = _colours(episodes.placed)
    height = int(episodes.tote_height[0])
    _draw_boxes(solid, episodes.placed, colours, (*rules.tote_size[:2], height))
    _draw_plan(plan, episodes.final_heights[0].numpy(), height)
    failure = int(episodes.failure[0])
    from pickplace.geometry import Failure

    ending = Failure(failure).name.lower().replace("_", " ") if failure else "the item stream ended"
    size = "x".join(map(str, (*rules.tote_size[:2], height)))
    figure.suptitle(
        f"Tote {size}: occupancy {float(episodes.occupancy[0]):.1%}, {int(episodes.items_placed[0])} items; "
        f"the episode ended with: {ending}",
        color=INK,
    )
    figure.savefig(path, dpi=120)


def _colours(placed) -> dict:
    """A colour for each kind of item, whichever way it was turned."""
    kinds = sorted({(min(w, d), max(w, d), h) for *_, w, d, h in placed})
    return {kind: COLOURS[i % len(COLOURS)] for i, kind in enumerate(kinds)}


def _draw_boxes(axes, placed, colours, size) -> None:
    """The items as boxes in an oblique view from the front right, above; exact, since hidden faces are painted over.

    Every face is drawn cell by cell, the cells from far to near: unit cubes have a painter's order, boxes may not.
    """
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    wide, deep, high = size
    across, along = np.array([0.87, -0.36]), np.array([0.87, 0.36])  # where the x and y axes point on paper
    up = np.array([0.0, 1.0])

    def project(x, y, z):
        return x * across + y * along + z * up

    def outline(points, **style):
        line = np.array([project(*p) for p in points])
        axes.plot(line[:, 0], line[:, 1], **style)

    floor = [(0, 0, 0), (wide, 0, 0), (wide, deep, 0), (0, deep, 0), (0, 0, 0)]
    back = {"color": WALL, "lw": 1.2, "zorder": 1}
    outline(floor, **back)
    outline([(0, deep, 0), (0, deep, high)], **back)
    cells = {}
    for number, (x, y, z, w, d, h) in enumerate(placed):
        for cell in np.ndindex(w, d, h):
            cells[(x + cell[0], y + cell[1], z + cell[2])] = number
    # The viewer looks from (+x, -y, +z): near cells have a large x, a small y and a large z.
    order = sorted(cells, key=lambda c: (c[2], c[0] - c[1]))
    faces, shades, edges = [], [], []
    for x, y, z in order:
        number = cells[x, y, z]
        _, _, _, w, d, h = placed[number]
        base = np.array(to_rgb(colours[min(w, d), max(w, d), h]))
        sides = (
            ((0, 0, 1), [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], 1.0),
            ((1, 0, 0), [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)], 0.7),
            ((0, -1, 0), [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)], 0.85),
        )
        for normal, corners, light in sides:
            beyond = (x + normal[0], y + normal[1], z + normal[2])
            if beyond in cells:
                continue  # hidden behind the next cell
            shade = (*np.clip(base * light, 0, 1), 1.0)
            faces.append([project(x + a, y + b, z + c) for a, b, c in corners])
            shades.append(shade)
            # Lines only where an item ends, so that each item reads as one box.
            for (a, b, c), (e, f, g) in zip(corners, corners[1:] + corners[:1], strict=True):
                middle = np.array([a + e, b + f, c + g]) / 2 - 0.5
                step = np.sign(middle - np.array(normal) / 2).astype(int)
                if cells.get((x + step[0], y + step[1], z + step[2])) != number:
                    edges.append((len(faces) - 1, [project(x + a, y + b, z + c), project(x + e, y + f, z + g)]))
    line = 0.8 if wide * deep <= 150 else 0.35
    # Edges are thin polygons among the faces, so that nearer faces hide them too.
    drawn, fills, strokes, widths, start = [], [], [], [], 0
    for index, face in enumerate(faces):
        drawn.append(face), fills.append(shades[index]), strokes.append(shades[index]), widths.append(0.2)
        while start < len(edges) and edges[start][0] == index:
            drawn.append(edges[start][1]), fills.append("none"), strokes.append(INK), widths.append(line)
            start += 1
    axes.add_collection(
        PolyCollection(drawn, facecolors=fills, edgecolors=strokes, linewidths=widths, closed=False, zorder=2)
    )
    front = {"color": WALL, "lw": 1.2, "zorder": 3}
    outline([(0, 0, high), (wide, 0, high), (wide, deep, high), (0, deep, high), (0, 0, high)], **front)
    for x, y in ((0, 0), (wide, 0), (wide, deep)):
        outline([(x, y, 0), (x, y, high)], **front)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    if len(colours) <= len(COLOURS):
        patches = [Patch(facecolor=c, edgecolor=INK, label="x".join(map(str, kind))) for kind, c in colours.items()]
        axes.legend(handles=patches, title="item (cells)", loc="upper left", frameon=False)


def _draw_plan(axes, heights, limit) -> None:
    """The height map from above."""
    image = axes.imshow(heights.T, origin="lower", cmap="viridis", vmin=0, vmax=limit)
    if max(heights.shape) <= 12:
        for (x, y), height in np.ndenumerate(heights):
            dark = height < 0.6 * limit
            axes.text(x, y, str(int(height)), ha="center", va="center", color="white" if dark else INK)
    axes.set_xlabel("x (cells)")
    axes.set_ylabel("y (cells)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.get_major_locator().set_params(integer=True)
    axes.set_title("height map from above")
    axes.figure.colorbar(image, ax=axes, label="height (cells)", shrink=0.8)


def evaluation_table(result: dict) -> str:
    """The figures of an ``evaluation.json`` as a Markdown table."""
    env, occupancy, latency = result["env"], result["occupancy"], result["latency_ms"]
    low, high = occupancy["ci95"]
    failures = ", ".join(f"{name} {count}" for name, count in result["failures"].items())
    rows = [
        ("planner", result["planner"]),
        ("tote, rotations", f"{'x'.join(map(str, env['tote_size']))}, R={env['rotations']}"),
        ("episodes", f"{result['episodes']} of the {result['stream']} stream, seed {result['seed']}"),
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
    if "candidates" in result:
        words = {True: "yes", False: "no"}
        masks = f"in training {words[result['mask_in_training']]}, at decision {words[result['mask_at_decision']]}"
        rows.append(("mask; candidates K", f"{masks}; {result['candidates']}"))
    width = max(len(name) for name, _ in rows)
    values = max(len(value) for _, value in rows)
    lines = [f"| {name:<{width}} | {value:<{values}} |" for name, value in rows]
    return "\n".join([lines[0], f"|{'-' * (width + 2)}|{'-' * (values + 2)}|", *lines[1:]]) + "\n"
