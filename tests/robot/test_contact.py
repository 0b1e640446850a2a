"""A sliver of contact, items in a bin that must not forbid each other, and maps of points: `ok` only if it is so."""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import fault, plan_for, random_scene
from test_measured import CELL, EFFECTORS, NOISE, TOTE, make_planner

from pickplace import Box, CellSpec, Planner
from pickplace.robot import planner as robot_planner

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "long"))
import refusals  # noqa: E402

SEAL = {"effector_size": (7, 7), "body": "disc", "cup": "disc", "cup_size": (3, 3), "pick_rule": "seal"}


@pytest.fixture(autouse=True)
def no_reasons(monkeypatch):
    """Why a plan is not ok takes most of the time of a refusal."""
    monkeypatch.setattr(robot_planner, "_reasons", lambda *_: {})


def slabs(end: float) -> np.ndarray:
    """Remaining heights of a tote of 240 x 140 x 220 mm, with slabs of 100 mm up to ``end`` from both ends; 2.5 mm."""
    depth, begin = np.full((96, 56), 0.22), np.arange(96) * 0.0025
    depth[(begin < end - 1e-9) | (begin + 0.0025 > 0.22 - end + 1e-9)] = 0.12
    return depth


@pytest.mark.parametrize("name", ["joint_dbl", "pretrained/warehouse"])
@pytest.mark.parametrize(("end", "error", "status"), [
    (0.051, None, "stuck"), (0.051, 0.0, "stuck"), (0.055, 0.0, "ok"), (0.066, None, "ok"), (0.0625, 0.003, "ok"),
    (0.055, 0.005, "stuck"),
])  # fmt: skip
def test_a_sliver_of_contact_carries_nothing(name, end, error, status):
    """The item of 120 mm lies at x 50 to 170 mm, on the ends of two slabs."""
    sizes = {"bin_size": (15, 15, 4), "tote_size": (12, 7, 44)}
    cell = CellSpec(**sizes, height_unit=0.25, **SEAL)
    planner = Planner(cell, planner=name) if name == "joint_dbl" else Planner.load(name, **sizes)
    seen = {"tote_depth": slabs(end), "tote_height": 0.22, "cell_size": 0.02, "placement_error": error}
    plan = plan_for(planner, items=[Box(0.15, 0.15, 0.12, 0.12, 0.06)], **seen, alternatives=0)
    assert plan.status == status


@pytest.mark.parametrize("wrong_by", [0.0, 0.005])
def test_no_item_lies_on_an_end_that_sticks_out_of_a_square(wrong_by):
    """B sticks out over A by half the side of an item: its centre stays above A, though a square shows only A's end."""
    planner, tote = Planner(CellSpec(tote_size=(3, 3, 10)), planner="joint_dbl"), np.zeros((15, 15))
    seen, sides = {"placed": []}, [(0.091, 0.05), (0.112, 0.01), (0.04, 0.4)]
    for w, h in sides:
        plan = plan_for(planner, items=[Box(0.125, 0.125, w, 0.14, h)], tote_depth=0.5 - tote, cell_size=CELL, **seen)
        box = plan.placed
        covered = [range(int((middle - side / 2) // 0.01), -int(-(middle + side / 2) // 0.01))
                   for middle, side in ((box.x, box.w), (box.y, box.d))]  # fmt: skip
        tote[np.ix_(*covered)] = box.h
        seen = {"placed": [*seen["placed"], box], "tote_bearing": plan.tote_bearing}
    under, _, last = seen["placed"]
    assert last.h > 0.4 and abs(last.x - under.x) + wrong_by < under.w / 2


@pytest.mark.parametrize("support", ["full", "bearing"])
@pytest.mark.parametrize(("squares", "item", "rail", "rails"), [
    (5, 0.04, 0.0102, (0.025, 0.075, 0.125, 0.175, 0.225, 0.275)), (2, 0.096, 0.002, (0.1, 0.2)),
])  # fmt: skip
def test_a_narrow_rail_carries_nothing(support, squares, item, rail, rails):
    """It is narrower than two squares, and reaches into a square on both sides of the item's middle."""
    planner = Planner(CellSpec(tote_size=(6, 6, 5), support=support), planner="joint_dbl")
    depth, begin = np.full((6 * squares,) * 2, 0.2), np.arange(6 * squares) * CELL / squares
    for middle in rails:
        depth[(begin < middle + rail / 2) & (begin + CELL / squares > middle - rail / 2)] = 0.15
    seen = {"tote_height": 0.25, "cell_size": CELL, "clearance": 0.002, "placement_error": 0.0, "alternatives": 0}
    for tote_depth, status in ((np.full_like(depth, 0.2), "ok"), (depth, "stuck")):
        plan = plan_for(planner, items=[Box(0.125, 0.125, item, 0.1, 0.04)], tote_depth=tote_depth, **seen)
        assert plan.status == status


WIDE = CellSpec(bin_size=(25, 20, 10), tote_size=(20, 15, 44), height_unit=0.25, **SEAL)
LARGE, SMALL = Box(0.1, 0.28, 0.159, 0.096, 0.06, 0.5), Box(0.31, 0.271, 0.071, 0.067, 0.06, -74.9)
EMPTY = {"tote_depth": np.full((100, 75), 0.22), "cell_size": 0.02, "clearance": 0.008}


def test_an_item_on_which_the_cup_does_not_fit_forbids_no_other():
    planner = Planner(WIDE, planner="joint_dbl")
    assert plan_for(planner, items=[LARGE], **EMPTY).status == "ok"
    for items, number in (([LARGE, SMALL], 0), ([SMALL, LARGE], 1), ([SMALL, LARGE, SMALL_TOO], 1)):
        plan = plan_for(planner, items=items, **EMPTY)
        assert (plan.status, plan.item_number, plan.hints) == ("ok", number, [])


SMALL_TOO = replace(SMALL, x=0.45)


def test_a_plan_says_on_which_items_the_cup_does_not_fit():
    planner = Planner(WIDE, planner="joint_dbl")
    plan = plan_for(planner, items=[SMALL], **EMPTY)
    assert plan.status == "impossible"
    assert plan.hints == ["items[0]: the cup does not fit on this item, with cells of 20 mm; no pick takes it."]
    full = {**EMPTY, "tote_depth": np.full((100, 75), 0.01)}
    plan = plan_for(planner, items=[LARGE, SMALL], **full)
    assert plan.status == "stuck"
    assert plan.hints == ["items[1]: the cup does not fit on this item, with cells of 20 mm; no pick takes it."]
    plate = Planner(CellSpec(bin_size=(6, 6, 1)), planner="joint_dbl")
    plan = plan_for(plate, items=[Box(0.15, 0.15, 0.16, 0.1, 0.06)], tote_depth=np.full((30, 30), 0.25), cell_size=CELL)
    assert plan.hints == ["items[0]: the cup does not cover this item, with cells of 50 mm; no pick takes it."]
    depth = np.zeros((6, 6), dtype=int)
    depth[:4, :2] = 1
    for labels, name in ((None, "bin_depth"), (7 * depth, "bin_depth with label 7")):
        seen = plan_for(plate, depth, np.full((6, 6), 5), bin_labels=labels)
        assert seen.hints == [f"{name}: the cup does not cover this item; no pick takes it."]
    depth[3] = 0
    assert plan_for(plate, depth, np.full((6, 6), 0)).hints == []


@pytest.mark.parametrize("name", ["disc", "L", "half"])
@pytest.mark.parametrize("scenes", [40, pytest.param(1_000, marks=pytest.mark.slow)])
def test_bodies_of_any_shape_touch_no_other_item(name, scenes):
    settings, side, gripper = EFFECTORS[name]
    draw, found = np.random.default_rng(3), Counter()
    bin_cells, cells = round(0.4 / side), round(0.3 / side)
    sizes = {"bin_size": (bin_cells, bin_cells, round(0.05 / side)), "tote_size": (cells, cells, round(0.25 / side))}
    planner = Planner(CellSpec(**sizes, **settings), planner="joint_dbl")
    effector = tuple(np.multiply(planner.cell.gripper.size, side))
    for _ in range(scenes):
        scene = random_scene(draw, TOTE, (0.15, 0.15, 0.1), bin=(0.4, 0.4, 0.05), effector=effector, gripper=gripper)
        scene.item, scene.boxes = tuple(draw.uniform(0.07, (0.15, 0.15, 0.1))), scene.boxes[:4]
        scene.centre = tuple(draw.uniform(0.11, 0.29, 2))
        scene.add_others(draw, int(draw.integers(1, 4)), (0.15, 0.15, 0.1))
        boxes = [
            Box(*(centre + draw.uniform(-0.0035, 0.0035, 2)), w, d, h + draw.uniform(-NOISE, NOISE), yaw)
            for (w, d, h), centre, yaw in scene.in_bin()
        ]
        tote = scene.tote_map(200, draw.uniform(-NOISE, NOISE, (60, 60)))
        seen = {
            "tote_depth": tote,
            "tote_height": scene.tote[2],
            "bin_height": scene.bin[2],
            "cell_size": side,
            "accuracy": NOISE,
        }
        plan = plan_for(planner, items=boxes, **seen, alternatives=0)
        status = plan.status
        if status == "ok":
            status = fault(scene.taking(plan.item_number), plan, NOISE, 0.0) or "ok"  # it lies off the box
        found[status] += 1
    assert set(found) <= {"ok", "stuck", "impossible"} and found["ok"] > scenes / 4, found


@pytest.mark.parametrize("scenes", [100, pytest.param(3_000, marks=pytest.mark.slow)])
def test_a_map_of_points_says_so_and_is_read_as_one(scenes):
    """Values at the centres of squares of 10 mm; boxes are wider than two squares."""
    planner, draw, found = make_planner("joint_dbl"), np.random.default_rng(0), Counter()
    centres = (np.indices((30, 30)).transpose(1, 2, 0) + 0.5) * 0.01
    for _ in range(scenes):
        scene = random_scene(draw, TOTE)
        heights = np.zeros((30, 30))
        for x0, y0, x1, y1, top in scene.boxes:
            over = ((centres > (x0, y0)) & (centres < (x1, y1))).all(2)
            heights[over] = np.maximum(heights[over], top)
        box = Box(*scene.centre, *scene.item[:2], scene.item[2], scene.yaw)
        tote = scene.tote[2] - heights - draw.uniform(-NOISE, NOISE, (30, 30))
        for samples in ("area", "centre"):
            plan = plan_for(
                planner, items=[box], tote_depth=tote, tote_height=scene.tote[2], cell_size=CELL, accuracy=NOISE,
                tote_samples=samples, alternatives=0,
            )  # fmt: skip
            status = plan.status if plan.status != "ok" else fault(scene, plan, NOISE) or "ok"
            found[samples, "fault" if status not in ("ok", "stuck", "impossible") else status] += 1
    assert found["centre", "fault"] == 0 and found["centre", "ok"] > scenes / 5, found
    assert found["area", "fault"] > 0, found


@pytest.mark.parametrize("name", refusals.CASES)
def test_hardly_a_scene_is_refused_that_is_feasible(name):
    """With half a cell to spare: 4% of the refused ones at most; ``tests/long/refusals.py`` looks at thousands."""
    found, missed, _ = refusals.count(refusals.CASES[name], 40, 5)
    assert found["ok"] > 10 and sum(missed.values()) <= 0.04 * (40 - found["ok"]), (found, missed)


def test_the_brute_force_search_finds_what_plans_do():
    """Without anything to spare, nearly every plan that is ok has a motion."""
    case, draw, ok, seen = refusals.CASES["round cup"], np.random.default_rng(0), 0, 0
    planner = Planner(case.cell, planner="joint_dbl")
    for _ in range(30):
        world = refusals.random_world(case, draw)
        if planner.plan(refusals.measured(case, world, draw), alternatives=0).status == "ok":
            ok, seen = ok + 1, seen + refusals.is_feasible(case, world, 0.0)
    assert ok >= 10 and seen >= 0.9 * ok, (seen, ok)
