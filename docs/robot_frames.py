"""Draws docs/robot_frames.png, the frames of reference of docs/robot.md: python docs/robot_frames.py"""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Rectangle

from pickplace import Planner, Scene

INK, GREY, ITEM, PLACED, GRIPPER = "#263238", "#9aa3ab", "#e69f00", "#56b4e9", "#c2410c"

# A state in which the item has to be turned: it fills a gap that lies the other way.
bin_depth = np.zeros((5, 5))
bin_depth[1:3, 2] = 1
heights = np.array([
    [2, 5, 5, 5, 5, 5],
    [5, 5, 5, 5, 5, 5],
    [5, 5, 5, 4, 5, 5],
    [5, 5, 5, 5, 5, 3],
    [4, 4, 5, 5, 5, 5],
    [5, 5, 5, 5, 5, 5],
])  # fmt: skip
HEIGHT = 5
planner = Planner.load("pretrained/r4")
plan = planner.plan(Scene.from_maps(bin_depth, HEIGHT - heights))  # in cells; drawn in metres
turn, ee = int(plan.rotation_degrees), planner.cell.gripper.size
x, y, w, d, h = (plan.item[key] for key in "xywdh")
pick, place = np.array(plan.pick.center), np.array(plan.place.center)
quarter = turn // 90
arm = np.array([x + w / 2, y + d / 2]) - pick[:2]
for _ in range(quarter):
    arm = np.array([-arm[1], arm[0]])
landed, size = place[:2] + arm, (d, w) if quarter % 2 else (w, d)
turned_ee = ee[::-1] if quarter % 2 else ee

figure = Figure(figsize=(13, 5.4), layout="constrained")
FigureCanvasAgg(figure)
bin_axes, tote_axes, side_axes = figure.subplots(1, 3, width_ratios=[5, 6, 7])


def plan_view(axes, grid, title):
    axes.set_title(title, color=INK, fontsize="large")
    axes.set_xlim(-0.9, grid[0] + 0.6)
    axes.set_ylim(-0.9, grid[1] + 1.1)
    for i in range(grid[0] + 1):
        axes.plot([i, i], [0, grid[1]], color=GREY, lw=0.6, zorder=0)
    for j in range(grid[1] + 1):
        axes.plot([0, grid[0]], [j, j], color=GREY, lw=0.6, zorder=0)
    axes.add_patch(Rectangle((0, 0), *grid, fill=False, ec=INK, lw=2.5, zorder=1))
    arrow = {"arrowstyle": "-|>", "color": INK, "lw": 2}
    axes.annotate("", (1.6, -0.35), (-0.08, -0.35), arrowprops=arrow)
    axes.annotate("", (-0.35, 1.6), (-0.35, -0.08), arrowprops=arrow)
    axes.text(1.75, -0.35, "x, first axis of the map", va="center", color=INK)
    axes.text(-0.35, 1.75, "y, second axis", ha="center", va="bottom", rotation=90, color=INK)
    axes.plot(0, 0, "o", color=INK, ms=7, zorder=5)
    axes.set_aspect("equal")
    axes.set_axis_off()


def effector(axes, center, size, cell):
    corner = center[0] - size[0] / 2, center[1] - size[1] / 2
    axes.add_patch(Rectangle(corner, *size, fill=False, ec=GRIPPER, lw=2, ls="--", zorder=5))
    axes.plot(*center[:2], "P", color=GRIPPER, ms=11, zorder=6)
    axes.text(*(np.array(cell) + [0.5, 0.16]), f"cell ({cell[0]}, {cell[1]})", color=GRIPPER, ha="center", fontsize=8.5)


plan_view(bin_axes, planner.cell.bin_size[:2], "bin, from above")
bin_axes.add_patch(Rectangle((x, y), w, d, fc=ITEM, ec=INK, lw=1.2, zorder=2))
effector(bin_axes, pick, ee, plan.pick.cell)

plan_view(tote_axes, planner.cell.tote_size[:2], f"tote, from above: turned by {turn}° (counter-clockwise)")
for (i, j), height in np.ndenumerate(heights):
    shade = 1 - 0.08 * height
    tote_axes.add_patch(Rectangle((i, j), 1, 1, fc=(shade, shade, shade), ec="none", zorder=-1))
    tote_axes.text(i + 0.9, j + 0.88, str(height), ha="right", va="top", fontsize=7.5, color=INK)
tote_axes.add_patch(Rectangle(landed - np.array(size) / 2, *size, fc=ITEM, ec=INK, lw=1.2, zorder=2))
effector(tote_axes, place, turned_ee, plan.place.cell)
if turn:
    tote_axes.add_patch(Arc(place[:2], 1.1, 1.1, theta1=0, theta2=turn, color=GRIPPER, lw=1.6, zorder=5))
    end = place[:2] + 0.55 * np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
    tote_axes.plot(*end, marker=(3, 0, turn), color=GRIPPER, ms=9, zorder=6)

# The same tote from the side, cut through the footprint.
row = int(landed[1] - size[1] / 2)
side_axes.set_title(f"tote, cut at y = {row + 0.5:g} cells", color=INK, fontsize="large")
for i, height in enumerate(heights[:, row]):
    side_axes.add_patch(Rectangle((i, 0), 1, height, fc=PLACED, ec=INK, lw=0.8))
left, drop, top = landed[0] - size[0] / 2, plan.drop_height, place[2]
side_axes.add_patch(Rectangle((left, drop), size[0], h, fc=ITEM, ec=INK, lw=1.2, zorder=3))
corner = place[0] - turned_ee[0] / 2
side_axes.add_patch(Rectangle((corner, top), turned_ee[0], 0.18, fc=GRIPPER, ec=INK, lw=0.8, zorder=3))
side_axes.plot([place[0]] * 2, [top + 0.18, HEIGHT + 1.1], color=GRIPPER, lw=3)
side_axes.plot(place[0], top, "P", color=GRIPPER, ms=11, mec="white", zorder=6)
side_axes.plot([0, 0, 6, 6], [HEIGHT, 0, 0, HEIGHT], color=INK, lw=2.5)


def measure(at, low, high, text, side="right"):
    side_axes.annotate("", (at, low), (at, high), arrowprops={"arrowstyle": "<|-|>", "color": INK, "lw": 1.3})
    ha, shift = ("left", 0.12) if side == "right" else ("right", -0.12)
    side_axes.text(at + shift, (low + high) / 2, text, ha=ha, va="center", color=INK)


measure(-0.35, 0, HEIGHT, "tote_height", "left")
measure(6.35, 0, drop, "drop_height")
measure(6.35, drop, top, "item height")
side_axes.plot([left + size[0], 6.35], [drop, drop], color=GREY, lw=0.8, ls=":")
side_axes.plot([left + size[0], 6.35], [top, top], color=GREY, lw=0.8, ls=":")
free = 0.5
measure(free, heights[0, row], HEIGHT, "tote_depth")
side_axes.text(6.5, top + 0.55, "place.center z\n= top of the item", color=GRIPPER, va="center")
side_axes.text(place[0] + 0.15, HEIGHT + 0.8, "end effector", color=GRIPPER, va="center")
side_axes.set_xlim(-2.3, 8.9)
side_axes.set_ylim(-0.9, HEIGHT + 1.2)
side_axes.set_aspect("equal")
side_axes.set_axis_off()
figure.legend(
    handles=[
        bin_axes.plot([], [], "o", color=INK, label="origin of the frame, on the inner floor")[0],
        bin_axes.plot([], [], "P", color=GRIPPER, ms=10, label="center: where the suction face's centre goes")[0],
        bin_axes.plot([], [], "--", color=GRIPPER, label="end effector's rectangle")[0],
        Rectangle((0, 0), 1, 1, fc=ITEM, ec=INK, label="item"),
    ],
    loc="outside lower center", ncols=4, frameon=False,
)  # fmt: skip
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
