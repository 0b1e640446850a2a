"""Draws docs/concepts.svg, the drawing of docs/concepts.md: python docs/concepts.py

The rules compute what it shows: both grips lead to the same footprint, and one of them collides.
"""

from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle

from pickplace import CellSpec, Failure, Item, State
from pickplace.rules.grasps import join_action
from pickplace.rules.state import surface_from
from pickplace.rules.step import apply

INK, GREY, PAPER = "#263238", "#9aa3ab", "#eef1f3"
ITEM, PLACED, BAD, GOOD = "#e69f00", "#a9d4ee", "#c2410c", "#2e7d32"
HEIGHT, PROFILE, ROW = 5, (1, 1, 1, 4, 4, 3), 2  # the tote's height, and the heights along the row that is cut
ITEM_AT, ITEM_SIZE = (1, 2), (2, 1, 1)  # where the item lies in the bin: x, y, and its w, d, h
GRIPS = {1: ((2, 2), (2, ROW), BAD), 2: ((1, 2), (1, ROW), GOOD)}  # pick cell, place cell, colour


def try_grip(cell: CellSpec, pick, place):
    """Return the effect of one action without rotation: its failure, the item's top, and the footprint's corner."""
    heights = torch.tensor(PROFILE, dtype=torch.int32)[None, :, None].expand(1, 6, 6).contiguous()
    item = Item(*(torch.tensor([[value]]) for value in (*ITEM_AT, *ITEM_SIZE)))
    numbers = (x * side + y for (x, y), side in ((pick, cell.bin_size[1]), (place, cell.tote_size[1])))
    action = join_action(cell, *(torch.tensor([number]) for number in (*numbers, 0)))
    step = apply(cell, State(surface_from(heights), torch.tensor([HEIGHT]), item), action)
    return Failure(int(step.failure)), int(step.top), step.footprint[0, :2].tolist()


def frame(axes, title, x, y):
    """Set up empty axes with a title."""
    axes.set_title(title, loc="left", fontsize=12, fontweight="bold", color=INK)
    axes.set_xlim(*x)
    axes.set_ylim(*y)
    axes.set_aspect("equal", anchor="NW")
    axes.set_axis_off()


def draw_bin(axes, cell):
    frame(axes, "1  The bin, from above", (-0.4, 7.3), (-1.5, 5.4))
    wide, deep, _ = cell.bin_size
    for i in range(1, wide):
        axes.plot([i, i], [0, deep], color=GREY, lw=0.5, zorder=0)
        axes.plot([0, wide], [i, i], color=GREY, lw=0.5, zorder=0)
    axes.add_patch(Rectangle((0, 0), wide, deep, fill=False, ec=INK, lw=2.5))
    axes.add_patch(Rectangle(ITEM_AT, *ITEM_SIZE[:2], fc=ITEM, ec=INK, lw=1.2))
    axes.annotate("item", (2.5, 2.1), (2.5, 0.45), ha="center", arrowprops={"arrowstyle": "-", "color": INK, "lw": 0.8})
    for number, (pick, _, colour) in GRIPS.items():
        inset = 0.1 if number == 2 else 0.0
        side = 3 - 2 * inset
        corner = (pick[0] - 1 + inset, pick[1] - 1 + inset)
        axes.add_patch(Rectangle(corner, side, side, fill=False, ec=colour, lw=2.2, ls="--"))
        axes.plot(pick[0] + 0.5, pick[1] + 0.5, "o", color=colour, ms=9, mec="white")
    axes.text(4.15, 3.2, "grip 1", color=BAD, va="center")
    axes.text(0.15, 4.3, "grip 2", color=GOOD, va="center")
    axes.text(0, -0.3, "dashed: the end effector, a flat suction square\ndots: pick cells, where its middle goes",
              va="top", fontsize=9.5)  # fmt: skip


def draw_cut(axes, cell, number, title):
    pick, place, colour = GRIPS[number]
    failure, top, (left, _) = try_grip(cell, pick, place)
    frame(axes, title, (-1.7, 7.6), (-1.5, 7.0))
    for i, height in enumerate(PROFILE):
        for z in range(height):
            axes.add_patch(Rectangle((i, z), 1, 1, fc=PLACED, ec="white", lw=0.8))
    axes.add_patch(Rectangle((left, top - 1), ITEM_SIZE[0], 1, fc=ITEM, ec=INK, lw=1.2, zorder=3))
    axes.add_patch(Rectangle((place[0] - 1, top), 3, 0.28, fc=colour, ec=INK, lw=0.8, zorder=4))
    axes.plot([place[0] + 0.5] * 2, [top + 0.28, HEIGHT + 1.0], color=colour, lw=4, zorder=2)
    axes.plot([0, 0, 6, 6], [HEIGHT, 0, 0, HEIGHT], color=INK, lw=2.5)
    if failure:
        axes.plot(3.45, top + 0.14, "X", color=BAD, ms=17, mec="white", mew=1.5, zorder=6)
    verdict = (
        f"{failure.name.lower()}: reward 0, the episode ends" if failure else "succeeds: reward = the item's volume"
    )
    axes.text(0, HEIGHT + 1.45, verdict, color=colour, va="center")
    axes.annotate("place cell", (place[0] + 0.5, -0.05), (place[0] + 0.5, -0.9), ha="center", color=colour,
                  arrowprops={"arrowstyle": "-|>", "color": colour})  # fmt: skip
    arrow = {"arrowstyle": "<|-|>", "color": INK, "lw": 1}
    if number == 1:
        axes.annotate("", (-0.3, 0), (-0.3, HEIGHT), arrowprops=arrow)
        axes.text(-0.55, HEIGHT / 2, "tote height", rotation=90, ha="right", va="center", fontsize=9.5)
    else:
        axes.annotate("", (5.5, PROFILE[5]), (5.5, HEIGHT), arrowprops=arrow)
        axes.text(6.2, 4.0, "remaining\nheight: the\ntote's map", va="center", fontsize=9.5)
    return failure, (left, top)


def draw_turns(axes, cell):
    frame(axes, "3  Rotation, with the item", (-0.4, 9.6), (-3.6, 3.9))
    item = np.array([[0, 1], [2, 2]]) - 1.5  # corners relative to the centre: at one end, as in grip 1
    for r in range(cell.rotations):
        centre = np.array([1.6 + 4.2 * (r % 2), 1.9 - 3.75 * (r // 2)])
        angle = np.radians(90 * r)
        turned = item @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        low, high = turned.min(0), turned.max(0)
        axes.add_patch(Rectangle(centre + low, *(high - low), fc=ITEM, ec=INK, lw=1.2))
        axes.add_patch(Rectangle(centre - 1.5, 3, 3, fill=False, ec=INK, lw=1.8, ls="--"))
        axes.plot(*centre, "o", color=INK, ms=6)
        axes.text(centre[0] + 1.65, centre[1], f"r = {r}\n{90 * r}°", va="center")


def draw_episode(axes):
    frame(axes, "4  An episode", (0, 10.2), (0, 7.4))

    def box(x, y, text, colour=INK, width=4.3):
        axes.add_patch(FancyBboxPatch((x, y), width, 1.25, boxstyle="round,pad=0.1", fc=PAPER, ec=colour, lw=1.4))
        axes.text(x + width / 2, y + 0.625, text, ha="center", va="center", fontsize=9)

    def arrow(start, end, colour=INK):
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6})

    box(0.2, 5.7, "an item arrives in a bin")
    box(5.6, 5.7, "depth maps of both, mask\nof feasible actions")
    box(5.6, 3.2, "the planner chooses\npick, place and rotation")
    box(0.2, 3.2, "success: the item rests,\nreward = its volume", GOOD)
    box(5.6, 0.7, "failure, or nothing is\nfeasible any more (stuck)", BAD)
    box(0.2, 0.7, "end: occupancy = placed\nvolume / tote's volume")
    arrow((4.65, 6.3), (5.45, 6.3))
    arrow((7.75, 5.55), (7.75, 4.6))
    arrow((5.45, 3.8), (4.65, 3.8), GOOD)
    arrow((2.35, 4.6), (2.35, 5.55), GOOD)
    arrow((7.75, 3.05), (7.75, 2.1), BAD)
    arrow((5.45, 1.3), (4.65, 1.3), BAD)


def draw_levels(axes):
    frame(axes, "5  A curriculum", (-0.2, 11.4), (-1.5, 7.4))
    for level, fill in enumerate((0.9, 0.88, 0.86, 0.85, 0.84), 1):
        x = 2.3 * (level - 1)
        axes.add_patch(Rectangle((x, 0), 1.6, level * fill, fc=PLACED, ec="none"))
        axes.plot([x, x, x + 1.6, x + 1.6], [level, 0, 0, level], color=INK, lw=2)
        if level < 5:
            axes.annotate(
                "", (x + 2.25, 0.5), (x + 1.67, 0.5), arrowprops={"arrowstyle": "-|>", "color": GOOD, "lw": 2}
            )
    axes.text(0, -0.3, "The tote is low at first and grows when the policy packs it well:\neach height is a level.",
              va="top", fontsize=9.5)  # fmt: skip


def draw() -> Figure:
    """Return the whole drawing."""
    cell = CellSpec()
    figure = Figure(figsize=(13.5, 8.2), layout="constrained")
    FigureCanvasSVG(figure)
    upper, lower = figure.subfigures(2, 1, height_ratios=[1.05, 1])
    bin_axes, first, second = upper.subplots(1, 3, width_ratios=[7.7, 9.3, 9.3])
    turns, episode, levels = lower.subplots(1, 3, width_ratios=[9.0, 10.4, 10.4])
    draw_bin(bin_axes, cell)
    bad, rest = draw_cut(first, cell, 1, "2a  The tote, cut: grip 1")
    good, same = draw_cut(second, cell, 2, "2b  Grip 2, the same footprint")
    assert (bad, good) == (Failure.ITEM_COLLISION, Failure.NONE) and rest == same
    draw_turns(turns, cell)
    draw_episode(episode)
    draw_levels(levels)
    return figure


if __name__ == "__main__":
    matplotlib.rcParams |= {"svg.hashsalt": "pickplace", "text.color": INK}
    draw().savefig(Path(__file__).with_suffix(".svg"), metadata={"Date": None}, facecolor="white")
