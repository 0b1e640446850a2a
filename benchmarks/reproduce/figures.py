"""The figures of the comparison, for papers: PNG and SVG."""

from pathlib import Path

import numpy as np
import torch

from pickplace.evaluation.evaluate import confidence95

#: Methods: label, colour (Okabe and Ito's, told apart by colour-blind readers), marker. Ours are filled, filled out.
METHODS = {
    "fcn_grasp": ("fcn_grasp, mask", "#0072b2", "o"),
    "fcn_grasp_unmasked": ("fcn_grasp, no mask", "#56b4e9", "o"),
    "fcn4d": ("fcn4d (the paper's)", "#d55e00", "s"),
    "fcn4d_warm": ("fcn4d, mask, warm start", "#8c5a00", "s"),
    "fcn4d_noclip": ("4D FCN, no clipping", "#cc79a7", "^"),
    "fcn_grasp_paper": ("fcn_grasp, curriculum paper", "#999933", "o"),
    "fcn_grasp_mixture": ("fcn_grasp, curriculum mixture", "#aa4499", "o"),
    "fcn_grasp_none": ("fcn_grasp, no curriculum", "#332288", "o"),
    "fcn_grasp_high": ("fcn_grasp, trained at 6x6x10", "#0072b2", "o"),
    "fcn_grasp_noclip": ("fcn_grasp, no clipping", "#cc79a7", "^"),
    "typical": ("typical", "#7f7f00", "v"),
    "individual_grasp": ("individual, fcn_grasp's network, mask", "#004d40", "D"),
    "individual_grasp_unmasked": ("individual, fcn_grasp's network, no mask", "#44aa99", "D"),
    "individual_rl": ("individual, RL (the paper's)", "#e69f00", "D"),
    "individual_heuristic": ("individual, heuristic", "#b04fa0", "D"),
    "individual_heuristic_cells": ("individual, heuristic, every cell", "#7a3b69", "d"),
    "joint_dbl": ("joint DBL", "#000000", "P"),
    "mcts": ("MCTS", "#009e73", "X"),
    "mcts_outcomes": ("MCTS, mask", "#005f46", "X"),
    "random": ("random, feasible", "#8c8c8c", "x"),
    "uniform": ("uniform, all actions", "#b0b0b0", "+"),
    "lookahead": ("lookahead", "#882255", "p"),
}

FEW = 20  # episodes below which a figure only indicates
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
    known = [text for text, *_ in METHODS.values()]
    order = sorted(handles, key=lambda name: next((i for i, text in enumerate(known) if name.startswith(text)), 99))
    figure.legend(
        [handles[name] for name in order], order, frameon=False, **({"loc": "outside lower center", "ncols": 5} | where)
    )


def pooled(results, name: str) -> dict | None:
    """A cell, or with ``s*`` in its name all its seeds as one result; None where there is none.

    The mean is that over seeds; the interval is that over episodes, of each the mean over seeds, widened to the range
    of the seeds. ``short`` says that a policy's training had less than half of its frames.
    """
    names = [name.replace("s*", f"s{seed}") for seed in range(3)] if "s*" in name else [name]
    there = [results[name] for name in names if name in results]
    found = [result for result in there if "occupancy" in result]
    if not found:
        return there[0] if there else None
    trained = [results.get(result.get("training"), {}) for result in found]
    means = np.array([result["occupancy"]["mean"] for result in found])
    low, high = found[0]["occupancy"]["ci95"]
    if len(found) > 1:
        length = min(len(result["occupancy"]["per_episode"]) for result in found)
        episodes = np.mean([result["occupancy"]["per_episode"][:length] for result in found], 0)
        low, high = confidence95(torch.tensor(episodes))
    return {
        **found[0],
        "occupancy": {"mean": means.mean(), "ci95": (min(low, *means), max(high, *means))},
        "episodes": min(result["episodes"] for result in found),
        "short": any(part.get("frames", 1) < 0.5 * part.get("frames_asked", 1) for part in trained),
    }


def points(axes, xs, results, names, method, line="-", **more) -> None:
    """Cells' means with their intervals: hollow with few episodes, pale with a short training, an "a" if attempted."""
    look, found = style(method) | more, [pooled(results, name) for name in names]
    for x, result in zip(xs, found, strict=True):
        if result and "attempted" in result:
            axes.text(x, 0.0, "a", color=look["color"], fontsize=8, ha="center", va="center", clip_on=True)
    pairs = [(x, result) for x, result in zip(xs, found, strict=True) if result and "occupancy" in result]
    if not pairs:
        return
    xs, mean = [x for x, _ in pairs], np.array([result["occupancy"]["mean"] for _, result in pairs])
    axes.plot(xs, mean, ls=line, lw=1.3, color=look["color"], alpha=0.6)
    axes.errorbar([], [], ls=line, lw=1.3, ms=5, **look)  # for the legend: not hollow, not pale
    for x, result in pairs:
        value, (low, high) = result["occupancy"]["mean"], result["occupancy"]["ci95"]
        bars = [[value - low], [high - value]]
        axes.errorbar(
            [x], [value], yerr=bars, ls="", ms=5, capsize=2.5, elinewidth=1, color=look["color"], marker=look["marker"],
            markerfacecolor="white" if result["episodes"] < FEW else look["color"],
            alpha=0.35 if result["short"] else 1.0,
        )  # fmt: skip


def widened(axes, top: float = 0.999) -> None:
    """An axis of occupancies that widens towards 1, where good methods differ: logarithmic in what is left empty."""
    axes.set_yscale(
        "function",
        functions=(
            lambda share: -np.log10(np.maximum(1 - share, 1 - top)),
            lambda height: 1 - 10.0**-height,
        ),
    )
    axes.set_ylim(0, top)
    ticks = [tick for tick in (0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9995, 0.9998) if tick < top]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def candidates(results, path) -> bool:
    figure, (axes,) = canvas(6, 4)
    counts = (1, 2, 3, 5, 10, 20, 50)
    for method in ("fcn_grasp_unmasked", "fcn_grasp", "fcn4d"):
        points(axes, counts, results, [f"{method}-R3-s*-6x6x5-K{k}" for k in counts], method)
    if (everything := pooled(results, "fcn_grasp-R3-s*-6x6x5-Kall")) and "occupancy" in everything:
        mean = everything["occupancy"]["mean"]
        axes.axhline(mean, color=METHODS["fcn_grasp"][1], ls=":", lw=1)
        axes.text(1, mean + 0.005, "fcn_grasp with a mask, best of all feasible", va="bottom", fontsize=8)
    if not axes.lines:
        return False
    axes.set_xscale("log")
    axes.set_xticks(counts, counts)
    axes.minorticks_off()
    axes.set_xlabel("K, most probable actions that are tried")
    axes.set_ylabel("occupancy at 6x6x5, R=3")
    axes.set_ylim(-0.02, 1.05)
    legend(figure, [axes], ncols=3)
    return save(figure, path)


def individual(results, path) -> bool:
    figure, axes = canvas(10, 7.5, 2, 3, sharex=True, sharey=True)
    rotations = (1, 2, 3, 4)
    for part, tote in zip(axes, TOTES, strict=True):
        rows = (
            ("fcn_grasp", "fcn_grasp-R{}-s*-{}-Kall"),
            ("fcn_grasp_unmasked", "fcn_grasp_unmasked-R{}-s*-{}-K10"),
            ("fcn4d", "fcn4d-R{}-s*-{}-K10"),
            ("individual_grasp", "individual_grasp-R{}-s*-{}-Kall"),
            ("individual_grasp_unmasked", "individual_grasp_unmasked-R{}-s*-{}-K10"),
            ("individual_rl", "individual_rl-R{}-s*-{}-K10"),
            ("individual_heuristic", "individual_heuristic-R{}-{}"),
            ("individual_heuristic_cells", "individual_heuristic_cells-R{}-{}"),
            ("joint_dbl", "joint_dbl-R{}-{}"),
            ("random", "random-R{}-{}"),
        )
        for number, (method, name) in enumerate(rows):
            xs = [r + 0.06 * (number - len(rows) / 2 + 0.5) for r in rotations]
            points(part, xs, results, [name.format(r, tote) for r in rotations], method)
        part.set_title(tote, fontsize=10)
        part.set_xticks(rotations, rotations)
        part.set_xlim(0.6, 4.4)
        widened(part, top=0.9999)
    if not any(part.lines for part in axes):
        return False
    for part in axes[3:]:
        part.set_xlabel("R, rotations to choose from")
    for part in axes[::3]:
        part.set_ylabel("occupancy (the axis widens towards 1)")
    legend(figure, axes, ncols=4)
    return save(figure, path)


def rl_methods(results, path) -> bool:
    figure, (top, axes) = canvas(9, 6, 2, 1, sharex=True, height_ratios=(2, 3))
    rows = [
        ("fcn_grasp", "fcn_grasp-R4-s*-{}-Kall", {"label": "fcn_grasp, mask, K=all"}),
        ("fcn4d_warm", "fcn4d_warm-R4-s*-{}-Kall", {"label": "fcn4d, mask, warm start, K=all"}),
        ("fcn_grasp_unmasked", "fcn_grasp_unmasked-R4-s*-{}-K1", {"label": "fcn_grasp, no mask, K=1"}),
        ("fcn4d", "fcn4d-R4-s*-{}-K1", {"label": "fcn4d (the paper's), K=1"}),
        ("fcn4d_noclip", "fcn4d_noclip-R4-s*-{}-K1", {"label": "4D FCN, no clipping, K=1"}),
        ("typical", "typical-R4-s*-{}-K1", {"label": "typical, K=1"}),
        ("individual_rl", "individual_rl-R4-s*-{}-K1", {"label": "individual, RL (the paper's), K=1"}),
        ("mcts_outcomes", "mcts-R4-{}-mask_true", {}),
        ("mcts", "mcts-R4-{}-mask_false", {"label": "MCTS, no mask"}),
        ("random", "random-R4-{}", {}),
        ("uniform", "uniform-R4-{}", {}),
    ]
    for number, (method, name, more) in enumerate(rows):
        xs = np.arange(len(TOTES)) + 0.08 * (number - len(rows) / 2 + 0.5)
        for part in (top, axes):
            points(part, xs, results, [name.format(tote) for tote in TOTES], method, line="", **more)
    if not axes.lines:
        return False
    axes.set_xticks(range(len(TOTES)), TOTES)
    axes.set_xlim(-0.5, len(TOTES) - 0.5)
    axes.set_ylim(-0.03, 1.05)
    widened(top, top=0.9999)
    top.set_ylim(0.8, 0.9999)
    top.set_title("from 0.8 up; the axis widens towards 1", fontsize=10)
    figure.supylabel("occupancy, R=4")
    for part in (top, axes):
        part.grid(axis="x", alpha=0)
        for edge in range(1, len(TOTES)):
            part.axvline(edge - 0.5, color="#dddddd", lw=0.8)
    legend(figure, [axes], ncols=3)
    return save(figure, path)


def band(axes, results, names, method, **more) -> None:
    """Validation occupancy over frames: the mean over seeds, and their range; thin, seeds that got further."""
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
    for curve in curves:
        further = slice(length - 1, None)
        axes.plot(
            curve["validation_frames"][further], curve["validation_occupancy"][further],
            lw=0.8, alpha=0.6, color=look["color"],
        )  # fmt: skip


def learning_curves(results, path) -> bool:
    from matplotlib.ticker import EngFormatter

    figure, axes = canvas(10, 9, 3, 2)
    # Of each line the training, without its seed, the method as which it is drawn, and its text.
    panels = {
        "networks": [
            ("fcn_grasp-R4", "fcn_grasp", "fcn_grasp, mask, K=all"),
            ("fcn_grasp_unmasked-R4", "fcn_grasp_unmasked", "fcn_grasp, no mask, K=1"),
            ("fcn4d-R4", "fcn4d", "fcn4d (the paper's), K=10"),
            ("typical-6x6x5", "typical", "typical, K=10"),
            ("individual_rl-R4", "individual_rl", "individual, RL (the paper's), K=10"),
        ],
        "fcn_grasp's network: the pick": [
            ("fcn_grasp-R4", "fcn_grasp", "decided with the place"),
            ("individual_grasp-R4", "individual_grasp", "left to the heuristic"),
        ],
        "fcn4d: with a mask and a warm start, and with neither": [
            ("fcn4d-R4", "fcn4d", "neither, K=10"),
            ("fcn4d_warm-R4", "fcn4d_warm", "both, no curriculum, K=all"),
        ],
        "fcn_grasp: clipping, trained and validated at 6x6x10": [
            ("fcn_grasp_high-R4", "fcn_grasp_high", "depth clipped (eq. 4)"),
            ("fcn_grasp_noclip-R4", "fcn_grasp_noclip", "not clipped"),
        ],
        "fcn_grasp: curriculum": [
            ("fcn_grasp-R4", "fcn_grasp", "adaptive"),
            ("fcn_grasp_paper-R4", "fcn_grasp_paper", "paper, 60,000 a level"),
            ("fcn_grasp_mixture-R4", "fcn_grasp_mixture", "mixture"),
            ("fcn_grasp_none-R4", "fcn_grasp_none", "none"),
        ],
        "fcn_grasp: masking": [
            ("fcn_grasp-R4", "fcn_grasp", "mask, K=all"),
            ("fcn_grasp_unmasked-R4", "fcn_grasp_unmasked", "no mask, K=1"),
        ],
    }
    for part, (title, rows) in zip(axes, panels.items(), strict=True):
        part.set_title(title, fontsize=10)
        for training, method, text in rows:
            band(part, results, [f"{training}-s{seed}" for seed in range(3)], method, label=text)
    if not any(part.lines for part in axes):
        return False
    for part in axes:
        if part.get_title().startswith("fcn_grasp"):
            widened(part)
        else:
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
    figure.supylabel("occupancy, R=4, validation stream (band: least and greatest seed)")
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
        seeds = "-s*" if method == "fcn_grasp" else ""
        names = [f"{method}_small-{tote}-R{r}{seeds}" for tote, r in OPTIMA]
        xs = np.arange(len(OPTIMA)) + 0.12 * (number - 2)
        points(axes, xs, results, names, "mcts_outcomes" if method == "mcts" else method, line="")
    if not axes.lines:
        return False
    for x, value in enumerate(OPTIMA.values()):
        axes.plot([x - 0.4, x + 0.4], [value, value], color="#000000", lw=1.5, label="exact optimum" if not x else None)
    axes.set_xticks(range(len(OPTIMA)), [f"{tote}\nR={r}" for tote, r in OPTIMA])
    axes.set_ylabel("occupancy")
    legend(figure, [axes], ncols=3)
    return save(figure, path)


def milliseconds(result) -> float:
    """Mean CPU time of a decision; where only medians were measured, that, or that by the clock."""
    found = result["latency_ms"]
    return next(found[key] for key in ("cpu_mean", "cpu_p50", "p50") if key in found)


def latency(results, path) -> bool:
    from matplotlib.ticker import LogLocator

    figure, (axes,) = canvas(6.5, 4.2)
    series = [
        ("fcn_grasp", ["fcn_grasp_mixed-6x6x5"]),
        ("lookahead", [f"lookahead-6x6x5-{n}samples" for n in (8, 32, 128)]),
        ("mcts_outcomes", [f"mcts_mixed-6x6x5-{n}sim" for n in (100, 500, 2000, 5000)]),
        ("joint_dbl", ["joint_dbl-mixed-6x6x5"]),
    ]
    for method, names in series:
        names = [name for name in names if "occupancy" in results.get(name, {})]
        times = [milliseconds(results[name]) for name in names]
        points(axes, times, results, names, method)
        for name, time in zip(names, times, strict=True):
            if name.startswith(("lookahead", "mcts")):  # how many samples, or simulations: off the line, which rises
                where = (time, results[name]["occupancy"]["mean"])
                number = name.rpartition("-")[2].replace("sim", " simulations").replace("samples", " samples")
                offset, side = ((6, -11), "left") if name.startswith("lookahead") else ((-6, 5), "right")
                axes.annotate(number, where, offset, textcoords="offset points", fontsize=7, ha=side)
    if not axes.lines:
        return False
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.margins(x=0.15)
    axes.set_xlabel("milliseconds of CPU time a decision, mean")
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
        ("fcn_grasp", lambda kind, tote: f"fcn_grasp_{kind}-{'' if kind == 'mixed' else 's*-'}{tote}"),
        ("lookahead", lambda kind, tote: f"lookahead_{kind}-{'' if kind == 'mixed' else 's0-'}{tote}"),
        ("joint_dbl", lambda kind, tote: f"joint_dbl-{kind}-{tote}"),
        ("individual_heuristic_cells", lambda kind, tote: f"individual_heuristic_cells-{kind}-{tote}"),
        ("individual_heuristic", lambda kind, tote: f"individual_heuristic-{kind}-{tote}"),
        ("individual_rl", lambda kind, tote: f"individual_rl_{kind}-{tote}-K10"),
        ("fcn4d", lambda kind, tote: f"fcn4d_{kind}-{tote}-K10"),
        ("typical", lambda kind, tote: f"typical_{kind}-{tote}-K10"),
        ("mcts_outcomes", lambda kind, tote: f"mcts-{kind}-{tote}-mask_true"),
        ("mcts", lambda kind, tote: f"mcts-{kind}-{tote}-mask_false"),
        ("random", lambda kind, tote: f"random-{kind}-{tote}"),
    ]
    for number, (method, name) in enumerate(rows):
        names = [name(*preset.split("-")) for preset in PRESETS.values()]
        xs = np.arange(len(PRESETS)) + 0.07 * (number - len(rows) / 2 + 0.5)
        points(axes, xs, results, names, method, line="", **({"label": "MCTS, no mask"} if method == "mcts" else {}))
    if not axes.lines:
        return False
    axes.set_xticks(range(len(PRESETS)), PRESETS)
    axes.set_ylabel("occupancy, R=4")
    axes.set_ylim(-0.03, 1.05)
    axes.grid(axis="x", alpha=0)
    for edge in range(1, len(PRESETS)):
        axes.axvline(edge - 0.5, color="#dddddd", lw=0.8)
    legend(figure, [axes], ncols=4)
    return save(figure, path)


OUTCOMES = {
    "executed": ("can be executed, given all before", "#0072b2"),
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


#: By the name of the yaml file: title, caption, and what draws it; it returns False where nothing was computed yet.
FIGURES = {
    "candidates": (
        "K, the number of candidates",
        "How many of a policy's most probable actions are tried before one is executed; 6x6x5, R=3.",
        candidates,
    ),
    "individual": (
        "Joint against individual planning",
        "Occupancy over the rotations to choose from, one panel a tote. K=10 for what was trained without a mask; "
        "fcn_grasp with a mask takes the best of all feasible actions. The paper's individual heuristic ends where no "
        "corner of a free rectangle passes: an empty tote and a closed layer leave four, all by the walls, so that the "
        "first item ends 22 of 100 episodes, and flatter packings, of more rotations, end sooner. Individual planning "
        "with fcn_grasp's network is trained as fcn_grasp is, but for the pick and, with a mask, a limit of 50,000 "
        "frames a level: with 1, 2 and 3 rotations an item in the end effector's corner hardly reaches 11, 6 and 1 of "
        "the 36 cells of a 6x6 tote, by its walls. The paper's individual RL had 30 minutes with 1 and 2 rotations and "
        "up to an hour with 3 and 4; in 30x30 totes with 3 and 4 it is another training, of 20 minutes.",
        individual,
    ),
    "learning_curves": (
        "Learning curves",
        "Validation at full height while training, R=4, at 6x6x5 but for the panel about clipping; some axes widen "
        "towards 1. Each network with the K that it is used with, so that masks and search are not told apart here; "
        "the table below has other K. A thin line goes on where the mean ends. Without clipping the 4D network is "
        "fcn4d at 6x6x5, bit for bit, and not drawn. Where the tote is one cell high the end effector may hang over "
        "its walls; on another processor seed 1 of fcn4d hit them with every first item once the tote was two cells "
        "high, found no reward to learn from for the rest of its hour, and had 0 where it has 0.35 at K=10 here.",
        learning_curves,
    ),
    "rl_methods": (
        "Joint planning against the RL methods and tree search",
        "R=4. K=1, as in the paper, but for what was trained with a mask: it takes the best of all feasible actions. "
        "In 30x30 totes individual RL is a second training, of 20 minutes instead of 52.",
        rl_methods,
    ),
    "optimum": (
        "Against the exact optimum",
        "Totes of height 1, small enough for dynamic programming over every state (`tests/dynamic_programming.py`); "
        "2,000 episodes, of the tree search as many as three minutes hold. All methods meet the same ones: where these "
        "are lucky a mean may lie above the optimum, that of few the more so.",
        optimum,
    ),
    "latency": (
        "What a search buys for its time",
        "27 kinds of items, 6x6x5, R=4; mean CPU time of a decision in one thread, of 20, of a search 100. "
        "The policy, alone and in lookahead, had a warm start.",
        latency,
    ),
    "presets": (
        "Where a tote is far from full",
        "R=4; policies were trained for these items and bins, at 6x6x5 (mixed: at 8x8x8, after a warm start; see "
        "its card), and are used as they are at the other size. K=10 for what was trained without a mask.",
        presets,
    ),
    "placement_only": (
        "What a placement-only plan is worth",
        "A public packer plans every item's place without a gripper in mind. Left: of its placements, those that the "
        "robot could execute if all before them had been, by hand if need be. Right: what it plans to fill, and what "
        "is filled when the first placement fails.",
        placement_only,
    ),
}
