"""Draws docs/robot_cell.png, the first picture of docs/robot.md, from a simulated cell: python docs/robot_cell.py"""

from pathlib import Path

import numpy as np
from examples.simulated_cell import SimulatedCell
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from pickplace import Planner

INK, ITEM, GRIPPER = "#263238", "#e69f00", "#c2410c"
SIDE, STEPS = 0.05, 9  # m; items in the tote when the picture is taken

planner = Planner.load("pretrained/mixed", tote_size=(6, 6, 5))
cell, draw = SimulatedCell(planner, seed=4), np.random.default_rng(4)
bearing = None
for number in range(STEPS + 1):
    size, turn = (0.12, 0.08, 0.06), draw.uniform(-np.pi, np.pi)
    cos, sin = abs(np.cos(turn)), abs(np.sin(turn))
    half = np.array((size[0] * cos + size[1] * sin, size[0] * sin + size[1] * cos)) / 2 + 0.001
    cell.arrive(size, draw.uniform(half, 0.25 - half), np.degrees(turn))
    images = {name: cell.depth_image(name) for name in ("bin", "tote")}
    plan = cell.look_and_plan(bearing)
    assert plan.status == "ok", plan
    tote = cell.cameras["tote"].tote_map(images["tote"], planner.cell, SIDE)
    if number < STEPS:
        assert cell.carry_out(plan, size) is None
        bearing = plan.tote_bearing


def corners(centre, sides, yaw):
    """The corners of a rectangle in mm."""
    turn = np.radians(yaw)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(sides) / 2
    return 1e3 * (np.array(centre) + half @ axes)


def outline(axes, centre, sides, yaw, colour, style="-", label=None):
    """Draw a rectangle; lengths in metres, the yaw in degrees."""
    axes.add_patch(Polygon(corners(centre, sides, yaw), fill=False, ec=colour, lw=2.5, ls=style, label=label))


figure = Figure(figsize=(13, 4.3), layout="constrained")
FigureCanvasAgg(figure)
image_axes, bin_axes, tote_axes = figure.subplots(1, 3, width_ratios=[1.15, 1, 1])

image_axes.set_title("what the camera above the tote measures", color=INK)
picture = image_axes.imshow(1e3 * images["tote"], cmap="viridis_r")
figure.colorbar(picture, ax=image_axes, label="distance, mm", shrink=0.85)
image_axes.set(xlabel="column", ylabel="row")

box, effector = plan.box, np.array(planner.cell.gripper.size) * SIDE
heights = cell.cameras["bin"].points(images["bin"])
bin_axes.set_title("the item that was found, and the pick", color=INK)
inside = (heights[..., :2] > 0).all(-1) & (heights[..., :2] < 0.25).all(-1)
bin_axes.scatter(*(1e3 * heights[inside][:, :2].T), c=heights[inside][:, 2], s=1.5, cmap="Greys", marker="s")
outline(bin_axes, (box.x, box.y), (box.w, box.d), box.yaw, ITEM, label="item")
outline(bin_axes, plan.pick.center[:2], effector, plan.pick.yaw, GRIPPER, "--", "end effector")
outline(bin_axes, (0.125, 0.125), (0.25, 0.25), 0, INK)
bin_axes.set(xlim=(-60, 310), ylim=(-60, 310), xlabel="x, mm", ylabel="y, mm")

tote_axes.set_title("heights in the tote, and the place", color=INK)
extent = (0, 300, 0, 300)
shown = tote_axes.imshow(1e3 * tote.highest.T, origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=260)
figure.colorbar(shown, ax=tote_axes, label="height, mm", shrink=0.85)
turn = np.radians(plan.rotation_degrees)
arm = np.array((box.x, box.y)) - plan.pick.center[:2]
centre = plan.place.center[:2] + np.array(
    (arm[0] * np.cos(turn) - arm[1] * np.sin(turn), arm[0] * np.sin(turn) + arm[1] * np.cos(turn))
)
outline(tote_axes, centre, (box.w, box.d), box.yaw + plan.rotation_degrees, ITEM)
outline(tote_axes, plan.place.center[:2], effector, plan.place.yaw, GRIPPER, "--")
tote_axes.set(xlabel="x, mm", ylabel="y, mm", xlim=(-15, 315), ylim=(-15, 315))
for axes in (bin_axes, tote_axes):
    axes.set_aspect("equal")
bin_axes.legend(loc="upper center", ncols=2, fontsize=9, frameon=False)
figure.savefig(Path(__file__).with_name("robot_cell.png"), dpi=110)
