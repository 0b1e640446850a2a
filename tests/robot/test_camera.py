"""Depth images of boxes, computed ray by ray in plain numpy, and what the camera code reads from them."""

from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scenes import World, fault, inside, meet, plan_for, rectangle

from pickplace import CellSpec, DepthMapError, Scene
from pickplace.robot.camera import Camera
from pickplace.robot.planner import Box, Planner

CELL, SIZE = CellSpec(), 0.05
BIN, TOTE = (0.25, 0.25, 0.05), (0.3, 0.3, 0.25)
SHAPE = (240, 320)


def camera(room=TOTE, height=1.2, focal=500.0) -> Camera:
    return Camera.looking_down((room[0] / 2, room[1] / 2), height, focal, SHAPE)


def image(eye: Camera, boxes, room=TOTE, noise=0.0, seed=0, walls=True) -> np.ndarray:
    """Distances along the optical axis to the floor, the walls around ``room`` and the boxes, each with a yaw."""
    row, column = np.indices(eye.shape)
    rays = np.stack([(column - eye.cx) / eye.fx, (row - eye.cy) / eye.fy, np.ones(eye.shape)], -1)
    rays = rays @ eye.pose[:3, :3].T
    origin = eye.pose[:3, 3]
    depth = -origin[2] / rays[..., 2]  # the floor
    w, d, h = room
    around = [(-0.005, d / 2, 0.01, d + 0.02), (w + 0.005, d / 2, 0.01, d + 0.02), (w / 2, -0.005, w, 0.01),
              (w / 2, d + 0.005, w, 0.01)]  # fmt: skip
    for x, y, wide, deep, low, high, yaw in [
        *boxes, *([(*wall, 0.0, h, 0.0) for wall in around] if walls else [])
    ]:  # fmt: skip
        turn = np.radians(yaw)
        axes = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        start, way = axes @ (origin - (x, y, (low + high) / 2)), rays @ axes.T
        half = np.array([wide, deep, high - low]) / 2
        with np.errstate(divide="ignore"):
            ends = np.stack([(-half - start) / way, (half - start) / way])
        enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
        depth = np.where(enter < leave, np.minimum(depth, enter), depth)
    return depth + np.random.default_rng(seed).normal(0, noise, eye.shape)


def box_of(size, x, y, yaw=0.0, low=0.0):
    return x, y, *size[:2], low, low + size[2], yaw


@pytest.mark.parametrize("seed", range(8))
def test_an_item_is_measured(seed):
    draw = np.random.default_rng(seed)
    size, centre, yaw = (
        draw.uniform((0.05, 0.05, 0.03), (0.13, 0.11, 0.1)),
        draw.uniform(0.1, 0.15, 2),
        draw.uniform(-180, 180),
    )
    shown = image(camera(BIN), [box_of(size, *centre, yaw)], BIN, 0.002, seed)
    (box,) = camera(BIN).items(shown, CELL, SIZE)
    true = Box(*centre, *size, yaw).upright()
    assert np.hypot(box.x - centre[0], box.y - centre[1]) < 0.003 and abs(box.h - size[2]) < 0.004
    if abs(abs(true.yaw) - 45) > 4 and box.yaw != 0:
        assert abs(box.yaw - true.yaw) < 2.5
        assert -0.001 < box.w - true.w < 0.007 and -0.001 < box.d - true.d < 0.007


def tilted_camera(tilt: float, away: float, focal: float) -> Camera:
    """A camera towards -x of a bin of 0.6 x 0.4 m, that looks at its middle."""
    turn, pose = np.radians(tilt), np.eye(4)
    pose[:3, :3] = np.diag((1.0, -1.0, -1.0)) @ [
        [np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]
    ]  # fmt: skip
    pose[:3, 3] = np.array((0.3, 0.2, 0.05)) - away * pose[:3, 2]
    return Camera(focal, focal, 450, 350, pose, (700, 900))


@pytest.mark.parametrize("tilt", [0, 20, 45])
def test_a_tilted_camera_shows_more_with_a_pixel(tilt):
    eye = tilted_camera(tilt, 0.9, 900)
    height, angles = eye.pose[2, 3], np.radians(tilt) + np.arctan(np.array([-0.5, 0.5]) / 900)
    assert eye.pixel() == pytest.approx(height * np.ptp(np.tan(angles)), rel=1e-3)


@pytest.mark.parametrize("tilt", [0, 20, 45])
@pytest.mark.parametrize("seed", range(2))
def test_the_side_of_an_item_is_not_taken_for_its_top(seed, tilt):
    """Cameras with pixels of about 1 mm that see an item from the side."""
    draw, room, eye = np.random.default_rng(seed), (0.6, 0.4, 0.1), tilted_camera(tilt, 0.9, 900)
    size, centre = draw.uniform((0.06, 0.06, 0.03), (0.13, 0.12, 0.09)), draw.uniform((0.46, 0.1), (0.52, 0.3))
    yaw = draw.uniform(-30, 30)
    cell, shown = CellSpec(bin_size=(12, 8, 2)), image(eye, [box_of(size, *centre, yaw)], room, 0.0005, seed)
    (box,) = eye.items(shown, cell, SIZE)
    slack = eye.pixel() + box.edge_error
    assert abs(box.h - size[2]) < 0.003 and box.edge_error < 0.004
    for measured, true in ((box.w, size[0]), (box.d, size[1])):
        assert -0.002 < measured - true < 2 * slack, (box, size)
    assert np.hypot(box.x - centre[0], box.y - centre[1]) < slack, (box, centre)


@pytest.mark.parametrize(("tilt", "height", "gap"), [(40, 0.015, 0.005), (40, 0.015, 0.02), (30, 0.04, 0.005)])
def test_an_item_that_a_wall_hides_in_part_is_not_measured(tilt, height, gap):
    """The camera stands outside the bin, whose near wall hides a side of the item."""
    cell, room = CellSpec(bin_size=(12, 8, 2)), (0.6, 0.4, 0.1)
    eye = tilted_camera(tilt, 1.1, 700)
    hidden = image(eye, [box_of((0.09, 0.06, height), gap + 0.045, 0.2)], room, 0.0008)
    with pytest.raises(DepthMapError, match="not seen well enough"):
        eye.items(hidden, cell, SIZE)
    far = image(eye, [box_of((0.09, 0.06, height), 0.6 - gap - 0.045, 0.2)], room, 0.0008)
    (box,) = eye.items(far, cell, SIZE)
    assert type(box) is Box and 0 < box.w - 0.09 < 2 * (eye.pixel() + box.edge_error)


@pytest.mark.parametrize("greatest", [0.25, 1.2, 2.0])
def test_items_may_be_allowed_to_be_as_high_as_the_camera(greatest):
    shown = image(camera(BIN), [box_of((0.1, 0.08, 0.06), 0.12, 0.12)], BIN, 0.001)
    (box,) = camera(BIN).items(shown, CELL, SIZE, greatest_height=greatest)
    assert (box.w, box.d, box.h) == pytest.approx((0.1, 0.08, 0.06), abs=0.005)


def test_a_tote_is_measured_and_hidden_places_count_as_high_as_what_hides_them():
    boxes = [box_of((0.12, 0.08, 0.2), 0.08, 0.06), box_of((0.1, 0.1, 0.06), 0.2, 0.2, 20.0)]
    eye = camera()
    shown = image(eye, boxes, noise=0.002)
    shown[3:6, 3:6] = 0  # not measured
    shown[150, 200] = 0.4  # a flying pixel
    found = eye.tote_map(shown, CELL, SIZE)
    along = len(found.highest) // 6
    centre = (np.indices(found.highest.shape).transpose(1, 2, 0) + 0.5) * SIZE / along
    true = np.zeros(found.highest.shape)
    for x, y, w, d, _, high, yaw in boxes:
        turn, away = np.radians(yaw), centre - (x, y)
        inside = (abs(away @ (np.cos(turn), np.sin(turn))) < w / 2) & (
            abs(away @ (-np.sin(turn), np.cos(turn))) < d / 2
        )
        true = np.where(inside, np.maximum(true, high), true)
    assert (found.highest >= true - 0.004).all(), "something in the tote is not seen"
    assert (found.lowest <= true + 0.004).all(), "something that is not there would support an item"
    assert found.highest.max() < 0.21 and (found.highest < true + 0.006).mean() > 0.8
    # The outer side of the high box is hidden from the camera; the patch beside it counts as high.
    hidden = found.highest[int(0.01 / SIZE * along), int(0.06 / SIZE * along)]
    assert hidden > 0.19


def test_a_high_item_at_a_wall_does_not_raise_the_other_walls():
    for focal in (380.0, 450.0, 600.0):
        eye = camera(focal=focal)
        found = eye.tote_map(image(eye, [box_of((0.1, 0.1, 0.2), 0.06, 0.06)]), CELL, SIZE)
        assert found.highest[:, -1].max() < 0.02 and found.highest[-1].max() < 0.02


def test_steps_or_labels_tell_items_apart():
    two = [box_of((0.08, 0.08, 0.06), 0.07, 0.1), box_of((0.08, 0.06, 0.05), 0.18, 0.15)]
    eye = camera(BIN)
    shown = image(eye, two, BIN, 0.001)
    found = sorted(eye.items(shown, CELL, SIZE), key=lambda box: box.x)
    assert [round(box.h, 2) for box in found] == [0.06, 0.05]
    touching = [box_of((0.1, 0.08, 0.06), 0.07, 0.1), box_of((0.1, 0.08, 0.06), 0.17, 0.1)]
    shown = image(eye, touching, BIN, 0.001)
    (one,) = eye.items(shown, CELL, SIZE)  # that is what the image shows
    assert one.w == pytest.approx(0.2, abs=0.006)
    with pytest.raises(
        DepthMapError, match=r"is two of 0.1 x 0.08 and 0.1 x 0.08 m that touch; separate them, or pass"
    ):
        eye.items(shown, CELL, SIZE, sizes=[(0.1, 0.08, 0.06)])
    with pytest.raises(DepthMapError, match=r"is one item of 0.2 x 0.08 m or two of 0.1 x 0.08 and 0.1 x 0.08 m"):
        eye.items(shown, CELL, SIZE, sizes=[(0.1, 0.08, 0.06), (0.08, 0.2, 0.06)])
    with pytest.raises(DepthMapError, match=r"is two of 0.13 x 0.08 and 0.07 x 0.077 m that touch"):
        eye.items(shown, CELL, SIZE, sizes=[(0.13, 0.08, 0.06), (0.07, 0.077, 0.06)])
    with pytest.raises(DepthMapError, match="is no item of the given sizes"):
        eye.items(shown, CELL, SIZE, sizes=[(0.1, 0.1, 0.06)])
    left = eye.points(shown)[..., 0] < 0.12
    labelled = eye.items(shown, CELL, SIZE, labels=np.where(left, 1, 2))
    assert [box.w for box in labelled] == pytest.approx([0.1, 0.1], abs=0.006)
    with pytest.raises(DepthMapError, match=r"labels\[.*\]: got 0, but something 0.06. m high lies there"):
        eye.items(shown, CELL, SIZE, labels=np.where(left, 1, 0))
    shifted = [touching[0], box_of((0.1, 0.08, 0.06), 0.17, 0.12)]
    with pytest.raises(DepthMapError, match="it could be two items that touch, or one that is no cuboid"):
        eye.items(image(eye, shifted, BIN, 0.001), CELL, SIZE)
    seen = {"tote_depth": np.full((6, 6), 0.25), "cell_size": SIZE}
    assert plan_for(Planner(CELL, planner="joint_dbl"), items=labelled, **seen).status == "impossible"  # it lifts both


def test_several_items_are_measured_or_known_to_be_hidden_in_part():
    """Boxes anywhere in a bin, in the shadow of others too: a plan for what the camera sees has no fault."""
    room, cell, draw, counts = (0.4, 0.4, 0.05), CellSpec(bin_size=(8, 8, 1)), np.random.default_rng(2), Counter()
    planner, eye = Planner(cell, planner="joint_dbl"), camera(room)
    for seed in range(30):
        scene = World(room, TOTE, (0.15, 0.15), (0.09, 0.07, 0.12), (0.285, 0.2), float(draw.uniform(-5, 5)))
        scene.add_others(draw, 3, (0.1, 0.1, 0.12))
        size = (0.06, 0.05, 0.03)  # a low one, close behind the first
        scene.others.append((size, (0.394 - size[0] / 2, 0.2), 0.0))
        shapes = [rectangle(at, sides[:2], yaw) for sides, at, yaw in scene.in_bin()]
        off_walls = all(0.0059 < at < 0.3941 for shape in shapes for at in shape.flat)  # else a wall may be meant
        if not off_walls or any(meet(a, b) for a, b in combinations(shapes, 2)):
            continue
        boxes = [box_of(size, *at, yaw) for size, at, yaw in scene.in_bin()]
        try:
            found = eye.items(image(eye, boxes, room, 0.001, seed), cell, SIZE)
        except DepthMapError as error:
            assert "two items that touch, or one that is no cuboid" in str(error)
            counts["refused"] += 1
            continue
        true = [
            min(range(len(shapes)), key=lambda at: np.hypot(*(shapes[at].mean(0) - (box.x, box.y)))) for box in found
        ]
        for number, box in zip(true, found, strict=True):
            grown = rectangle((box.x, box.y), (box.w + 0.01, box.d + 0.01), box.yaw)  # by the clearance
            assert inside(shapes[number], grown), (seed, box)
            counts[type(box).__name__] += 1
        plan = plan_for(planner, items=found, tote_depth=np.full((30, 30), 0.25), cell_size=SIZE)
        if plan.status == "ok":
            box, seen = plan.box, scene.taking(true[plan.item_number])
            item = {"item": (box.w, box.d, seen.item[2]), "centre": (box.x, box.y), "yaw": box.yaw}  # nearly
            assert type(box) is Box and fault(replace(seen, **item), plan, 0.003) is None
        counts[plan.status] += 1
    assert counts["HiddenBox"] > 5 and counts["Box"] > 24 and counts["ok"] > 9, counts


def test_what_is_no_image_of_the_tote_is_refused():
    eye = camera()
    shown = image(eye, [])
    for bad, message in (
        (shown * np.nan, "got no distance above 0"), (shown * 1000, "expected metres; divide millimetres by 1000"),
        (shown[0], "expected an image of distances"), (shown.astype(bool), "expected an image of distances"),
        (shown + 0.5, "the tote is seen at a height of -0.500 m"),
        (shown - 1.0, "the tote is seen at a height of 1.000 m"),
    ):  # fmt: skip
        with pytest.raises(DepthMapError, match=message):
            eye.tote_map(bad, CELL, SIZE)
    with pytest.raises(DepthMapError, match="the image shows nothing of the tote, expected the whole tote"):
        Camera.looking_down((1.0, 0.0), 1.2, 500.0, SHAPE).tote_map(shown, CELL, SIZE)
    with pytest.raises(DepthMapError, match="a cell is 0.8 pixels wide, expected at least 2"):
        camera(focal=20.0).tote_map(image(camera(focal=20.0), []), CELL, SIZE)
    dark = shown.copy()
    dark[:, :150] = 0
    with pytest.raises(DepthMapError, match="too few|are not seen"):
        eye.tote_map(dark, CELL, SIZE)
    dark[50:190, 80:240] = 0
    with pytest.raises(DepthMapError, match="no pixel shows the inside of the tote, expected most of them to"):
        eye.tote_map(dark, CELL, SIZE)
    with pytest.raises(ValueError, match="camera.pose: the camera does not look down"):
        Camera(500, 500, 160, 120, np.eye(4), SHAPE)
    with pytest.raises(ValueError, match="camera.pose: expected .4, 4."):
        Camera(500, 500, 160, 120, np.ones((4, 4)), SHAPE)
    with pytest.raises(ValueError, match="camera.pose: expected .4, 4."):
        Camera(500, 500, 160, 120, "abc", SHAPE)
    for key, value in {"fx": 0, "fy": "500", "cx": float("nan"), "cy": None}.items():
        with pytest.raises(ValueError, match=f"camera.{key}={value!r}: expected a number of pixels"):
            Camera(**{"fx": 500, "fy": 500, "cx": 160, "cy": 120, key: value}, pose=np.eye(4), shape=SHAPE)
    with pytest.raises(DepthMapError, match="labels: got shape"):
        camera(BIN).items(image(camera(BIN), [], BIN), CELL, SIZE, labels=np.zeros((3, 3)))
    found = eye.tote_map(shown, CELL, SIZE)
    with pytest.raises(ValueError, match="cell_size=None: .* as items or tote are measured"):
        Scene.from_maps(np.zeros((5, 5)), found)


def test_a_scene_of_two_images():
    """It has what each camera sees, measured with the accuracy of the scene."""
    eyes = camera(BIN), camera()
    images = image(eyes[0], [box_of((0.1, 0.08, 0.06), 0.12, 0.1)], BIN), image(eyes[1], [])
    views = [*zip(eyes, images, strict=True)]
    scene = Scene.from_images(CELL, *views, SIZE, 0.002, clearance=0.006, tote_height=0.2)
    assert scene.items == eyes[0].items(images[0], CELL, SIZE, accuracy=0.002)
    assert all(map(np.array_equal, scene.tote, eyes[1].tote_map(images[1], CELL, SIZE, 0.2)))
    assert (scene.cell_size, scene.accuracy, scene.clearance, scene.tote_height) == (SIZE, 0.002, 0.006, 0.2)
    assert Planner(CELL, planner="joint_dbl").plan(scene).status == "ok"
    with pytest.raises(ValueError, match="^clearance=0.004: a pixel shows 0.0024 m of the floor; expected at least 2 "):
        Scene.from_images(CELL, *views, SIZE, clearance=0.004)
    for key, value in {"cell_size": 50, "accuracy": -0.003, "tote_height": 250, "greatest_height": 60}.items():
        with pytest.raises(ValueError, match=f"^{key}={value}: expected metres") as caught:
            Scene.from_images(CELL, *views, **{"cell_size": SIZE, key: value})
        assert not isinstance(caught.value, DepthMapError)  # another image would not help
    for sizes in (0.1, (0.2, 0.2, 0.2), [], [(0.2, 0.2)], [(0.2, 0.2, 0.2), (0.1, 0.1)], [(0.2, 0.2, -0.2)], "200"):
        with pytest.raises(ValueError, match=r"^sizes=.*: expected a list of \(w, d, h\), lengths above 0 in metres"):
            Scene.from_images(CELL, *views, SIZE, sizes=sizes)
    with pytest.raises(DepthMapError, match="labels: got shape"):
        Scene.from_images(CELL, *views, SIZE, labels=np.zeros((3, 3)))
    with pytest.raises(DepthMapError, match="is no item of the given sizes"):
        Scene.from_images(CELL, *views, SIZE, sizes=[(0.2, 0.2, 0.2)])
