"""Depth images with faults: what is unknown is occupied, and an image that is no use is refused in one sentence."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "long"))

import camera_truth  # noqa: E402
from camera_truth import FOCAL, SHAPE, Thing, Truth  # noqa: E402

from pickplace import Box, Camera, CellSpec, DepthMapError, Planner, Scene  # noqa: E402
from pickplace.robot.box import HiddenBox, UnknownBox  # noqa: E402
from pickplace.robot.depth_image import HOLE, holes_in, median_of_nine  # noqa: E402
from pickplace.robot.measure import turned_axes  # noqa: E402

CELL, SIZE = CellSpec(bin_size=(6, 6, 1), tote_size=(6, 6, 5)), 0.05
ROOMS = {"bin": (0.3, 0.3, 0.05), "tote": (0.3, 0.3, 0.25)}
ITEM = Thing((0.15, 0.15), (0.096, 0.07), 0.0, 0.06)


def see(name: str, *things: Thing, noise: float = 0.0015, seed: int = 0, room=None) -> tuple[Camera, np.ndarray]:
    """A camera over the middle of a room, 620 pixels focal length and 1.2 m above, and its image of the things."""
    rooms = ROOMS | {name: room or ROOMS[name]}
    truth = Truth(rooms["bin"], rooms["tote"], **{f"in_{name}": list(things)})
    eye = Camera.looking_down((0.15, 0.15), 1.2, FOCAL, SHAPE)
    depth, dark = camera_truth.cast(eye.rays(), eye.pose[:3, 3], truth, name)
    return eye, np.where(dark, np.nan, depth + np.random.default_rng(seed).normal(0, noise, SHAPE))


def items(eye: Camera, image, **options) -> list[Box]:
    return eye.items(image, CELL, SIZE, **options)


def tote_map(eye: Camera, image, **options):
    return eye.tote_map(image, CELL, SIZE, **options)


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_filters_are_those_of_scipy(rows, columns, seed):
    draw = np.random.default_rng(seed)
    image = draw.integers(0, 5, (rows, columns)).astype(float)
    assert np.array_equal(median_of_nine(image), ndimage.median_filter(image, 3, mode="nearest"))
    unknown = draw.random((rows, columns)) < 0.8
    assert np.array_equal(holes_in(unknown), ndimage.binary_opening(unknown, HOLE))


def part_of(heights: np.ndarray, thing: Thing, border: float = 0.0) -> np.ndarray:
    """The part of a tote's map over a thing that lies along the walls, or the part well inside."""
    patch = ROOMS["tote"][0] / len(heights)
    low, high = thing.corners.min(0) + border, thing.corners.max(0) - border
    (x0, y0), (x1, y1) = np.floor(low / patch).astype(int), np.ceil(high / patch).astype(int)
    return heights[x0:x1, y0:y1]


# ---------------------------------------------------------------------------------------------------- the bin


@pytest.mark.parametrize("missing", [0.01, 0.05, 0.1])
def test_single_missing_pixels_change_nothing(missing):
    eye, image = see("bin", ITEM)
    (whole,) = items(eye, image)
    image[np.random.default_rng(1).random(SHAPE) < missing] = np.nan
    (box,) = items(eye, image)
    assert (box.w, box.d, box.x, box.y, box.h) == pytest.approx(
        (whole.w, whole.d, whole.x, whole.y, whole.h), abs=0.003
    )


@pytest.mark.parametrize("missing", [0.2, 0.3, 0.4, 0.9])
def test_too_many_missing_pixels_are_refused_not_read_as_nothing(missing):
    for name, read in (("bin", items), ("tote", tote_map)):
        eye, image = see(name, ITEM)
        image[np.random.default_rng(1).random(SHAPE) < missing] = np.nan
        with pytest.raises(
            DepthMapError, match=rf"of the pixels on level surfaces in the {name} have no depth, expected"
        ):
            read(eye, image)


def test_an_empty_bin_is_empty():
    eye, image = see("bin")
    image[np.random.default_rng(1).random(SHAPE) < 0.05] = np.nan
    assert items(eye, image) == []


@given(st.integers(1, 12), st.booleans(), st.integers(0, 3))
@settings(max_examples=25, deadline=None)
def test_an_item_is_never_shorter_than_what_may_be_there(width, inside, turns):
    """Columns without depth at the edge of an item, of it or beside it: a box as large, or the image is refused."""
    thing = replace(ITEM, yaw=turns * np.pi / 2)
    eye, image = see("bin", thing)
    top = see("bin", thing, noise=0.0)[1] < 1.145  # the rim is at 1.15
    last = np.flatnonzero(top.any(0))[-1]
    rows = np.flatnonzero(top.any(1))
    first = last + 1 - width * inside
    image[rows[0] : rows[-1] + 1, first : first + width] = np.nan
    try:
        (box,) = items(eye, image)
    except DepthMapError as error:
        assert ("not seen well enough" in str(error) or "a part of the bin" in str(error)) and width > 2
        return
    right = thing.corners[:, 0].max()
    assert box.x + box.w / 2 > right - 0.002
    assert box.x + box.w / 2 - box.edge_error < right + 0.002  # what it covers for sure is there
    assert type(box) is Box


@pytest.mark.parametrize("pixels", [4, 8])
def test_wide_shadows_around_an_item_are_refused(pixels):
    eye, image = see("bin", replace(ITEM, yaw=0.4))
    exact = see("bin", replace(ITEM, yaw=0.4), noise=0.0)[1]
    image[camera_truth.shadows(exact, pixels, False)] = np.nan
    with pytest.raises(DepthMapError, match="are not seen well enough to tell where an item ends|a part of the bin of"):
        items(eye, image)


def test_narrow_shadows_are_seen():
    eye, image = see("bin", replace(ITEM, yaw=0.4))
    image[camera_truth.shadows(see("bin", replace(ITEM, yaw=0.4), noise=0.0)[1], 2, False)] = np.nan
    (box,) = items(eye, image)
    assert (box.w, box.d) == pytest.approx((0.096, 0.07), abs=0.008)
    assert (box.x, box.y) == pytest.approx((0.15, 0.15), abs=0.002)
    assert box.w - 2 * box.edge_error < 0.1 and box.d - 2 * box.edge_error < 0.074


@pytest.mark.parametrize("side", [0.01, 0.02, 0.05, 0.12])
@pytest.mark.parametrize("yaw", [0.0, 0.6])
def test_a_dark_thing_beside_an_item_is_in_the_way_as_high_as_can_be(side, yaw):
    dark = Thing((0.222, 0.222), (side, side), 0.0, 0.03, yaw, dark=True)
    item = replace(ITEM, centre=(0.1, 0.1))
    found = items(*see("bin", item, dark))
    (box,) = [each for each in found if type(each) is Box]
    assert (box.x, box.y) == pytest.approx((0.1, 0.1), abs=0.002)
    (hole,) = [each for each in found if isinstance(each, UnknownBox)]
    axes = camera_truth.turned(np.radians(hole.yaw))
    assert (np.abs((dark.corners - (hole.x, hole.y)) @ axes) < np.array((hole.w, hole.d)) / 2 + 1e-3).all()
    assert hole.h == 0.25 and isinstance(hole, HiddenBox)


def test_a_dark_thing_on_an_item_keeps_it_from_being_picked():
    on_top = Thing((0.16, 0.15), (0.02, 0.02), 0.06, 0.1, dark=True)
    with pytest.raises(DepthMapError, match="not seen well enough"):
        items(*see("bin", ITEM, on_top))


def test_a_thin_thing_is_in_the_way():
    post = Thing((0.22, 0.15), (0.008, 0.008), 0.0, 0.06)
    found = items(*see("bin", replace(ITEM, centre=(0.1, 0.15)), post))
    assert [type(box) for box in found] == [Box, UnknownBox]
    assert abs(found[1].x - 0.22) < found[1].w / 2 and abs(found[1].y - 0.15) < found[1].d / 2 and found[1].h > 0.055


def test_the_cup_goes_where_an_item_is_for_sure():
    cell = replace(camera_truth.CELLS["cup"][0], bin_items=1)
    planner, tote = Planner(cell, planner="joint_dbl"), np.full((75, 60), 0.22)
    for error, status in ((0.0, "ok"), (0.03, "impossible")):
        box = Box(0.15, 0.15, 0.12, 0.12, 0.06, edge_error=error)
        assert planner.plan(Scene([box], tote, cell_size=0.02, tote_height=0.22)).status == status
    with pytest.raises(DepthMapError, match=r"items\[0\].edge_error=-1: expected a length from 0 to 1000 m"):
        Scene([Box(0.15, 0.15, 0.09, 0.09, 0.06, edge_error=-1)], tote, cell_size=SIZE)


def test_a_strip_through_an_item_may_part_two():
    eye, image = see("bin", ITEM)
    image[:, 158:160] = np.nan
    with pytest.raises(DepthMapError, match="not seen well enough"):
        items(eye, image)


def test_something_higher_than_an_item_may_be_is_refused():
    hand = Thing((0.15, 0.15), (0.091, 0.102), 0.25, 0.29)
    with pytest.raises(DepthMapError, match=r"something 0.29\d m high is seen in the bin, expected items up to 0.25 m"):
        items(*see("bin", hand))
    assert len(items(*see("bin", ITEM))) == 1
    with pytest.raises(DepthMapError, match=r"something 0.06\d m high is seen in the bin, expected items up to 0.04 m"):
        items(*see("bin", ITEM), greatest_height=0.04)


def test_an_arm_over_a_wall_is_refused():
    arm = Thing((0.32, 0.15), (0.3, 0.06), 0.09, 0.12)
    with pytest.raises(DepthMapError, match=r"something 0.12\d m high reaches over a wall of the bin"):
        items(*see("bin", arm))


@pytest.mark.parametrize("rise", [0.01, 0.02, 0.04])
def test_a_top_that_slopes_is_refused(rise):
    with pytest.raises(DepthMapError, match=r"has a top that slopes by 0.0\d\d m, expected a level one"):
        items(*see("bin", replace(ITEM, slope=(rise / ITEM.sides[0], 0.0))))


# ---------------------------------------------------------------------------------------------------- the tote


@pytest.mark.parametrize("side", [0.01, 0.02, 0.05, 0.1])
@pytest.mark.parametrize("centre", [(0.15, 0.15), (0.07, 0.2), (0.24, 0.06)])
def test_a_hole_in_the_tote_reaches_up_to_the_rim(side, centre):
    dark = Thing(centre, (side, side), 0.0, 0.06, dark=True)
    found = tote_map(*see("tote", dark))
    assert (part_of(found.highest, dark) == 0.25).all() and (part_of(found.lowest, dark) == 0).all()
    assert np.median(found.highest) < 0.005 and (found.lowest <= found.highest).all()
    assert found.has_holes and not tote_map(*see("tote", replace(dark, dark=False))).has_holes


def test_a_masked_pixel_is_unknown():
    eye, image = see("tote")
    mask = np.zeros(image.shape, bool)
    mask[100:140, 140:180] = True
    hidden, masked = (tote_map(eye, each) for each in (np.where(mask, 0, image), np.ma.masked_array(image, mask)))
    assert masked.has_holes and (masked.highest == hidden.highest).all()


@pytest.mark.parametrize("pixel", [0.001, 0.0013])
@pytest.mark.parametrize("gap", [0.0003, 0.002])
@pytest.mark.parametrize("yaw", [0, 2])
def test_an_item_at_a_wall_is_measured_by_fine_pixels(pixel, gap, yaw, monkeypatch):
    """Though the border along the wall, in which no top is seen, is several pixels wide."""
    monkeypatch.setattr(camera_truth, "SHAPE", (400, 480))
    thing = Thing((0.0, 0.15), (0.1, 0.08), 0.0, 0.06, np.radians(yaw))
    thing = replace(thing, centre=(gap - thing.polygon(thing.sides)[:, 0].min(), 0.15))
    truth = Truth((0.3, 0.3, 0.1), ROOMS["tote"], in_bin=[thing])
    eye = Camera.looking_down((0.15, 0.15), 1.2, 1.2 / pixel, camera_truth.SHAPE)
    depth, dark = camera_truth.cast(eye.rays(), eye.pose[:3, 3], truth, "bin")
    noise = np.random.default_rng(0).normal(0, 0.001, depth.shape)
    (box,) = eye.items(np.where(dark, np.nan, depth + noise), CELL, SIZE, bin_height=0.1)
    corners = (thing.polygon(thing.sides) - (box.x, box.y)) @ turned_axes(np.radians(box.yaw)).T
    assert type(box) is Box and (np.abs(corners) < np.add((box.w, box.d), 2 * pixel) / 2).all()
    assert box.w - box.edge_error < 0.102 and box.edge_error < 0.005


def test_a_hole_in_a_top_supports_nothing():
    lower, dark = Thing((0.15, 0.15), (0.1, 0.1), 0.0, 0.08), Thing((0.15, 0.15), (0.03, 0.03), 0.0, 0.081, dark=True)
    found = tote_map(*see("tote", lower, dark))
    assert (part_of(found.lowest, dark) == 0).all() and part_of(found.lowest, lower, 0.01).max() > 0.075


def test_a_dark_box_on_another_is_unknown_up_to_the_rim():
    lower = Thing((0.15, 0.1), (0.1, 0.1), 0.0, 0.08)
    dark = Thing((0.13, 0.11), (0.03, 0.04), 0.08, 0.12, dark=True)
    found = tote_map(*see("tote", lower, dark))
    assert (part_of(found.highest, dark) == 0.25).all()


def test_the_record_explains_a_hole():
    dark = Thing((0.1, 0.2), (0.08, 0.06), 0.0, 0.06, dark=True)
    eye, image = see("tote", dark)
    record = [Box(0.102, 0.199, 0.08, 0.06, 0.06)]
    found = tote_map(eye, image, placed=record)
    assert (part_of(found.highest, dark) >= 0.06).all() and found.highest.max() < 0.07
    assert (part_of(found.lowest, dark) == 0).all()
    # One that slid away is not where the record says.
    slid = tote_map(eye, image, placed=[Box(0.14, 0.2, 0.08, 0.06, 0.06)])
    assert (part_of(slid.highest, replace(dark, centre=(0.075, 0.2), sides=(0.03, 0.06))) == 0.25).all()
    assert (part_of(slid.highest, dark) >= 0.06).all()
    # The record of what is seen changes nothing.
    eye, image = see("tote", replace(dark, dark=False))
    image[np.random.default_rng(1).random(SHAPE) < 0.05] = np.nan
    for one, other in zip(tote_map(eye, image)[:2], tote_map(eye, image, placed=record)[:2], strict=True):
        assert np.array_equal(one, other)


def test_plans_make_the_record():
    planner = Planner(CELL, planner="joint_dbl")
    views = [see("bin", replace(ITEM, yaw=0.5)), see("tote")]
    plan = planner.plan(Scene.from_images(CELL, *views, SIZE))
    placed = plan.placed
    assert (
        plan.status == "ok" and placed.yaw == pytest.approx(0, abs=1e-5) and placed.h == pytest.approx(0.06, abs=0.004)
    )
    dark = Thing((placed.x, placed.y), (placed.w, placed.d), 0.0, placed.h, dark=True)
    views[1] = see("tote", dark)
    scene = Scene.from_images(CELL, *views, SIZE, placed=[placed])
    assert scene.tote.highest.max() < 0.07 and (part_of(scene.tote.highest, dark) > 0.055).all()
    assert planner.plan(scene).status == "ok"
    assert planner.plan(Scene.from_maps(np.pad([[1]], ((2, 3), (2, 3))), np.full((6, 6), 5))).placed is None


def test_black_walls_do_not_fill_the_tote():
    eye, image = see("tote")
    places = eye.points(np.nan_to_num(see("tote", noise=0.0)[1]))
    image[(places[..., 2] > 0.004) & (places[..., 2] < 0.245)] = np.nan
    assert tote_map(eye, image).highest.max() < 0.01


def test_something_above_the_rim_is_refused():
    hand = Thing((0.15, 0.15), (0.1, 0.1), 0.3, 0.33)
    with pytest.raises(
        DepthMapError, match=r"something 0.3\d\d m high is seen in the tote, expected up to 0.25 m, its rim"
    ):
        tote_map(*see("tote", hand))


@pytest.mark.parametrize("width", [0.03, 0.05])
@pytest.mark.parametrize(("yaw", "height"), [(0.0, 0.27), (0.6, 0.35)])
def test_something_dark_above_the_rim_is_refused(width, yaw, height):
    """It hides a place that is not below it, from a camera that does not look straight down."""
    arm = Thing((0.05, 0.15), (0.3, width), height - 0.02, height, yaw, dark=True)
    with pytest.raises(DepthMapError, match="the rim of the tote has no depth over 20 mm or more, expected to see it"):
        tote_map(*see("tote", arm))


def test_a_black_rim_is_no_hand():
    eye, image = see("tote", Thing((0.05, 0.06), (0.08, 0.1), 0.0, 0.2))
    places = eye.points(np.nan_to_num(see("tote", noise=0.0)[1]))
    image[places[..., 2] > 0.004] = np.nan
    highest = tote_map(eye, image).highest
    assert highest[len(highest) // 2 :].max() < 0.01


def test_a_bad_image_is_not_called_stuck():
    """The tote would be exchanged."""
    planner, bin_view = Planner(CELL, planner="joint_dbl"), see("bin", ITEM)
    dark = Thing((0.15, 0.15), (0.05, 0.05), 0.0, 0.06, dark=True)  # below the effector wherever it lets go
    scene = Scene.from_images(CELL, bin_view, see("tote", dark), SIZE)
    with pytest.raises(DepthMapError, match="no plan avoids what the images leave unknown in bin and tote"):
        planner.plan(scene)
    full = see("tote", Thing((0.15, 0.15), (0.28, 0.28), 0.0, 0.22))
    full[1][np.random.default_rng(1).random(SHAPE) < 0.03] = np.nan
    assert planner.plan(Scene.from_images(CELL, bin_view, full, SIZE)).status == "stuck"


# ---------------------------------------------------------------------------------------------------- the floor


def moved(eye: Camera, turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), about=(0.15, 0.15, 0.0)) -> Camera:
    """The camera with a wrong pose: turned about a point by degrees, and shifted."""
    pose = eye.pose.copy()
    rotation = camera_truth.about(turn, np.radians(np.linalg.norm(turn))) if any(turn) else np.eye(3)
    pose[:3, :3] = rotation @ pose[:3, :3]
    pose[:3, 3] = np.array(about) + rotation @ (pose[:3, 3] - about) + shift
    return replace(eye, pose=pose)


@pytest.mark.parametrize("name", ["bin", "tote"])
@pytest.mark.parametrize(
    "wrong",
    [
        *({"shift": sign * np.eye(3)[axis] * 0.01} for axis in range(3) for sign in (-1, 1)),
        *({"turn": sign * np.eye(3)[axis] * 3} for axis in range(3) for sign in (-1, 1)),
        *({"turn": np.eye(3)[axis] * 3, "about": (0.15, 0.15, 1.2)} for axis in range(3)),
    ],
)
def test_a_wrong_pose_is_refused(name, wrong):
    eye, image = see(name, ITEM, replace(ITEM, centre=(0.08, 0.25)))
    read = items if name == "bin" else tote_map
    read(eye, image)
    with pytest.raises(DepthMapError, match=f"the {name}"):
        read(moved(eye, **wrong), image)


def test_the_inverse_of_a_pose_is_refused():
    eye, image = see("bin", ITEM)
    with pytest.raises(DepthMapError, match="the bin"):
        items(replace(eye, pose=np.linalg.inv(eye.pose)), image)


@pytest.mark.parametrize("bin_sides", [(0.25, 0.25, 0.05), (0.3, 0.3, 0.05), (0.35, 0.3, 0.05)])
def test_the_image_of_the_bin_is_none_of_the_tote(bin_sides):
    eye, image = see("bin", ITEM, room=bin_sides)
    with pytest.raises(DepthMapError, match="the tote"):
        tote_map(eye, image)


def test_a_table_is_no_tote():
    eye, _ = see("tote")
    with pytest.raises(DepthMapError, match="goes on .* beyond its walls|no wall of the tote is seen"):
        tote_map(eye, np.full(SHAPE, 1.2))


def test_a_transposed_image_is_refused():
    eye, image = see("bin", ITEM)
    with pytest.raises(
        DepthMapError, match=r"got shape \[320, 240\], expected \[240, 320\], .*; the image is transposed"
    ):
        items(eye, image.T)
    with pytest.raises(ValueError, match="camera.shape=240: expected"):
        Camera(500, 500, 160, 120, eye.pose, 240)


# ---------------------------------------------------------------------------------------------------- end to end


def test_plans_from_bad_images_are_right_in_the_true_scene():
    """The short version of tests/long/camera_truth.py."""
    counts, false, good = camera_truth.run(range(40))
    assert not false, false
    assert sum(count for (_, status), count in counts.items() if status == "ok") > 5, counts
