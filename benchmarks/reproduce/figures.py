"""The figures of the comparison, for papers: PNG and SVG."""

from pathlib import Path

import numpy as np

#: Methods: label, colour (Okabe and Ito's, told apart by colour-blind readers), marker. Ours are filled, filled out.
METHODS = {
    "fcn_grasp": ("fcn_grasp, mask", "#0072b2", "o"),
    "fcn_grasp_unmasked": ("fcn_grasp, no mask", "#56b4e9", "o"),
    "fcn4d": ("fcn4d (the paper's)", "#d55e00", "s"),
    "fcn4d_masked": ("fcn4d, mask", "#e69f00", "s"),
    "fcn4d_warm": ("fcn4d, mask, warm start", "#8c5a00", "s"),
    "fcn4d_noclip": ("4D FCN, no clipping", "#cc79a7", "^"),
    "fcn4d_none": ("fcn4d, no curriculum", "#e69f00", "s"),
    "fcn4d_paper": ("fcn4d, curriculum paper", "#009e73", "s"),
    "typical": ("typical", "#009e73", "v"),
    "individual_rl": ("individual, RL", "#e69f00", "D"),
    "individual_heuristic": ("individual, heuristic", "#cc79a7", "D"),
    "individual_heuristic_cells": ("individual, heuristic, every cell", "#7a3b69", "d"),
    "joint_dbl": ("joint DBL", "#000000", "P"),
    "mcts": ("MCTS", "#009e73", "X"),
    "mcts_outcomes": ("MCTS over outcomes", "#44aa99", "X"),
    "random": ("random, feasible", "#8c8c8c", "x"),
    "uniform": ("uniform, all actions", "#b0b0b0", "+"),
    "lookahead": ("lookahead", "#d55e00", "o"),
    "py3dbp": ("py3dbp", "#d55e00", "s"),
    "rectpack": ("rectpack", "#009e73", "s"),
}

TOTES = ("6x6x5", "6x6x10", "10x10x5", "10x10x10", "30x30x5", "30x30x10")


def trained_for(method: str) -> tuple[str, str]:
    """A cell's method, and what it was trained for where its name ends with that: ``("fcn4d", "tall")``."""
    ends = (end for end in ("small", "mixed", "tall", "deep_bin") if method.endswith(f"_{end}"))
    end = next(ends, "")
    return method.removesuffix(f"_{end}"), end


def label(method: str) -> str:
    """What to call a method of a cell."""
    method, _ = trained_for(method)
    return METHODS.get(method, (method,))[0]


def style(method: str) -> dict:
    """How a method is drawn in every figure."""
    name, colour, marker = METHODS[trained_for(method)[0]]
    return {"label": name, "color": colour, "marker": marker}


def canvas(width: float, height: float, rows: int = 1, columns: int = 1, **axes):
    """A figure and its axes, flat."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    found = np.atleast_1d(figure.subplots(rows, columns, **axes)).ravel()
    for part in found:
        part.grid(alpha=0.25)
        part.spines[["top", "right"]].set_visible(False)
    return figure, found


def save(figure, path: Path) -> bool:
    """Write both formats."""
    import matplotlib

    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context({"svg.hashsalt": path.name}):  # the same figures, the same file
        figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})
    figure.savefig(path.with_suffix(".png"), dpi=150)
    return True


def legend(figure, axes, **where) -> None:
    """One legend for all axes, each method once."""
    handles = {}
    for part in axes:
        handles |= dict(reversed(pair) for pair in zip(*part.get_legend_handles_labels(), strict=True))
    order = [METHODS[method][0] for method in METHODS if METHODS[method][0] in handles]
    order = list(dict.fromkeys([*order, *handles]))
    figure.legend(
        [handles[name] for name in order], order, frameon=False, **({"loc": "outside lower center", "ncols": 5} | where)
    )


def points(axes, xs, found, method, line="-", **more) -> None:
    """Means with their intervals; hollow where there are few episodes."""
    pairs = [(x, result) for x, result in zip(xs, found, strict=True) if result and "occupancy" in result]
    if not pairs:
        return
    xs = [x for x, _ in pairs]
    mean = np.array([result["occupancy"]["mean"] for _, result in pairs])
    low, high = np.array([result["occupancy"]["ci95"] for _, result in pairs]).T
    bars = [np.maximum(mean - np.maximum(low, 0), 0), np.maximum(np.minimum(high, 1) - mean, 0)]
    look = style(method) | more
    axes.errorbar(xs, mean, yerr=bars, ls=line, lw=1.3, ms=5, capsize=2.5, elinewidth=1, **look)
    few = [i for i, (_, result) in enumerate(pairs) if result.get("episodes", 100) < 20]
    if few:
        hollow = {"marker": look["marker"], "color": "white", "markeredgecolor": look["color"]}
        axes.plot([xs[i] for i in few], mean[few], ls="", ms=5, zorder=5, **hollow)


def candidates(results, path) -> bool:
    figure, (axes,) = canvas(6, 4)
    counts = (1, 2, 3, 5, 10, 20, 50)
    for method in ("fcn_grasp_unmasked", "fcn_grasp", "fcn4d"):
        points(axes, counts, [results.get(f"{method}-R3-s0-6x6x5-K{k}") for k in counts], method)
    if everything := results.get("fcn_grasp-R3-s0-6x6x5-Kall"):
        mean = everything["occupancy"]["mean"]
        axes.axhline(mean, color=METHODS["fcn_grasp"][1], ls=":", lw=1)
        axes.text(50, mean, "fcn_grasp, best feasible", ha="right", va="bottom", fontsize=8)
    if not axes.lines:
        return False
    axes.set_xscale("log")
    axes.set_xticks(counts, counts)
    axes.minorticks_off()
    axes.set_xlabel("K, most probable actions that are tried")
    axes.set_ylabel("occupancy at 6x6x5, R=3")
    axes.set_ylim(0, 1.05)
    legend(figure, [axes], ncols=3)
    return save(figure, path)


def individual(results, path) -> bool:
    figure, axes = canvas(9, 6, 2, 3, sharex=True, sharey=True)
    rotations = (1, 2, 3, 4)
    for part, tote in zip(axes, TOTES, strict=True):
        for method, name in (
            ("fcn_grasp", "fcn_grasp-R{}-s0-{}-Kall"),
            ("fcn_grasp_unmasked", "fcn_grasp_unmasked-R{}-s0-{}-K10"),
            ("fcn4d", "fcn4d-R{}-s0-{}-K10"),
            ("individual_rl", "individual_rl-R{}-s0-{}-K10"),
            ("individual_heuristic", "individual_heuristic-R{}-{}"),
            ("individual_heuristic_cells", "individual_heuristic_cells-R{}-{}"),
            ("joint_dbl", "joint_dbl-R{}-{}"),
            ("random", "random-R{}-{}"),
        ):
            points(part, rotations, [results.get(name.format(r, tote)) for r in rotations], method)
        part.set_title(tote, fontsize=10)
        part.set_xticks(rotations)
        part.set_xlim(0.7, 4.3)
        part.set_ylim(0, 1.05)
    if not any(part.lines for part in axes):
        return False
    for part in axes[3:]:
        part.set_xlabel("R, rotations to choose from")
    for part in axes[::3]:
        part.set_ylabel("occupancy")
    legend(figure, axes, ncols=4)
    return save(figure, path)


def rl_methods(results, path) -> bool:
    figure, (axes,) = canvas(9, 4.5)
    rows = [
        ("fcn_grasp", "fcn_grasp-R4-s0-{}-Kall", {}),
        ("fcn_grasp_unmasked", "fcn_grasp_unmasked-R4-s0-{}-K1", {}),
        ("fcn4d_warm", "fcn4d_warm-R4-s0-{}-Kall", {}),
        ("fcn4d", "fcn4d-R4-s0-{}-K1", {}),
        ("fcn4d_noclip", "fcn4d_noclip-R4-s0-{}-K1", {}),
        ("typical", "typical-R4-s0-{}-K1", {}),
        ("mcts_outcomes", "mcts-R4-{}-mask_true", {}),
        ("mcts", "mcts-R4-{}-mask_false", {}),
        ("random", "random-R4-{}", {}),
        ("uniform", "uniform-R4-{}", {}),
    ]
    for number, (method, name, more) in enumerate(rows):
        xs = np.arange(len(TOTES)) + 0.08 * (number - len(rows) / 2 + 0.5)
        points(axes, xs, [results.get(name.format(tote)) for tote in TOTES], method, line="", **more)
    if not axes.lines:
        return False
    axes.set_xticks(range(len(TOTES)), TOTES)
    axes.set_xlim(-0.5, len(TOTES) - 0.5)
    axes.set_ylabel("occupancy, R=4")
    axes.set_ylim(0, 1.05)
    axes.grid(axis="x", alpha=0)
    for edge in range(1, len(TOTES)):
        axes.axvline(edge - 0.5, color="#dddddd", lw=0.8)
    legend(figure, [axes], ncols=4)
    return save(figure, path)


def band(axes, results, names, method, **more) -> None:
    """Validation occupancy over frames: the mean over seeds, and their range."""
    curves = [results[name]["curve"] for name in names if name in results and "curve" in results[name]]
    curves = [curve for curve in curves if curve["validation_frames"]]
    if not curves:
        return
    length = min(len(curve["validation_frames"]) for curve in curves)
    frames = np.array(curves[0]["validation_frames"][:length])
    values = np.array([curve["validation_occupancy"][:length] for curve in curves])
    look = style(method) | more
    look["label"] += f" ({len(curves)} seed{'s' * (len(curves) > 1)})"
    axes.plot(frames, values.mean(0), lw=1.3, ms=3, **look)
    axes.fill_between(frames, values.min(0), values.max(0), color=look["color"], alpha=0.2, lw=0)


def learning_curves(results, path) -> bool:
    from matplotlib.ticker import EngFormatter

    figure, axes = canvas(10, 9, 3, 2, sharey=True)
    seeds = (0, 1, 2)
    for method, name in (
        ("fcn_grasp", "fcn_grasp-R4-s{}"), ("fcn_grasp_unmasked", "fcn_grasp_unmasked-R4-s{}"),
        ("fcn4d", "fcn4d-R4-s{}"), ("typical", "typical-6x6x5-s{}"), ("individual_rl", "individual_rl-R4-s{}"),
    ):  # fmt: skip
        band(axes[0], results, [name.format(seed) for seed in seeds], method)
    panels = [
        (1, "fcn4d: curriculum", {"fcn4d": "adaptive", "fcn4d_paper": "paper, 60,000 a level", "fcn4d_none": "none"}),
        (2, "fcn4d: masking", {"fcn4d": "no mask", "fcn4d_masked": "mask", "fcn4d_warm": "mask, warm start"}),
    ]
    for number, title, rows in panels:
        for method, text in rows.items():
            band(axes[number], results, [f"{method}-R4-s{seed}" for seed in seeds], method, label=text)
        axes[number].set_title(title, fontsize=10)
    band(axes[3], results, [f"fcn4d-R4-s{seed}" for seed in seeds], "fcn4d", label="depth clipped (eq. 4)")
    band(axes[3], results, [f"fcn4d_noclip-6x6x5-s{seed}" for seed in seeds], "fcn4d_noclip", label="not clipped")
    axes[3].set_title("fcn4d: clipping (at 5, which takes nothing here)", fontsize=10)
    band(axes[4], results, [f"fcn_grasp-R4-s{seed}" for seed in seeds], "fcn_grasp", label="adaptive")
    for method, text, colour in (
        ("fcn_grasp_paper", "paper, 60,000 a level", "#009e73"),
        ("fcn_grasp_mixture", "mixture", "#cc79a7"),
        ("fcn_grasp_none", "none", "#e69f00"),
    ):
        names = [f"{method}-R4-s{seed}" for seed in seeds]
        band(axes[4], results, names, "fcn_grasp", label=text, color=colour)
    axes[4].set_title("fcn_grasp: curriculum", fontsize=10)
    band(axes[5], results, [f"fcn_grasp-R4-s{seed}" for seed in seeds], "fcn_grasp", label="mask")
    band(axes[5], results, ["fcn_grasp_unmasked-R4-s0"], "fcn_grasp_unmasked", label="no mask")
    axes[5].set_title("fcn_grasp: masking", fontsize=10)
    axes[0].set_title("networks", fontsize=10)
    if not any(part.lines for part in axes):
        return False
    for part in axes:
        part.set_ylim(0, 1.05)
        part.set_xlim(0)
        part.xaxis.set_major_formatter(EngFormatter(sep=""))
        if part.lines:
            part.legend(fontsize=8, frameon=False, loc="lower right")
        else:
            part.set_xticks([])
            part.text(0.5, 0.5, "not computed yet", transform=part.transAxes, ha="center", color="#8c8c8c")
    for part in axes[4:]:
        part.set_xlabel("frames")
    figure.supylabel("occupancy at 6x6x5, R=4, validation stream (band: least and greatest seed)")
    return save(figure, path)


#: Dynamic programming over every tote state, see tests/dynamic_programming.py.
OPTIMA = {
    ("3x3x1", 1): 0.7864, ("3x3x1", 4): 0.8502, ("4x3x1", 1): 0.8478,
    ("4x3x1", 4): 0.9241, ("4x4x1", 1): 0.9208, ("4x4x1", 4): 0.9456,
}  # fmt: skip


def optimum(results, path) -> bool:
    figure, (axes,) = canvas(8, 4.2)
    methods = ("fcn_grasp", "joint_dbl", "individual_heuristic", "mcts", "random")
    for number, method in enumerate(methods):
        found = [results.get(f"{method}_small-{tote}-R{r}") for tote, r in OPTIMA]
        xs = np.arange(len(OPTIMA)) + 0.12 * (number - 2)
        points(axes, xs, found, "mcts_outcomes" if method == "mcts" else method, line="")
    if not axes.lines:
        return False
    for x, value in enumerate(OPTIMA.values()):
        axes.plot([x - 0.4, x + 0.4], [value, value], color="#d55e00", lw=1.5, label="exact optimum" if not x else None)
    axes.set_xticks(range(len(OPTIMA)), [f"{tote}\nR={r}" for tote, r in OPTIMA])
    axes.set_ylabel("occupancy")
    legend(figure, [axes], ncols=3)
    return save(figure, path)


def latency(results, path) -> bool:
    figure, (axes,) = canvas(6.5, 4.2)
    series = [
        ("fcn_grasp", ["fcn_grasp_mixed-6x6x5"], {}),
        ("lookahead", [f"lookahead-6x6x5-{n}samples" for n in (8, 32, 128)], {}),
        ("mcts_outcomes", [f"mcts_mixed-6x6x5-{n}sim" for n in (100, 500, 2000, 5000)], {}),
        ("joint_dbl", ["joint_dbl-mixed-6x6x5"], {}),
    ]
    for method, names, more in series:
        found = [results[name] for name in names if "occupancy" in results.get(name, {})]
        points(axes, [result["latency_ms"]["p50"] for result in found], found, method, **more)
    if not axes.lines:
        return False
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("milliseconds a decision (median, one core)")
    axes.set_ylabel("occupancy, 27 kinds of items, 6x6x5, R=4")
    legend(figure, [axes], ncols=4)
    return save(figure, path)


PRESETS = {
    "items=mixed, 6x6x5": "mixed-6x6x5", "items=mixed, 8x8x8": "mixed-8x8x8",
    "items=tall, 6x6x5": "tall-6x6x5", "items=tall, 8x8x8": "tall-8x8x8", "env=deep_bin, 6x6x5": "deep_bin-6x6x5",
}  # fmt: skip


def presets(results, path) -> bool:
    figure, (axes,) = canvas(9, 4.5)
    rows = [
        ("fcn_grasp", lambda kind, tote: f"fcn_grasp_{kind}-{tote}"),
        ("lookahead", lambda kind, tote: f"lookahead_{kind}-{tote}"),
        ("joint_dbl", lambda kind, tote: f"joint_dbl-{kind}-{tote}"),
        ("individual_heuristic_cells", lambda kind, tote: f"individual_heuristic_cells-{kind}-{tote}"),
        ("individual_heuristic", lambda kind, tote: f"individual_heuristic-{kind}-{tote}"),
        ("individual_rl", lambda kind, tote: f"individual_rl_{kind}-{tote}-K10"),
        ("fcn4d", lambda kind, tote: f"fcn4d_{kind}-{tote}-K10"),
        ("typical", lambda kind, tote: f"typical_{kind}-{tote}-K10"),
        ("mcts_outcomes", lambda kind, tote: f"mcts-{kind}-{tote}-mask_true"),
        ("random", lambda kind, tote: f"random-{kind}-{tote}"),
    ]
    for number, (method, name) in enumerate(rows):
        found = [results.get(name(*preset.split("-"))) for preset in PRESETS.values()]
        points(axes, np.arange(len(PRESETS)) + 0.08 * (number - 4.5), found, method, line="")
    if not axes.lines:
        return False
    axes.set_xticks(range(len(PRESETS)), PRESETS)
    axes.set_ylabel("occupancy, R=4")
    axes.set_ylim(0, 1.05)
    legend(figure, [axes], ncols=4)
    return save(figure, path)


OUTCOMES = {
    "executed": ("executed", "#0072b2"),
    "effector_collides": ("out of the effector's reach", "#d55e00"),
    "rests_elsewhere": ("rests elsewhere", "#e69f00"),
    "unstable": ("unstable", "#cc79a7"),
}


def placement_only(results, path) -> bool:
    rows = {name: result for name, result in results.items() if result.get("kind") == "placement_only"}
    rows = {name: result for name, result in rows.items() if "placements" in result}
    place = {f"-{tote}": number for number, tote in enumerate(TOTES)}
    rows = dict(sorted(rows.items(), key=lambda row: (*row[0].split("-")[:2], place[row[0][row[0].rindex("-") :]])))
    if not rows:
        return False
    figure, (left, right) = canvas(10, 0.32 * len(rows) + 1.8, 1, 2, sharey=True)
    names = [name.replace("-", " ") for name in rows]
    start = np.zeros(len(rows))
    for key, (text, colour) in OUTCOMES.items():
        share = np.array([r["placements"].get(key, 0) / sum(r["placements"].values()) for r in rows.values()])
        left.barh(names, share, left=start, color=colour, label=text)
        start += share
    left.set_xlim(0, 1)
    left.set_xlabel("share of the plan's placements")
    left.invert_yaxis()
    for key, text, marker, colour in (
        ("occupancy_planned", "planned", "o", "#8c8c8c"),
        ("occupancy", "when the first placement fails", "s", "#0072b2"),
    ):
        mean = np.array([r[key]["mean"] for r in rows.values()])
        low, high = np.array([r[key]["ci95"] for r in rows.values()]).T
        bars = [mean - low, high - mean]
        right.errorbar(mean, names, xerr=bars, ls="", marker=marker, ms=5, capsize=2, color=colour, label=text)
    right.set_xlabel("occupancy")
    right.set_xlim(0, 1.05)
    legend(figure, [left, right], ncols=3)
    return save(figure, path)


def placement_table(cells, results) -> list[str]:
    """The figures behind :func:`placement_only`."""
    lines = [
        "| packer | cell | placements that can be executed | whole plans | planned | until the first that cannot |",
        "|---|---|---|---|---|---|",
    ]
    for cell in cells:
        result = results.get(cell.name)
        labels = " ".join(str(value) if axis == "tote" else f"{axis}{value}" for axis, value in cell.axes)
        if not result or "placements" not in result:
            lines.append(f"| {cell.method} | {labels} | {'not yet' if not result else result['attempted']} | | | |")
            continue

        def show(key, result=result):
            return "{:.3f} ({:.3f} to {:.3f})".format(result[key]["mean"], *result[key]["ci95"])

        whole = f"{result['plans_executed_whole']} of {result['episodes']}"
        lines.append(
            f"| {cell.method} | {labels} | {show('share_executed')} | {whole} | {show('occupancy_planned')} | "
            f"{show('occupancy')} |"
        )
    return lines


#: By the name of the yaml file: title, and what draws it; it returns False where nothing has been computed yet.
FIGURES = {
    "candidates": ("K, the number of candidates", candidates),
    "individual": ("Joint against individual planning", individual),
    "learning_curves": ("Learning curves", learning_curves),
    "rl_methods": ("Joint planning against the RL methods and tree search", rl_methods),
    "optimum": ("Against the exact optimum", optimum),
    "latency": ("What a search buys for its time", latency),
    "presets": ("Where a tote is far from full", presets),
    "placement_only": ("What a placement-only plan is worth", placement_only),
}
