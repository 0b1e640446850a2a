"""What a robot is wired by: the tool frame, bin and tote that are not parallel, walls, an empty bin, the loop."""

import sys
from collections import Counter
from dataclasses import replace
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import rectangle
from test_camera import BIN, CELL, SHAPE, SIZE, box_of, camera, image

from pickplace import Box, Camera, CellSpec, DepthMapError, EmptyBinError, Planner, Scene
from pickplace.robot.problem import Pose

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
DBL = Planner(CELL, planner="joint_dbl")
FLAT = np.full((30, 30), 0.25)
angles = st.floats(-180, 180)


def frame(yaw: float, *origin: float) -> np.ndarray:
    """A frame that is turned about z."""
    turn = radians(yaw)
    return np.array([(cos(turn), -sin(turn), 0, origin[0]), (sin(turn), cos(turn), 0, origin[1]), (0, 0, 1, origin[2]),
                     (0, 0, 0, 1)])  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(
    st.tuples(st.floats(0.04, 0.13), st.floats(0.04, 0.13), st.floats(0.02, 0.1)),
    st.tuples(st.floats(0.1, 0.15), st.floats(0.1, 0.15)), angles, angles, angles, st.sampled_from([0, 0.002, 0.005]),
)  # fmt: skip
def test_an_item_that_is_carried_by_the_tool_frame_lands_where_the_plan_says(size, at, yaw, bin_yaw, tote_yaw, error):
    """It is fixed to the tool at the pick; bin and tote are turned as they like in the base's frame."""
    plan = DBL.plan(Scene([Box(*at, *size, yaw)], FLAT, SIZE, accuracy=error))
    if plan.status != "ok":
        return
    base_from_bin, base_from_tote = frame(bin_yaw, 0.3, -0.4, 0.2), frame(tote_yaw, -0.5, 0.1, 0.05)
    pick, place = base_from_bin @ plan.pick.matrix, base_from_tote @ plan.place.matrix
    for pose in (pick, place):
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) and np.linalg.det(pose[:3, :3]) > 0
        assert np.allclose(pose[:3, 2], (0, 0, -1))
    corners = rectangle(at, size[:2], yaw)
    top_and_foot = np.array([(*corner, z, 1.0) for z in (size[2], 0.0) for corner in corners]).T
    landed = np.linalg.inv(base_from_tote) @ place @ np.linalg.inv(pick) @ base_from_bin @ top_and_foot
    box = plan.placed
    expected = rectangle((box.x, box.y), (box.w, box.d), box.yaw)
    for corner in landed[:2].T:
        assert np.hypot(*(expected - corner).T).min() < 1e-6
    # It hangs over its place by the accuracy, and by less than a millimetre more: heights are rounded up.
    assert error - 1e-9 < landed[2, 4:].min() - plan.drop_height < error + 0.001
    # The underside is as far below the tool as the tool was above the bin's floor.
    assert plan.pick.center[2] == pytest.approx(place[2, 3] - (base_from_tote @ landed)[2, 4])
    wrist = [np.degrees(np.arctan2(pose[1, 0], pose[0, 0])) for pose in (pick, place)]
    turn = wrist[1] - wrist[0] - (plan.rotation_degrees + tote_yaw - bin_yaw)
    assert abs((turn + 180) % 360 - 180) < 1e-4


def test_the_tool_frame_by_hand():
    """At yaw 0 its x is the frame's, its y points the other way; a yaw turns x counter-clockwise."""
    assert np.array_equal(
        Pose((0, 0), (1.0, 2.0, 3.0)).matrix, [(1, 0, 0, 1), (0, -1, 0, 2), (0, 0, -1, 3), (0, 0, 0, 1)]
    )
    assert np.allclose(Pose((0, 0), (0.0, 0.0, 0.0), 30.0).matrix[:3, 0], (cos(radians(30)), 0.5, 0))


@pytest.mark.parametrize("yaw", [-200, -80, -45, 0, 45, 46, 100, 359])
def test_a_plans_box_has_a_yaw_of_at_most_45_degrees(yaw):
    box = DBL.plan(Scene([Box(0.12, 0.12, 0.12, 0.08, 0.06, yaw)], FLAT, SIZE)).box
    assert -45 < box.yaw <= 45 and {box.w, box.d} == {0.12, 0.08}
    assert np.allclose(
        sorted(rectangle((box.x, box.y), (box.w, box.d), box.yaw).tolist()),
        sorted(rectangle((0.12, 0.12), (0.12, 0.08), yaw).tolist()),
    )


WALL = 0.07


def test_images_of_a_bin_whose_walls_are_no_whole_cells_high():
    """Above an item in the corner, lower than the walls, the end effector would hit them."""
    shown = image(camera(BIN), [box_of((0.11, 0.11, 0.06), 0.062, 0.062)], (*BIN[:2], WALL))
    views = (camera(BIN), shown), (camera(), image(camera(), []))
    scene = Scene.from_images(CELL, *views, SIZE, bin_height=WALL)
    assert scene.bin_height == WALL and scene.items[0].w == pytest.approx(0.11, abs=0.006)
    assert DBL.plan(scene).status == "impossible"
    assert DBL.plan(Scene.from_images(CELL, *views, SIZE)).status == "ok"  # the walls of `cell.bin_size` are 50 mm high
    with pytest.raises(DepthMapError, match="expected the whole bin in the image, up to its rim"):
        camera(BIN).items(shown, CELL, SIZE, bin_height=0.8)


@pytest.mark.parametrize(("height", "status"), [(0.06, "impossible"), (0.072, "impossible"), (0.074, "ok")])
def test_an_end_effector_passes_over_walls_that_are_clearly_lower_than_the_item(height, status):
    """In the corner it hangs over them, wherever the item is gripped: an item of three cells leaves it no choice."""
    corner = Scene([Box(0.06, 0.06, 0.11, 0.11, height)], FLAT, SIZE, bin_height=WALL)
    assert DBL.plan(corner).status == status
    assert DBL.plan(replace(corner, bin_height=None)).status == "ok"


@pytest.mark.parametrize("wall", [1, 2, 3])
def test_walls_on_the_grid(wall):
    """They are those of a cell of that size."""
    heights = np.zeros((5, 5))
    heights[0, 0] = 2
    tote, cell = np.full((6, 6), 5), CellSpec(cup_size=(1, 1), pick_rule="seal")
    scene = Scene.from_maps(heights, tote, bin_height=wall)
    assert Planner(cell, planner="joint_dbl").plan(scene).status == ("impossible" if wall == 3 else "ok")
    for name in ("pretrained/r4", "pretrained/paper"):
        same = Planner.load(name, bin_size=(5, 5, wall)).plan(Scene.from_maps(heights, tote))
        assert Planner.load(name).plan(scene) == same and same.status == "ok"


@pytest.mark.parametrize(("settings", "message"), [
    ({"cell_size": SIZE, "bin_height": 3}, "bin_height=3: expected metres between 0.001 and 2"),
    ({"bin_height": 0.5}, "bin_height=0.5: expected a whole number >= 1"),
])  # fmt: skip
def test_heights_of_walls_that_are_none_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Scene.from_maps(np.zeros((5, 5)), np.full((6, 6), 0.25), **settings)


def test_an_empty_bin_is_told_from_a_bad_image():
    views = (camera(BIN), image(camera(BIN), [], BIN)), (camera(), image(camera(), []))
    zeros = np.zeros((5, 5))
    for see in (
        lambda: Scene.from_images(CELL, *views, SIZE),
        lambda: Scene([], FLAT, SIZE),
        lambda: DBL.plan(Scene.from_maps(zeros, FLAT, cell_size=SIZE)),
        lambda: DBL.plan(Scene.from_maps(zeros, np.full((6, 6), 5))),
        lambda: DBL.plan(Scene.from_maps(zeros, np.full((6, 6), 5), zeros.astype(int))),
    ):
        with pytest.raises(EmptyBinError):
            see()
    dark = image(camera(BIN), [], BIN)
    dark[100:140, 130:190] = np.nan
    many = [Box(0.1, 0.1, 0.1, 0.1, 0.1)] * 101
    for see in (
        lambda: Scene.from_images(CELL, (camera(BIN), dark), views[1], SIZE),
        lambda: Scene.from_images(CELL, (camera(BIN), views[0][1] + 0.5), views[1], SIZE),
        lambda: Scene(many, FLAT, SIZE),
    ):
        with pytest.raises(DepthMapError) as error:
            see()
        assert type(error.value) is DepthMapError


def test_one_camera_sees_both():
    """It is given twice, with a pose for each."""
    base_from_camera = np.diag((1.0, -1.0, -1.0, 1.0))
    base_from_camera[:3, 3] = (0.3, 0.15, 1.4)
    bin_at, tote_at = np.array((0.0, 0.03)), np.array((0.33, 0.0))
    poses = [np.linalg.inv(frame(0, *at, 0)) @ base_from_camera for at in (bin_at, tote_at)]
    over_bin, over_tote = (Camera(380, 380, 159.5, 119.5, pose, SHAPE) for pose in poses)
    # Both rooms in one image: the nearer surface counts where both draw one.
    item = box_of((0.1, 0.08, 0.06), 0.12, 0.13, 20)
    both = np.minimum(image(over_bin, [item], BIN), image(over_tote, []))
    scene = Scene.from_images(CELL, (over_bin, both), (over_tote, both), SIZE, clearance=0.0075)
    (box,) = scene.items
    assert (box.x, box.y, box.h) == pytest.approx((0.12, 0.13, 0.06), abs=0.003)
    assert DBL.plan(scene).status == "ok"


def test_the_loop_of_the_page_packs_totes():
    """Bin, tote and base are turned against each other; some grips hold nothing, and one item is lost on the way."""
    pytest.importorskip("mujoco")
    from robot_loop import pack
    from simulated_robot import SimulatedRobot
    from test_simulated import BOXES, draw_items

    planner, plans, seen = Planner.load("pretrained/mixed", tote_size=(6, 6, 2)), [], Counter()
    items = draw_items(0, BOXES)[:14]
    robot = SimulatedRobot(planner, items, frame(37, 0.4, -0.2, 0.1), 1, missed={1}, lost={9})
    look, think = robot.look, planner.plan

    def look_at_times():
        """The third to the fifth pair of images are bad."""
        seen["images"] += 1
        return [(eye, depth * (np.nan if 3 <= seen["images"] <= 5 else 1)) for eye, depth in look()]

    def plan(scene, **settings):
        """Note each plan, with the cell in which it is carried out."""
        plans.append((len(robot.cells) - 1, think(scene, **settings)))
        return plans[-1][1]

    robot.look, planner.plan = look_at_times, plan
    pack(robot, planner, SIZE)
    images, fell = robot.calls
    assert "got no distance above 0" in images and "fell" in fell
    statuses = Counter(plan.status for _, plan in plans)
    assert statuses == {"ok": robot.grips, "stuck": 1} and robot.grips == 15 and len(robot.cells) == 4
    # Each item lies where its plan says.
    done = [(at, plan) for at, plan in plans if plan.status == "ok"]
    placed = [each for grip, each in enumerate(done) if grip not in (1, 9)]
    missed, again = (np.array(plan.pick.center[:2]) for _, plan in done[1:3])
    assert np.hypot(*(again - missed)) > SIZE / 2 and len(placed) == 13
    for number, cell in enumerate(robot.cells):
        for box, plan in zip(cell.gantry.boxes, [plan for at, plan in placed if at == number], strict=False):
            lies = cell.gantry.data.xpos[box.id]
            expected = (plan.placed.x, plan.placed.y, plan.placed.h - plan.box.h / 2)
            assert (np.abs(lies - expected) < (0.002, 0.002, 0.007)).all()
