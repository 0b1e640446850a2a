"""Draws docs/robot_frames.png, the frames of docs/robot.md, from a real plan: python docs/robot_frames.py"""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon, Rectangle

from pickplace import Box, CellSpec, Planner, Scene

INK, GREY, PALE, ITEM, PLACED, GRIPPER = "#263238", "#9aa3ab", "#e8ebed", "#e69f00", "#a9c9df", "#7b3294"
COLOURS = {"x": "#d62728", "y": "#1b8a3a", "z": "#1f4fd8"}  # as in RViz
SIDE, LAYER, ACCURACY = 0.05, 0.1, 0.003  # m; what lies in the tote is a layer of this height
TILT, TURN = np.radians(36), np.radians(-20)  # of the view onto the cell
RIGHT, AWAY = np.array([np.cos(TURN), np.sin(TURN)]), np.array([-np.sin(TURN), np.cos(TURN)])


def frame(yaw: float, x: float, y: float, z: float = 0.0) -> np.ndarray:
    """Return a frame that is turned about z, [4, 4]; degrees and metres."""
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    return np.array([(cos, -sin, 0, x), (sin, cos, 0, y), (0, 0, 1, z), (0, 0, 0, 1)])


# The plan.
planner = Planner(CellSpec(), planner="joint_dbl")
item = Box(0.11, 0.14, 0.13, 0.08, 0.06, yaw=30)
plan = planner.plan(Scene([item], np.full((30, 30), 0.25 - LAYER), SIDE, accuracy=ACCURACY))
assert plan.status == "ok" and plan.drop_height < LAYER + 0.002
box, placed = plan.box, plan.placed
bin_sides, tote_sides = np.array(planner.cell.bin_size) * SIDE, np.array(planner.cell.tote_size) * SIDE
plate = np.array(planner.cell.gripper.size) * SIDE
base_from_bin = frame(-7, *(-0.58 * RIGHT + 0.1 * AWAY), 0.03)
base_from_tote = frame(30, *(0.42 * RIGHT - 0.03 * AWAY))


def looking_down(yaw: float, x: float, y: float, height: float) -> np.ndarray:
    """Return a camera's optical frame above a floor, in the frame of that floor."""
    return frame(yaw, x, y, height) @ np.diag([1.0, -1.0, -1.0, 1.0])


bin_camera, tote_camera = looking_down(90, 0.125, 0.125, 0.5), looking_down(0, 0.15, 0.15, 0.62)


def rectangle(centre, sides, yaw=0.0) -> np.ndarray:
    """Return the corners of a rectangle, [4, 2]; the yaw in degrees."""
    around = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return np.array([(a * sides[0] / 2, b * sides[1] / 2, 0, 1) for a, b in around]) @ frame(yaw, *centre)[:2].T


figure = Figure(figsize=(9, 8.6))
FigureCanvasAgg(figure)
cell_axes = figure.add_axes((0.0, 0.415, 1.0, 0.585))
bin_axes = figure.add_axes((0.01, 0.03, 0.26, 0.37))
image_axes = figure.add_axes((0.275, 0.03, 0.26, 0.37))
side_axes = figure.add_axes((0.535, 0.015, 0.465, 0.395))


def show(points) -> np.ndarray:
    """Project points of the base's frame [..., 3] onto the picture."""
    flat, up = np.split(np.asarray(points, dtype=float), [2], axis=-1)
    return np.stack([flat @ RIGHT, flat @ AWAY * np.sin(TILT) + up[..., 0] * np.cos(TILT)], -1)


def move(pose, points) -> np.ndarray:
    """Bring points [N, 3] of a frame into the base's."""
    return np.asarray(points, dtype=float) @ pose[:3, :3].T + pose[:3, 3]


def face(pose, corners, **style):
    """Draw a polygon of a frame."""
    cell_axes.add_patch(Polygon(show(move(pose, corners)), closed=True, **style))


def solid(pose, corners, low, high, colour, zorder):
    """Draw a prism: the sides that are seen, and its top."""
    ends = [np.column_stack([corners, np.full(4, z)]) for z in (low, high)]
    for i in range(4):
        j = (i + 1) % 4
        quad = np.array([ends[0][i], ends[0][j], ends[1][j], ends[1][i]])
        edge = pose[:3, :3] @ (quad[1] - quad[0])
        if edge[:2] @ RIGHT > 0:  # corners run counter-clockwise: its outer side looks at us
            face(pose, quad, fc=colour, ec=INK, lw=0.7, alpha=1.0, zorder=zorder)
    face(pose, ends[1], fc=colour, ec=INK, lw=0.9, zorder=zorder)


def room(pose, sides, zorder):
    """Draw a bin or a tote: floor and far walls now, near walls over its contents."""
    wide, deep, high = sides
    corners = np.array([(0, 0), (wide, 0), (wide, deep), (0, deep)])
    face(pose, np.column_stack([corners, np.zeros(4)]), fc="#f7f8f9", ec=INK, lw=1.4, zorder=zorder)
    for i in range(4):
        (a, b), (c, d) = corners[i], corners[(i + 1) % 4]
        quad = [(a, b, 0), (c, d, 0), (c, d, high), (a, b, high)]
        near = (pose[:3, :3] @ np.subtract(quad[1], quad[0]))[:2] @ RIGHT > 0
        style = {"fc": "none"} if near else {"fc": PALE}
        face(pose, quad, ec=INK, lw=1.2, zorder=zorder + (6 if near else 0), **style)


def arrow(axes, start, end, colour, zorder=20, width=2.0):
    style = {"arrowstyle": "-|>", "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 11}
    axes.annotate("", end, start, arrowprops=style, zorder=zorder)


def label(axes, at, text, colour=INK, size=9, ha="center", va="center", zorder=30, **style):
    box = {"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.85}
    axes.text(*at, text, color=colour, fontsize=size, ha=ha, va=va, zorder=zorder, bbox=box, **style)


def axes_of(pose, lengths, zorder=20):
    """Draw the axes of a frame in the base's, with their letters."""
    origin = pose[:3, 3]
    for name, column, length in zip("xyz", pose[:3, :3].T, np.broadcast_to(lengths, 3), strict=True):
        end = show(origin + length * column)
        arrow(cell_axes, show(origin), end, COLOURS[name], zorder)
        way = end - show(origin)
        label(cell_axes, end + 0.02 * way / np.hypot(*way), name, COLOURS[name], 9, zorder=zorder + 1, weight="bold")
    cell_axes.plot(*show(origin), "o", color=INK, ms=4.5, zorder=zorder + 2)


def transform(start, end, text, at, bend, colour="#5b656d"):
    """Draw a curved line from one origin to another one, which a matrix describes."""
    style = {"arrowstyle": "->", "color": colour, "lw": 1.2, "ls": "--", "connectionstyle": f"arc3,rad={bend}",
             "shrinkA": 5, "shrinkB": 6}  # fmt: skip
    cell_axes.annotate("", show(end[:3, 3]), show(start[:3, 3]), arrowprops=style, zorder=19)
    label(cell_axes, at, text, colour, 8.5, family="monospace")


def gripper(pose, zorder):
    """Draw the end effector's rectangle at the tool centre point, and its stem."""
    corners = np.column_stack([rectangle((0, 0), plate), np.zeros(4)])
    face(pose, corners, fc=GRIPPER, ec=GRIPPER, lw=1.5, alpha=0.16, zorder=zorder)
    face(pose, corners, fc="none", ec=GRIPPER, lw=1.4, ls="--", zorder=zorder)


def camera(pose, rim, zorder=18):
    """Draw a camera, and its rays to a rim."""
    eye = pose[:3, 3]
    for corner in rim:
        cell_axes.plot(*show([eye, corner]).T, color=GREY, lw=0.6, ls=":", zorder=8)
    ends = move(pose, [(a * 0.035, b * 0.026, -0.05) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    for i in range(4):
        quad = [eye, ends[i], ends[(i + 1) % 4]]
        cell_axes.add_patch(Polygon(show(quad), fc="white", ec=INK, lw=1, alpha=0.9, zorder=zorder))
    cell_axes.add_patch(Polygon(show(ends), fc=PALE, ec=INK, lw=1, zorder=zorder))


# The cell.
base = np.eye(4)
cell_axes.set_aspect("equal")
room(base_from_bin, bin_sides, 2)
room(base_from_tote, tote_sides, 2)
solid(base_from_bin, rectangle((box.x, box.y), (box.w, box.d), box.yaw), 0, box.h, ITEM, 4)
solid(base_from_tote, rectangle(tote_sides[:2] / 2, tote_sides[:2] - 0.004), 0, LAYER, PLACED, 4)
solid(base_from_tote, rectangle((placed.x, placed.y), (placed.w, placed.d), placed.yaw), LAYER, placed.h, ITEM, 5)
for pose, sides, eye in ((base_from_bin, bin_sides, bin_camera), (base_from_tote, tote_sides, tote_camera)):
    rim = move(pose, [(a * sides[0], b * sides[1], sides[2]) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))])
    camera(pose @ eye, rim)
    axes_of(pose @ eye, 0.09, zorder=22)
axes_of(base, 0.13)
axes_of(base_from_bin, (0.31, 0.31, 0.1))
axes_of(base_from_tote, (0.37, 0.37, 0.06))
for pose, down in ((base_from_bin @ plan.pick.matrix, 0.08), (base_from_tote @ plan.place.matrix, 0.06)):
    gripper(pose, 14)
    axes_of(pose, (0.1, 0.1, down), zorder=24)
transform(base, base_from_bin, "base_from_bin", (-0.24, 0.025), 0.12)
transform(base, base_from_tote, "base_from_tote", (0.19, -0.065), 0.12)
transform(base_from_bin, base_from_bin @ bin_camera, "Camera.pose", (-0.7, 0.42), -0.25)
transform(base_from_tote, base_from_tote @ tote_camera, "Camera.pose", (0.6, 0.49), 0.3)
transform(base_from_bin, base_from_bin @ plan.pick.matrix, "pick.matrix", (-0.5, 0.045), -0.25, GRIPPER)
transform(base_from_tote, base_from_tote @ plan.place.matrix, "place.matrix", (0.59, 0.02), 0.35, GRIPPER)
bold = {"weight": "bold", "size": 10}
label(cell_axes, (-0.02, -0.04), "base", **bold)
label(cell_axes, (-0.645, 0.065), "bin", **bold)
label(cell_axes, (0.44, -0.045), "tote", **bold)
label(cell_axes, (-0.37, 0.625), "camera above the bin\n(optical frame)", ha="left", **bold)
label(cell_axes, (0.32, 0.665), "camera above the tote\n(optical frame)", ha="right", **bold)
label(cell_axes, (-0.375, 0.315), "tool at the pick", ha="left", colour=GRIPPER, **bold)
label(cell_axes, (0.24, 0.43), "tool at the place", ha="right", colour=GRIPPER, **bold)
for start, end in (((-0.37, 0.305), (-0.475, 0.245)), ((0.2, 0.415), (0.42, 0.235))):
    cell_axes.plot(*np.transpose((start, end)), color=GRIPPER, lw=0.8, zorder=26)
cell_axes.set(xlim=(-0.79, 0.77), ylim=(-0.09, 0.73))
cell_axes.set_axis_off()


def cross(axes, at, size=11):
    """Mark the tool centre point."""
    axes.plot(*at, "P", color=GRIPPER, ms=size, mec="white", mew=0.8, zorder=25)


# The bin from above.
def flat(axes, start, way, name, length=0.075):
    """Draw an axis of a frame, in plan view."""
    end = np.add(start, length * np.asarray(way))
    arrow(axes, start, end, COLOURS[name])
    label(axes, end + 0.013 * np.asarray(way), name, COLOURS[name], weight="bold")


for i in range(6):
    bin_axes.plot([i * SIDE] * 2, [0, bin_sides[1]], color=PALE, lw=0.8, zorder=0)
    bin_axes.plot([0, bin_sides[0]], [i * SIDE] * 2, color=PALE, lw=0.8, zorder=0)
bin_axes.add_patch(Rectangle((0, 0), *bin_sides[:2], fill=False, ec=INK, lw=1.8))
bin_axes.add_patch(Polygon(rectangle((box.x, box.y), (box.w, box.d), box.yaw), fc=ITEM, ec=INK))
tool = rectangle(plan.pick.center[:2], plate, plan.pick.yaw)
bin_axes.add_patch(Polygon(tool, fill=False, ec=GRIPPER, lw=1.4, ls="--", zorder=5))
flat(bin_axes, (0, 0), (1, 0), "x")
flat(bin_axes, (0, 0), (0, 1), "y")
centre, turned = np.array(plan.pick.center[:2]), plan.pick.matrix[:2, :2]
flat(bin_axes, centre, turned[:, 0], "x")
flat(bin_axes, centre, turned[:, 1], "y")
cross(bin_axes, centre)
bin_axes.plot([centre[0], centre[0] + 0.1], [centre[1]] * 2, color=INK, lw=0.9, ls=":")
bin_axes.add_patch(Arc(centre, 0.13, 0.13, theta1=0, theta2=plan.pick.yaw, color=INK, lw=1.2))
label(bin_axes, centre + (0.092, 0.022), "yaw", size=8.5)
edges = rectangle((box.x, box.y), (box.w, box.d), box.yaw)
for (start, end), name in (((edges[3], edges[2]), "w"), ((edges[0], edges[3]), "d")):
    label(bin_axes, (start + end) / 2, name, size=9.5, style="italic")
label(bin_axes, (0.125, 0.272), "the bin from above", **bold)
label(bin_axes, (0.037, 0.026), "cell (0, 0)", "#5b656d", 7.5, zorder=3)
bin_axes.set(xlim=(-0.03, 0.265), ylim=(-0.03, 0.29))

# The image.
FOCAL, SHAPE = 350, (240, 260)


def pixels(points) -> np.ndarray:
    """Return where the camera above the bin sees points of the bin's frame: columns u and rows v."""
    x, y, z = (np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(bin_camera).T)[:, :3].T
    return np.column_stack([FOCAL * x / z + (SHAPE[1] - 1) / 2, FOCAL * y / z + (SHAPE[0] - 1) / 2])


def seen(corners, height, colour):
    """Draw what the camera sees of a rectangle at a height."""
    image_axes.add_patch(Polygon(pixels(np.column_stack([corners, np.full(4, height)])), fc=colour, ec=INK, lw=0.8))


image_axes.add_patch(Rectangle((0, 0), SHAPE[1], SHAPE[0], fc="#c3cad0", ec=INK, lw=1.8))
for grown, height, colour in ((0.016, bin_sides[2], "#8e99a3"), (0, bin_sides[2], PALE), (0, 0, "#f7f8f9")):
    seen(rectangle(bin_sides[:2] / 2, bin_sides[:2] + grown), height, colour)
seen(edges, 0, "#b87a00")
seen(edges, box.h, ITEM)
origin, *ends = pixels(np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)]))
for name, end in zip("xy", ends, strict=True):
    arrow(image_axes, origin, end, COLOURS[name])
    label(image_axes, origin + 1.13 * (end - origin), name, COLOURS[name], weight="bold")
image_axes.plot(*origin, "o", color=INK, ms=4.5, zorder=25)
arrow(image_axes, (0, -8), (95, -8), INK)
arrow(image_axes, (-8, 0), (-8, 95), INK)
label(image_axes, (100, -8), "u, column, camera x", ha="left", size=8.5)
label(image_axes, (-8, 102), "v, row, camera y", va="top", size=8.5, rotation=90)
label(image_axes, (SHAPE[1] / 2, -40), "its image: image[v, u]", **bold)
image_axes.set(xlim=(-22, SHAPE[1] + 4), ylim=(SHAPE[0] + 4, -52))

# The heights.
SLACK, RIM, HIGH = 0.016, 0.25, 0.07  # m; the accuracy is drawn larger than it is


def plate_at(x, height):
    """Draw the end effector with its suction face at a height; the lip is pressed in, and, dashed, at rest."""
    side_axes.add_patch(Rectangle((x - 0.36, height), 0.72, 0.012, fc=GRIPPER, ec=INK, lw=0.8, zorder=6))
    side_axes.plot([x, x], [height + 0.012, height + 0.035], color=GRIPPER, lw=5, zorder=5)
    for low, style in ((SLACK, {"fc": "#cdb4db", "zorder": 5}), (2 * SLACK, {"fill": False, "ls": "--", "zorder": 7})):
        lip = [(x - 0.2, height), (x + 0.2, height), (x + 0.27, height - low), (x - 0.27, height - low)]
        side_axes.add_patch(Polygon(lip, ec=INK, lw=0.9, **style))
    cross(side_axes, (x, height), 9)


def measure(x, low, high, text, at=None, **style):
    """Draw a height, with a text beside it; ``at`` is where, by default along it."""
    look = {"arrowstyle": "<|-|>", "color": INK, "lw": 1.1, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}
    side_axes.annotate("", (x, low), (x, high), arrowprops=look, zorder=10)
    style = {"size": 8.5, "zorder": 12} | ({"rotation": 90} if at is None else {}) | style
    label(side_axes, (x - 0.11, (low + high) / 2) if at is None else at, text, **style)


def level(height, start, end):
    """Draw a line that says where a measure ends."""
    side_axes.plot([start, end], [height, height], color=GREY, lw=0.8, ls=":", zorder=1)


code = {"family": "monospace"}
face_z = HIGH + SLACK
side_axes.plot([0.62, 0.62, 1.72, 1.72], [0.05, 0, 0, 0.05], color=INK, lw=1.8)
side_axes.add_patch(Rectangle((0.82, 0), 0.7, HIGH, fc=ITEM, ec=INK, lw=1, zorder=3))
plate_at(1.17, face_z)
for height, start, end in ((face_z, 0.3, 1.9), (HIGH, 0.5, 0.9), (HIGH - SLACK, 1.3, 1.9)):
    level(height, start, end)
measure(0.34, 0, face_z, "pick.center[2]", **code)
measure(0.62, HIGH, face_z, "accuracy", at=(0.52, face_z + 0.014))
measure(1.84, HIGH - SLACK, face_z, "2 x\naccuracy", at=(2.19, HIGH))
label(side_axes, (1.17, 0.024), "measured\ntop", size=8, zorder=12)
arrow(side_axes, (1.17, 0.04), (1.17, HIGH), INK, zorder=11, width=0.9)

rest, under = LAYER, LAYER + SLACK
face_z = under + HIGH + SLACK
side_axes.plot([2.5, 2.5, 3.5, 3.5], [RIM, 0, 0, RIM], color=INK, lw=1.8)
side_axes.add_patch(Rectangle((2.5, 0), 1.0, rest, fc=PLACED, ec=INK, lw=0.8))
side_axes.add_patch(Rectangle((2.73, under), 0.7, HIGH, fc=ITEM, ec=INK, lw=1, zorder=3))
plate_at(3.08, face_z)
for height, end in ((rest, 3.74), (under, 3.74), (face_z, 4.16), (RIM, 4.44)):
    level(height, 2.73 if height < RIM else 3.5, end)
measure(3.68, 0, rest, "drop_height", **code)
measure(3.68, rest, under, "accuracy", at=(3.84, under + 0.013), size=8)
measure(4.16, 0, face_z, "place.center[2]", at=(4.05, 0.052), rotation=90, **code)
measure(4.42, 0, RIM, "tote_height", **code)
measure(2.62, rest, RIM, "tote_depth", at=(2.4, (rest + RIM) / 2), rotation=90, **code)
label(side_axes, (1.17, 0.275), "pick", **bold)
label(side_axes, (3.0, 0.275), "release", **bold)
side_axes.set(xlim=(0.12, 4.5), ylim=(-0.006, 0.29))
for axes in (bin_axes, image_axes):
    axes.set_aspect("equal")
for axes in (bin_axes, image_axes, side_axes):
    axes.set_axis_off()
figure.savefig(Path(__file__).with_suffix(".png"), dpi=150)
