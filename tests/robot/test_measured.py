"""Plans from measured maps and boxes, against plane geometry: what is called `ok` must be so."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from plane import disc
from scenes import Gripper, World, fault, plan_for, random_scene, rectangle, squares

from pickplace import CellSpec, DepthMapError, Planner
from pickplace.robot import planner as robot_planner
from pickplace.robot.measure import box_of_map, is_inside
from pickplace.robot.planner import Box
from pickplace.rules.reach.base import Limits
from pickplace.rules.support.rules import Hull

CELL, TOTE = 0.05, (0.3, 0.3, 0.25)
SIZES = {"tote_size": (6, 6, 5)}
NOISE = 0.002


def make_planner(name: str, **options) -> Planner:
    cell = CellSpec(**SIZES, **options)
    return Planner(cell, planner=name) if name == "joint_dbl" else Planner.load(name, **SIZES)


def plan_of(planner: Planner, scene: World, draw: np.random.Generator, along: int = 5, accuracy=NOISE, **settings):
    """A plan from a map with ``along`` values along a cell and from a measured box, both with noise."""
    noise = draw.uniform(-accuracy, accuracy, (6 * along, 6 * along))
    box = Box(*scene.centre, *scene.item[:2], scene.item[2] + draw.uniform(-accuracy, accuracy), scene.yaw)
    maps = scene.tote_map(round(along / CELL), noise)
    settings = {"accuracy": accuracy, "alternatives": 0} | settings
    return plan_for(planner, items=[box], tote_depth=maps, tote_height=scene.tote[2], cell_size=CELL, **settings)


def count_faults(name: str, scenes: int, seed: int, along: int = 5, accuracy: float = NOISE, **options) -> Counter:
    planner, draw, found = make_planner(name, **options), np.random.default_rng(seed), Counter()
    for _ in range(scenes):
        scene = random_scene(draw, TOTE)
        plan = plan_of(planner, scene, draw, along, accuracy)
        found[(fault(scene, plan, accuracy) or "ok") if plan.status == "ok" else plan.status] += 1
    return found


@pytest.mark.parametrize(("along", "accuracy", "options"), [
    (1, 0.002, {}), (2, 0.002, {}), (5, 0.002, {}), (8, 0.005, {}), (11, 0.0, {}),
    (5, 0.002, {"support": "half"}), (4, 0.003, {"support": "full", "rotations": 2}),
    (5, 0.002, {"support": Hull(0.0), "rotations": 3}),
    (5, 0.002, {"support": "half_or_hull"}), (5, 0.002, {"support": "corners"}),
])  # fmt: skip
@pytest.mark.parametrize("scenes", [70, pytest.param(2_000, marks=pytest.mark.slow)])
def test_no_plan_that_is_ok_goes_wrong(scenes, along, accuracy, options):
    found = count_faults("joint_dbl", scenes, along, along, accuracy, **options)
    assert set(found) <= {"ok", "stuck", "impossible"} and found["ok"] > 15, found


L_BODY, L_CUP = [[1, 1, 1], [1, 0, 0], [1, 1, 0]], [[0, 0, 1], [0, 0, 0], [1, 0, 0]]
HALF_CUP = [[1, 1], [1, 0], [0, 0]]


def ones(mask):
    return [(x, y) for x, column in enumerate(mask) for y, cell in enumerate(column) if cell]


#: End effectors: options of the cell, side of a cell, and what the gripper is in metres.
EFFECTORS = {
    "one cell": ({"effector_size": (1, 1), "pick_rule": "seal"}, 0.05,
                 Gripper(squares([(0, 0)], (1, 1), 0.05), squares([(0, 0)], (1, 1), 0.05), 1.0)),
    "disc": ({"effector_size": (7, 7), "body": "disc", "cup": "disc", "cup_size": (3, 3), "pick_rule": "seal"}, 0.02,
             Gripper([disc(0.14)], [disc(0.06)], 1.0)),
    "array": ({"cup": [[1, 0, 1], [0, 0, 0], [1, 0, 1]], "pick_rule": "seal", "min_seal": 0.25}, 0.05,
              Gripper([rectangle((0, 0), (0.15, 0.15), 0)],
                      squares([(0, 0), (0, 2), (2, 0), (2, 2)], (3, 3), 0.05), 0.25)),
    "L": ({"body": L_BODY, "cup": L_CUP, "pick_rule": "overlap"}, 0.05,
          Gripper(squares(ones(L_BODY), (3, 3), 0.05), squares(ones(L_CUP), (3, 3), 0.05), 0.5)),
    "half": ({"effector_size": (3, 2), "cup": HALF_CUP, "pick_rule": "seal", "min_seal": 2 / 3}, 0.025,
             Gripper([rectangle((0, 0), (0.075, 0.05), 0)], squares(ones(HALF_CUP), (3, 2), 0.025), 2 / 3)),
    "contain": ({"effector_size": (7, 5), "body": "disc", "cup_size": (3, 3)}, 0.05 / 2,
                Gripper([disc(1.0) * (0.175, 0.125)], [rectangle((0, 0), (0.075, 0.075), 0)], None)),
}  # fmt: skip


def scenes_of(name: str, scenes: int, seed: int, **options) -> Counter:
    """Plans with an end effector, from boxes of which the centre is wrong by up to the clearance."""
    (settings, side, gripper), draw, found = EFFECTORS[name], np.random.default_rng(seed), Counter()
    most = (0.08, 0.08, 0.15) if gripper.least is None else (0.2, 0.2, 0.15)
    bin_cells, cells = round(0.25 / side - 0.4), round(0.3 / side)
    sizes = {"bin_size": (bin_cells, bin_cells, round(0.05 / side)), "tote_size": (cells, cells, round(0.25 / side))}
    planner = Planner(CellSpec(**sizes, **settings, **options), planner="joint_dbl")
    effector = tuple(np.multiply(planner.cell.gripper.size, side))
    for _ in range(scenes):
        scene = random_scene(
            draw, TOTE, most, bin=tuple(np.multiply(planner.cell.bin_size, side)), effector=effector, gripper=gripper
        )
        noise, error = draw.uniform(-NOISE, NOISE, (60, 60)), draw.uniform(-0.0035, 0.0035, 2)
        box = Box(*(scene.centre + error), *scene.item[:2], scene.item[2] + draw.uniform(-NOISE, NOISE), scene.yaw)
        plan = plan_for(planner,
            items=[box], tote_depth=scene.tote_map(200, noise), tote_height=scene.tote[2], cell_size=side,
            accuracy=NOISE, alternatives=0,
        )  # fmt: skip
        # The item lies off the box by as much as it may be set down off its place.
        found[(fault(scene, plan, NOISE, 0.0) or "ok") if plan.status == "ok" else plan.status] += 1
    return found


@pytest.mark.parametrize("scenes", [120, pytest.param(2_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", EFFECTORS)
def test_no_end_effector_makes_an_ok_plan_go_wrong(name, scenes, monkeypatch):
    monkeypatch.setattr(robot_planner, "_reasons", lambda *_: {})  # why a plan is not ok: most of the time
    found = scenes_of(name, scenes, 7)
    assert set(found) <= {"ok", "stuck", "impossible"} and found["ok"] > 15, found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pretrained/r4", "pretrained/mixed", "joint_dbl"])
def test_no_plan_that_is_ok_goes_wrong_in_20_000_scenes(name):
    found = count_faults(name, 20_000, 100)
    assert set(found) <= {"ok", "stuck", "impossible"} and found["ok"] > 7_000, found


@pytest.mark.parametrize("name", ["pretrained/r4", "pretrained/mixed", "joint_dbl"])
def test_a_closed_loop_fills_totes_with_boxes_of_any_position(name):
    """120x80x60 mm, 2 mm noise: 12 of the 24 that lie in the tote in four layers, or more; `slow` plays 50 totes."""
    placed = [play(make_planner(name), np.random.default_rng(seed)) for seed in range(3)]
    assert min(placed) >= 12, placed


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pretrained/r4", "pretrained/mixed", "joint_dbl"])
def test_a_closed_loop_fills_50_totes(name):
    planner = make_planner(name)
    placed = [play(planner, np.random.default_rng(seed)) for seed in range(50)]
    assert min(placed) >= 9 and np.mean(placed) > 12, placed


def play(planner: Planner, draw: np.random.Generator) -> int:
    """Fill a tote; return the number of boxes."""
    boxes: list = []
    bearing = None
    while True:
        centre, yaw = tuple(draw.uniform(0.073, 0.177, 2)), draw.uniform(-180, 180)
        scene = World((0.25, 0.25, 0.05), TOTE, (0.15, 0.15), (0.12, 0.08, 0.06), centre, yaw, boxes)
        plan = plan_of(planner, scene, draw, tote_bearing=bearing)
        if plan.status != "ok":
            assert plan.status == "stuck" and sum(plan.reasons.values()) == planner.cell.num_actions
            return len(boxes)
        assert fault(scene, plan) is None
        scene.carry_out(plan)
        bearing = plan.tote_bearing


def test_a_low_box_is_no_floor_and_a_patch_that_is_covered_in_part_is_not_whole():
    low = World((0.25, 0.25, 0.05), (0.1, 0.1, 0.25), (0.1, 0.1), (0.08, 0.08, 0.06), (0.125, 0.125), 0.0)
    low.boxes.append((0, 0, 0.04, 0.1, 0.015))
    planner = Planner(CellSpec(tote_size=(2, 2, 5), effector_size=(2, 2)), planner="joint_dbl")
    assert (
        plan_for(planner, items=[Box(*low.centre, *low.item)], tote_depth=low.tote_map(200, 0), cell_size=CELL).status
        == "stuck"
    )
    for along in (2, 5, 10):
        wide = World((0.25, 0.25, 0.05), (0.15, 0.15, 0.25), (0.15, 0.15), (0.1, 0.1, 0.06), (0.125, 0.125), 0.0)
        wide.boxes.append((0, 0, 0.051, 0.15, 0.1))
        planner = Planner(CellSpec(tote_size=(3, 3, 5), support="half"), planner="joint_dbl")
        seen = {"tote_depth": wide.tote_map(20 * along, 0), "cell_size": CELL}
        plan = plan_for(planner, items=[Box(*wide.centre, *wide.item)], **seen)
        assert plan.status != "ok" or fault(wide, plan) is None


@pytest.mark.parametrize("along", [5, 10])
def test_the_share_of_an_item_that_is_carried_decides(along):
    """The item spans two boxes, so that its centre is over their hull: of its 8 cm they carry 2, or 6.

    Of the 6, a square at the inner edge of each box may be covered in part.
    """
    statuses = []
    for carried in (0.01, 0.03):
        scene = World((0.25, 0.25, 0.05), (0.1, 0.1, 0.25), (0.1, 0.1), (0.08, 0.08, 0.06), (0.125, 0.125), 0.0)
        scene.boxes += [(0, 0, 0.01 + carried, 0.1, 0.1), (0.09 - carried, 0, 0.1, 0.1, 0.1)]
        planner = Planner(CellSpec(tote_size=(2, 2, 5), effector_size=(2, 2), support=0.3), planner="joint_dbl")
        seen = {"tote_depth": scene.tote_map(20 * along, 0), "cell_size": CELL}
        statuses.append(plan_for(planner, items=[Box(*scene.centre, *scene.item)], **seen).status)
    assert statuses == ["stuck", "ok"]


def test_limits_of_the_robot_hold_for_the_pose_and_the_release():
    open_limits = Limits(torch.ones(25, dtype=torch.bool), torch.zeros(4, 6, 6).int(), torch.full((4, 6, 6), 9))
    boxes = [Box(0.11, 0.125, 0.06, 0.06, 0.06, yaw) for yaw in (0, 20, 40)]
    flat = {"tote_depth": np.full((30, 30), 0.25), "cell_size": CELL, "accuracy": 0.005}
    for box in boxes:
        assert plan_for(Planner(CellSpec(reach=open_limits), planner="joint_dbl"), items=[box], **flat).status == "ok"
        column = torch.zeros(5, 5, dtype=torch.bool)
        column[2] = True  # reference cells at x of 100 to 150 mm
        planner = Planner(CellSpec(reach=replace(open_limits, pick_ok=column.flatten())), planner="joint_dbl")
        plan = plan_for(planner, items=[box], **flat)
        assert plan.status != "ok" or plan.pick.center[0] == pytest.approx(0.125)
    for top, status in ((0.07, "ok"), (0.069, "impossible")):
        low = replace(open_limits, highest_top=torch.full((4, 6, 6), 7))
        cell = CellSpec(reach=low, height_unit=top / 7 / CELL)
        plan = plan_for(Planner(cell, planner="joint_dbl"), items=boxes[:1], tote_height=0.25, **flat)
        assert plan.status == status  # the suction face lets go at 60 mm and twice the accuracy


def test_few_boxes_are_refused():
    """At most 2% of 200 boxes of 120x80x60 mm at free positions in the bin, with an empty tote."""
    planner, draw, refused = make_planner("pretrained/r4"), np.random.default_rng(1), 0
    for _ in range(200):
        centre = tuple(draw.uniform(0.073, 0.177, 2))
        scene = World((0.25, 0.25, 0.05), TOTE, (0.15, 0.15), (0.12, 0.08, 0.06), centre, draw.uniform(-180, 180))
        plan = plan_of(planner, scene, draw)
        refused += plan.status != "ok"
        assert plan.status != "ok" or fault(scene, plan) is None
    assert refused <= 4


def test_an_item_is_read_from_a_fine_map():
    """The rectangle holds the item, and is hardly larger; turned, or parallel to the walls."""
    draw, side = np.random.default_rng(3), 0.25 / 250
    centres = (np.indices((250, 250)).transpose(1, 2, 0) + 0.5) * side
    for yaw in (0.0, 90.0, 0.5, 1, 2, 3, 4, 6, 30.0, -70.0, *draw.uniform(-180, 180, 10)):
        x, y, turn = *draw.uniform(0.08, 0.17, 2), np.radians(yaw)
        away = centres - (x, y)
        along = np.abs(away @ [np.cos(turn), np.sin(turn)]), np.abs(away @ [-np.sin(turn), np.cos(turn)])
        heights = np.where((along[0] < 0.06) & (along[1] < 0.04), 0.06, 0.0) + draw.uniform(0, 0.002, (250, 250))
        box = box_of_map(heights, side, 0.002)
        assert np.hypot(box.x - x, box.y - y) < 0.003 and 0.06 <= box.h <= 0.062
        expected = Box(x, y, 0.12, 0.08, 0.06, yaw).upright()
        if abs(expected.yaw) > 10 and abs(expected.yaw) < 44:
            assert box.yaw == pytest.approx(expected.yaw, abs=2)
        assert sorted((box.w, box.d)) == pytest.approx([0.08, 0.12], abs=0.006)


@pytest.mark.parametrize("shows", ["touched", "centre"])
@pytest.mark.parametrize("side", [0.01, 0.004])
def test_an_item_surely_fills_the_box_that_a_map_of_coarse_squares_shows(shows, side):
    """Without its edge error; a square shows the item if it touches the square, or if it covers the square's middle."""
    draw, fine = np.random.default_rng(4), 5
    points = (np.indices((round(0.24 / side) * fine,) * 2).transpose(1, 2, 0) + 0.5) * side / fine
    for yaw in (0.0, 1.0, 45.0, *draw.uniform(-45, 45, 20)):
        item = Box(*draw.uniform(0.1, 0.14, 2), *draw.uniform(0.07, 0.12, 2), 0.06, yaw)
        seen = is_inside(points, (item.x, item.y), (item.w, item.d), yaw).reshape(-1, fine, len(points) // fine, fine)
        box = box_of_map(np.where(seen.any((1, 3)) if shows == "touched" else seen[:, 2, :, 2], 0.06, 0.0), side, 0.002)
        sure = rectangle((box.x, box.y), np.array((box.w, box.d)) - 2 * box.edge_error, box.yaw)
        assert is_inside(sure, (item.x, item.y), (item.w + 1e-9, item.d + 1e-9), yaw).all()
        assert box.edge_error <= 3 * side
        corners = rectangle((item.x, item.y), (item.w, item.d), yaw)
        beyond = side / fine if shows == "touched" else side  # an item reaches past the points that show it
        assert is_inside(corners, (box.x, box.y), (box.w + 2 * beyond, box.d + 2 * beyond), box.yaw).all()


def test_two_items_that_are_seen_as_such_are_refused():
    heights = np.zeros((50, 50))
    heights[10:20, 10:20] = 0.06
    heights[22:30, 10:20] = 0.06
    planner = make_planner("joint_dbl")
    with pytest.raises(DepthMapError, match=r"bin_depth\[20, 12\]: got 0 m, expected 0.06 m: one cuboid, 0.1 x 0.05 m"):
        plan_for(planner, heights, np.full((6, 6), 0.25), cell_size=CELL)
    heights[20:22, 10:20] = 0.04  # a lower one between them
    with pytest.raises(DepthMapError, match="got 0.04 m, expected 0.06 m"):
        plan_for(planner, heights, np.full((6, 6), 0.25), cell_size=CELL)


@pytest.mark.parametrize("along", [10, 11, 13, 16])
def test_maps_of_any_resolution_show_what_carries(along):
    """An item on another one, whose height is no whole number of millimetres, measured exactly."""
    planner, scene = (
        make_planner("joint_dbl"),
        World((0.25, 0.25, 0.05), (0.3, 0.3, 0.25), (0.15, 0.15), (0.14, 0.14, 0.05), (0.125, 0.125), 0),
    )
    scene.boxes = [(x, y, x + 0.15, y + 0.15, 0.0605) for x in (0, 0.15) for y in (0, 0.15)]
    plan = plan_of(planner, scene, np.random.default_rng(0), along, accuracy=0.0)
    assert plan.status == "ok" and plan.drop_height == pytest.approx(0.061) and fault(scene, plan, 0.0) is None


def test_a_robot_that_turns_nothing():
    planner = Planner(CellSpec(rotations=1), planner="joint_dbl")
    flat = {"tote_depth": np.full((6, 6), 0.25), "cell_size": CELL}
    plan = plan_for(planner, items=[Box(0.1, 0.1, 0.08, 0.12, 0.06, yaw=180)], **flat)
    assert plan.status == "ok" and plan.rotation_degrees == 0
    with pytest.raises(DepthMapError, match=r"items\[0\].yaw=30: expected 0 with rotations=1"):
        plan_for(planner, items=[Box(0.1, 0.1, 0.08, 0.12, 0.06, yaw=30)], **flat)


@pytest.mark.parametrize("name", ["joint_dbl", "corner", "random", "individual_heuristic", "lookahead", "mcts"])
def test_any_planner_serves_a_robot(name):
    flat = {"tote_depth": np.full((30, 30), 0.25), "cell_size": CELL, "alternatives": 0}
    scene = World((0.25, 0.25, 0.05), TOTE, (0.15, 0.15), (0.12, 0.08, 0.06), (0.11, 0.12), 20.0)
    if name in ("joint_dbl", "corner", "random", "individual_heuristic"):
        planner = Planner(CellSpec(**SIZES), planner=name)
    else:
        planner = Planner.load("pretrained/mixed", planner=name, **SIZES)
    plan = plan_for(planner, items=[Box(*scene.centre, *scene.item, scene.yaw)], **flat)
    assert plan.status == "ok" and fault(scene, plan) is None
    assert plan.rotation_degrees % 90 == pytest.approx(70)


def test_warnings_name_what_lies_outside_the_training():
    flat = {"cell_size": CELL, "alternatives": 0}
    planner = Planner.load("pretrained/r4", tote_size=(7, 6, 5), effector_size=(4, 4))
    plan = plan_for(planner, items=[Box(0.1, 0.1, 0.12, 0.08, 0.06)], tote_depth=np.full((7, 6), 0.25), **flat)
    assert [warning.partition(" cells")[0] for warning in plan.warnings] == [
        "item of 3x2x1", "tote of 7x6x5", "gripper.size=[4, 4]: the policy met gripper.size=[3, 3].",
    ]  # fmt: skip
    hull = Planner.load("pretrained/r4", planner="corner", support="hull")
    box = Box(0.1, 0.1, 0.09, 0.04, 0.05)
    plan = plan_for(hull, items=[box], tote_depth=np.full((6, 6), 0.25), **flat)
    assert plan.warnings == ["support=hull: the policy met support=bearing."]
    known = plan_for(Planner.load("pretrained/r4"), items=[box], tote_depth=np.full((6, 6), 0.25), **flat)
    assert known.warnings == []
    high = plan_for(
        Planner.load("pretrained/r4"), items=[box], tote_depth=np.full((6, 6), 0.9), tote_height=0.9, **flat
    )
    assert [warning.partition(" cells")[0] for warning in high.warnings] == ["tote of 6x6x18"]
    with pytest.raises(ValueError, match="planner='uniform': it does not choose among|does not choose among feasible"):
        Planner(CellSpec(), planner="uniform")
    with pytest.raises(DepthMapError, match=r"items\[0\]: the item is 3 cells long, longer .*; expected at most 2"):
        overlap = Planner(CellSpec(pick_rule="overlap", longest_side=2), planner="joint_dbl")
        plan_for(overlap, items=[Box(0.1, 0.1, 0.1, 0.04, 0.05)], tote_depth=np.full((6, 6), 0.25), **flat)
    with pytest.raises(ValueError, match="policy=None: planner='policy' needs it"):
        Planner(CellSpec())
    with pytest.raises(ValueError, match="items=None: planner='mcts' needs it"):
        Planner(CellSpec(), planner="mcts")
