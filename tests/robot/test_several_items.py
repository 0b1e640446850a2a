"""Several items in the bin: which one is taken, and whether what is called `ok` is so."""

import json
from collections import Counter
from dataclasses import astuple, replace
from itertools import combinations, product
from math import cos, radians, sin

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import Oracle, Rules
from scenes import fault, meet, plan_for, random_scene, rectangle
from untrained import untrained_policy

from pickplace import CellSpec, DepthMapError, Failure, Planner, Scene
from pickplace.planners.heuristics import JointDBL
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.robot.box import HiddenBox, UnknownBox
from pickplace.robot.measure import Box, overlap_mask
from pickplace.robot.measured_problem import read_metric
from pickplace.rules.grasps import all_grasps
from pickplace.rules.reach.annulus import Annulus
from pickplace.serve.request import answer

CELL, TOTE, NOISE = 0.05, (0.3, 0.3, 0.25), 0.002
FLAT = {"tote_depth": np.full((30, 30), 0.25), "cell_size": CELL}
MIXED = {"tote_size": (6, 6, 5), "bin_size": (8, 8, 1)}
BOXES = [Box(0.06, 0.06, 0.08, 0.06, 0.06, 10), Box(0.15, 0.15, 0.1, 0.07, 0.05, 30), Box(0.3, 0.3, 0.1, 0.1, 0.08)]


# ---------------------------------------------------------------------- on the grid
def random_bin(draw: np.random.Generator, sides, most: int, longest: int) -> dict[int, tuple[int, ...]]:
    """Up to ``most`` items ``(x, y, w, d, h)`` that do not overlap, by ascending labels."""
    items, taken = [], np.zeros(sides, dtype=bool)
    for _ in range(4 * most):
        w, d, h = draw.integers(1, longest + 1), draw.integers(1, longest + 1), draw.integers(1, 4)
        x, y = draw.integers(0, sides[0] - w + 1), draw.integers(0, sides[1] - d + 1)
        if len(items) < most and not taken[x : x + w, y : y + d].any():
            taken[x : x + w, y : y + d] = True
            items.append(tuple(map(int, (x, y, w, d, h))))
    labels = sorted(draw.choice(np.arange(1, 99), len(items), replace=False).tolist())
    return dict(zip(labels, items, strict=True))


def bin_maps(items: dict[int, tuple[int, ...]], sides) -> tuple[np.ndarray, np.ndarray]:
    """The heights in a bin, and the labels."""
    depth, labels = np.zeros(sides, dtype=int), np.zeros(sides, dtype=int)
    for label, (x, y, w, d, h) in items.items():
        depth[x : x + w, y : y + d], labels[x : x + w, y : y + d] = h, label
    return depth, labels


def make_planner(name: str, cell: CellSpec) -> Planner:
    if name == "joint_dbl":
        return Planner(cell, planner=name)
    torch.manual_seed(0)
    policy = untrained_policy(cell) if name == "fcn_grasp" else Fcn4d(cell, filters=4).eval()
    return Planner(cell, policy, candidates=7 if name == "fcn4d, 7" else "all")


@settings(max_examples=60)
@given(
    st.sampled_from(["joint_dbl", "fcn_grasp", "fcn4d", "fcn4d, 7"]), st.integers(0, 10**6), st.integers(2, 4),
    st.sampled_from(["contain", "overlap"]), st.sampled_from([1, 3, 4]),
)  # fmt: skip
def test_plans_agree_with_the_oracle(name, seed, most, rule, rotations):
    draw, sides = np.random.default_rng(seed), (6, 5)
    settings = {"bin_size": (*sides, 1), "tote_size": (4, 4, 4), "effector_size": (3, 2), "rotations": rotations}
    cell = CellSpec(**settings, pick_rule=rule, support="half", longest_side=2)
    items = random_bin(draw, sides, most, 2)
    depth, labels = bin_maps(items, sides)
    heights = draw.choice([0, *draw.integers(0, 5, 2)], (4, 4))
    plan = plan_for(make_planner(name, cell), depth, 4 - heights, 4, bin_labels=labels, alternatives=6)

    (item, position), *others = ((item[2:], item[:2]) for item in items.values())
    oracle = Oracle(
        Rules(**settings, pick_rule=rule, support="half"), 4, item, position, heights.tolist(), others=others
    )
    codes = [oracle.try_action(action)[0] for action in range(cell.num_actions)]
    names = {code: Failure(code).name.lower() for code in set(codes)}
    if 0 not in codes:
        assert plan.status in ("stuck", "impossible") and plan.item_number is plan.pick is None
        assert plan.item is None or not others
        assert plan.reasons == {names[code]: count for code, count in Counter(codes).items()}
        return
    for other in plan.alternatives:
        assert other.rejected == (names[codes[other.action]] if codes[other.action] else None)
        assert other.item_number == (oracle.taken(other.action) or 0)
    shares = [other.probability for other in plan.alternatives]
    assert all(0 <= share <= 1 + 1e-5 for share in shares) and sum(shares) < 1 + 1e-4
    if plan.status == "rejected":
        assert name == "fcn4d, 7" and len(plan.reasons) == 1
        assert [*items.values()][plan.item_number] == tuple(plan.item.values())
        return
    assert plan.status == "ok" and codes[plan.action] == 0 and plan.item_number == oracle.taken(plan.action)
    x, y, w, d, h = [*items.values()][plan.item_number]
    assert plan.item == {"x": x, "y": y, "w": w, "d": d, "h": h}
    after = np.array(oracle.try_action(plan.action)[1])
    changed = np.argwhere(after != heights)
    angle = radians(plan.rotation_degrees)
    arm = np.array([x + w / 2, y + d / 2]) - np.array(plan.pick.center[:2])
    turned = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]]) @ arm
    assert np.allclose(np.array(plan.place.center[:2]) + turned, (changed.min(0) + changed.max(0) + 1) / 2)
    top = after[tuple(changed[0])]
    assert plan.pick.center[2] == h and plan.place.center[2] == top and plan.drop_height == top - h
    assert plan.occupancy_after == pytest.approx(plan.occupancy_before + w * d * h / 64)


@settings(max_examples=30)
@given(st.sampled_from(["joint_dbl", "fcn_grasp"]), st.integers(0, 10**6))
def test_whole_cells_in_metres_give_the_plan_of_whole_cells(name, seed):
    """There items are on grids of their own, blocked picks come from rectangles, and failures from measured maps."""
    draw, sides = np.random.default_rng(seed), (6, 6)
    planner = make_planner(name, CellSpec(bin_size=(6, 6, 1), tote_size=(4, 4, 4)))
    items = random_bin(draw, sides, 3, 2)
    depth, labels = bin_maps(items, sides)
    heights = draw.choice([0, 1, 4], (4, 4), p=[0.5, 0.3, 0.2])
    plain = plan_for(planner, depth, 4 - heights, bin_labels=labels, alternatives=4)
    metric = plan_for(planner,
        depth * CELL, (4 - heights) * CELL, 4 * CELL, CELL, accuracy=0, alternatives=4, bin_labels=labels,
        tote_bearing=np.ones((4, 4)),
    )  # fmt: skip
    for key in ("status", "action", "item_number", "item", "reasons", "tote_bearing", "rotation_degrees"):
        assert getattr(metric, key) == getattr(plain, key), key
    assert [(a.item_number, a.rejected) for a in metric.alternatives] == [
        (a.item_number, a.rejected) for a in plain.alternatives
    ]
    assert [a.probability for a in metric.alternatives] == pytest.approx([a.probability for a in plain.alternatives])
    if plain.status == "ok":
        assert metric.pick.center == pytest.approx(np.multiply(plain.pick.center, CELL))
        assert metric.place.center == pytest.approx(np.multiply(plain.place.center, CELL))


def test_one_label_is_one_item():
    depth, labels = bin_maps({5: (1, 2, 2, 1, 1)}, (5, 5))
    planner = Planner.load("pretrained/mixed_grasp", tote_size=(6, 6, 5))
    assert plan_for(planner, depth, np.full((6, 6), 5), bin_labels=labels) == plan_for(
        planner, depth, np.full((6, 6), 5)
    )
    one = plan_for(planner, items=BOXES[:1], **FLAT)
    assert one.status == "ok" and one.item_number == 0


LABELS = bin_maps({1: (0, 0, 2, 1, 1), 4: (3, 3, 2, 2, 2)}, (5, 5))


def changed(array, cell, value):
    array = array.copy()
    array[cell] = value
    return array


@pytest.mark.parametrize(("given", "message"), [
    ({"bin_labels": None}, "bin_depth[0, 0]: got 1 cells, expected 2: one cuboid that fills its bounding box, 5x5 "
     "cells from [0, 0]; of several items give bin_labels, too."),
    ({"bin_labels": LABELS[1][:4]}, "bin_labels: got shape [4, 5], expected [5, 5]"),
    ({"bin_labels": changed(LABELS[1], (0, 0), -1)}, "bin_labels[0, 0]: got -1, expected 0 to 2,147,483,647"),
    ({"bin_labels": LABELS[1] * 0.5}, "bin_labels[0, 0]: got 0.5, expected a whole number"),
    ({"bin_labels": changed(LABELS[1], (3, 4), 0)}, "bin_labels[3, 4]: got 0, expected a label"),
    ({"bin_labels": changed(LABELS[1], (0, 4), 7)}, "bin_labels[0, 4]: got 7, expected 0, as bin_depth"),
    ({"bin_labels": changed(LABELS[1], (0, 4), 1)}, "bin_depth[0, 1]: got 0 cells with label 1, expected 1: one cub"),
    ({"bin_depth": changed(LABELS[0], (3, 4), 1)}, "bin_depth[3, 4]: got 1 cells with label 4, expected 2: one cuboid"),
    ({"bin_depth": LABELS[0] * 0, "bin_labels": LABELS[1] * 0}, "bin_labels: got 0 labels, expected 1 to 100"),
    ({"bin_depth": LABELS[0] * CELL, "tote_depth": np.full((6, 6), 0.25), "cell_size": CELL, "accuracy": 0.001,
      "bin_labels": changed(LABELS[1], (3, 4), 1)}, "m with label 1, expected 0.1 m: one cuboid"),
    ({"bin_depth": np.full((10, 10), CELL), "tote_depth": np.full((6, 6), 0.25), "cell_size": CELL,
      "bin_labels": np.full((10, 10), 7)}, "bin_depth with label 7: w=0.25: with its clearance it takes 6 cells"),
])  # fmt: skip
@pytest.mark.filterwarnings("error")
def test_bad_labels_are_refused_in_one_sentence(given, message):
    planner = Planner(CellSpec(), planner="joint_dbl")
    with pytest.raises(DepthMapError) as caught:
        plan_for(
            planner, **{"bin_depth": LABELS[0], "bin_labels": LABELS[1], "tote_depth": np.full((6, 6), 5), **given}
        )
    assert message in str(caught.value) and "\n" not in str(caught.value)


# ---------------------------------------------------------------------- in metres
def count_plans(name: str, scenes: int, seed: int, side: int = 6, most=(0.1, 0.1, 0.1), accuracy: float = NOISE):
    """Plans for bins with 1 to 4 boxes, by the number of boxes and what becomes of them."""
    sizes = {"tote_size": (6, 6, 5), "bin_size": (side, side, 1)}
    planner = Planner(CellSpec(**sizes), planner=name) if name == "joint_dbl" else Planner.load(name, **sizes)
    draw, found = np.random.default_rng(seed), Counter()
    for _ in range(scenes):
        scene = random_scene(draw, TOTE, most, bin=(side * CELL, side * CELL, 0.05))
        scene.add_others(draw, int(draw.integers(0, 4)), most)
        noise = draw.uniform(-accuracy, accuracy, (30, 30))
        boxes = []
        for (w, d, h), centre, yaw in scene.in_bin():
            x, y = centre + draw.uniform(-0.0035, 0.0035, 2)  # within the clearance
            boxes.append(Box(x, y, w, d, h + draw.uniform(-accuracy, accuracy), yaw))
        plan = plan_for(planner,
            items=boxes, tote_depth=scene.tote_map(100, noise), tote_height=scene.tote[2], cell_size=CELL,
            accuracy=accuracy, alternatives=0,
        )  # fmt: skip
        status = plan.status
        if status == "ok":
            assert plan.box == boxes[plan.item_number].upright()
            status = fault(scene.taking(plan.item_number), plan, accuracy, 0.0) or "ok"  # it lies off the box
        elif len(boxes) > 1:
            assert plan.item is plan.box is plan.item_number is None
        if plan.reasons is not None:
            assert sum(plan.reasons.values()) == planner.cell.num_actions
        found[len(boxes), status] += 1
    return found


@pytest.mark.parametrize("name", ["pretrained/mixed_grasp", "joint_dbl"])
def test_no_plan_that_is_ok_goes_wrong(name):
    found = count_plans(name, 120, 1)
    assert {status for _, status in found} <= {"ok", "stuck", "impossible"}, found
    assert all(found[count, "ok"] >= 5 for count in (1, 2, 3, 4)), found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pretrained/r4", "pretrained/mixed_grasp", "joint_dbl"])
@pytest.mark.parametrize(("side", "scenes", "least"), [(6, 2000, 170), (8, 1000, 100)])
def test_no_plan_that_is_ok_goes_wrong_in_3_000_scenes(name, side, scenes, least):
    found = count_plans(name, scenes, 100 if side == 6 else 200, side)
    assert {status for _, status in found} <= {"ok", "stuck", "impossible"}, found
    assert all(found[count, "ok"] >= least for count in (1, 2, 3, 4)), found


@settings(max_examples=300)
@given(st.integers(0, 10**9), st.floats(0, 1))
def test_rectangles_touch_as_polygons_do(seed, near):
    draw = np.random.default_rng(seed)
    sides, (w, d), yaws = draw.uniform(0.01, 0.3, 2), draw.uniform(0.01, 0.3, 2), draw.uniform(-180, 180, 2) // 1
    box = Box(*draw.uniform(0, 0.3, 2), w, d, 0.1, draw.choice((yaws[0], yaws[1], yaws[1] + 90)))
    way = draw.uniform(-1, 1, 2)
    centres = (box.x, box.y) + way / np.linalg.norm(way) * np.linspace(0, 0.5, 30)[:, None]
    expected = [
        meet(rectangle(centre, sides, yaws[1]), rectangle((box.x, box.y), (w, d), box.yaw)) for centre in centres
    ]
    assert overlap_mask(centres, rectangle((0, 0), sides, yaws[1]), box).tolist() == expected


def test_an_action_means_one_item():
    """Each item has its own grid; where two could be meant by a pick cell, it stands for the higher one."""
    cell, draw, several = CellSpec(bin_size=(5, 5, 1)), np.random.default_rng(0), 0
    for _ in range(100):
        boxes = [Box(*draw.uniform(0.02, 0.23, 2), 0.02, 0.02, h, draw.uniform(-45, 45)) for h in (0.05, 0.1, 0.07)]
        if any(
            overlap_mask(np.array([[a.x, a.y]]), rectangle((0, 0), (a.w, a.d), a.yaw), b).any()
            for a, b in combinations(boxes, 2)
        ):
            continue
        problem = read_metric(cell, Scene(boxes, FLAT["tote_depth"], CELL, NOISE), torch.device("cpu"))
        lifted = all_grasps(problem.cell, problem.maps.item, problem.maps.blocked)[0]  # [M, P]
        several += int((all_grasps(problem.cell, problem.maps.item)[0].sum(0) > 1).sum())
        assert (lifted.sum(0) <= 1).all()
        number, pick = lifted.nonzero(as_tuple=True)
        actions = pick * cell.num_places * cell.rotations
        assert (problem.taken_items(actions) == number).all()
    assert several > 100


def test_a_bin_has_a_plan_if_one_of_its_items_has():
    """With the others as obstacles. Where two could be meant by a pick cell, it stands for one that can be picked."""
    planner, found = Planner(CellSpec(bin_size=(8, 8, 1)), planner="joint_dbl"), Counter()
    for x, (free, rim), high in product((0.203, 0.215), ((0.25, 0.25), (0.08, 0.08), (0.08, 0.25)), (0.06, 0.1)):
        boxes = [Box(x + 0.042 * at, 0.2, 0.02, 0.02, h) for at, h in enumerate((high, 0.05))]
        each, tote = [], np.full((30, 30), free)
        for number in range(2):
            seen = [box if at == number else HiddenBox(*astuple(box)) for at, box in enumerate(boxes)]
            each.append(planner.plan(Scene(seen, tote, CELL, tote_height=rim)).status)
        scene = Scene(boxes, tote, CELL, tote_height=rim)
        plan, excluded = planner.plan(scene), []
        assert plan.status == min(each, key=["ok", "stuck", "impossible"].index)
        while plan.status == "ok" and plan.item_number == 0:
            excluded.append(plan.pick.center)
            plan = planner.plan(scene, exclude=excluded)
        assert (plan.status == "ok") == (each[1] == "ok")
        found[(*each, len(excluded) > 0)] += 1
    assert {*found} == {
        ("ok", "ok", True), ("ok", "ok", False), ("impossible", "ok", False), ("stuck", "stuck", False),
    }  # fmt: skip


@pytest.mark.parametrize(("weights", "name"), [
    *((None, name) for name in ("joint_dbl", "corner", "random", "individual_heuristic")),
    ("mixed_grasp", "policy"), ("mixed_grasp", "lookahead"), ("mixed", "policy"), ("mixed", "beam"),
])  # fmt: skip
def test_any_planner_chooses_among_items(weights, name):
    if weights:
        planner, known = (
            Planner.load(f"pretrained/{weights}", planner=name, **MIXED, bin_items=count) for count in (1, 3)
        )
    else:
        planner, known = (Planner(CellSpec(**MIXED, bin_items=count), planner=name) for count in (1, 3))
    plan = plan_for(planner, items=BOXES, **FLAT, alternatives=0)
    assert plan.status == "ok" and plan.box == BOXES[plan.item_number]
    assert {
        **plan_for(known, items=BOXES, **FLAT, alternatives=0).as_dict(),
        "warnings": plan.warnings,
    } == plan.as_dict()
    assert plan_for(known, items=BOXES[:1], **FLAT, alternatives=0).status == "ok"
    depth, labels = bin_maps({3: (0, 0, 2, 2, 1), 9: (5, 5, 2, 1, 3)}, (8, 8))
    plan = plan_for(planner, depth, np.full((6, 6), 5), bin_labels=labels)
    assert plan.status == "ok" and plan.item["h"] == (1, 3)[plan.item_number]


@pytest.mark.parametrize("settings", [
    {"_target_": "random"}, {"_target_": "mcts", "simulations": 20, "mask": True},
    {"_target_": "lookahead", "samples": 2, "rounds": 1, "confidence": 0},
])  # fmt: skip
def test_a_plan_depends_on_its_scene_only(settings):
    """Random draws begin anew, so a log of plans can be replayed."""
    planner = Planner.load("pretrained/mixed", planner=settings, **MIXED)
    scenes = [Scene(BOXES[at : at + 2], FLAT["tote_depth"], CELL) for at in (0, 1, 0)]
    first, _, again = (planner.plan(scene, alternatives=0) for scene in scenes)
    assert first == again


def test_an_item_between_higher_ones_waits():
    """It can be picked once they are gone; one that is surely lower is in nobody's way."""
    low, high = Box(0.2, 0.2, 0.08, 0.08, 0.05), [Box(x, 0.2, 0.05, 0.08, 0.06) for x in (0.12, 0.28)]
    planner = Planner(CellSpec(**MIXED), planner="joint_dbl")
    plan = plan_for(planner, items=[low, *high], **FLAT)
    assert plan.status == "ok" and plan.item_number in (1, 2)
    alone = plan_for(planner, items=[low, *(replace(box, h=0.04) for box in high)], **FLAT)
    assert alone.status == "ok"
    equal = plan_for(planner, items=[Box(x, 0.2, 0.09, 0.09, 0.05) for x in (0.2, 0.1, 0.3)], **FLAT)
    many = [Box(0.05 + 0.075 * x, 0.05 + 0.075 * y, 0.07, 0.07, 0.06) for x in range(5) for y in range(5)]
    packed = plan_for(planner, items=many, **FLAT)  # the effector reaches over the others wherever it is
    assert equal.status == "ok" and equal.item_number != 0
    assert packed.status == "impossible" and packed.item is packed.item_number is None
    assert packed.reasons["bin_collision"] > 0 and sum(packed.reasons.values()) == planner.cell.num_actions


def test_the_reach_of_a_pick_depends_on_its_item():
    """The suction face may be 70 mm high in the bin: the item of 80 mm is out of reach."""
    reach = Annulus(radii=[0, 99], heights=[-9, 1.4], bin=[0, -2.5, 0], tote=[0, -3, -5])
    planner = Planner(CellSpec(bin_size=(8, 8, 1), reach=reach), planner="joint_dbl")
    seen = plan_for(planner, items=BOXES, **FLAT)
    assert seen.status == "ok" and seen.item_number != 2
    tall = plan_for(planner, items=[replace(box, h=0.08) for box in BOXES], **FLAT)
    assert tall.status == "impossible" and tall.reasons["out_of_reach"] > 0


def test_those_that_cannot_choose_refuse_in_one_sentence():
    depth, labels = bin_maps({1: (0, 0, 1, 1, 1), 2: (3, 3, 2, 2, 1)}, (5, 5))
    grid = {"bin_depth": depth, "bin_labels": labels, "tote_depth": np.full((6, 6), 5)}
    boxes = {"items": [Box(0.05, 0.05, 0.03, 0.03, 0.05), Box(0.2, 0.2, 0.05, 0.05, 0.05)], **FLAT}
    for planner, seen, message in (
        (Planner.load("pretrained/unmasked"), grid, "bin: got 2 items, among which UnmaskedFcnGrasp does not choose"),
        (Planner.load("pretrained/paper"), boxes, "bin: got 2 items in metres, each on a grid of its own, while Fcn4d"),
        (Planner(CellSpec(), planner=JointDBL(CellSpec())), grid, "was made for a cell with bin_items=1; expected one"),
        (Planner(CellSpec(rotations=1), planner="joint_dbl"), {**boxes, "items": [BOXES[1], BOXES[0]]},
         "items[0].yaw=30: expected 0 with rotations=1"),
    ):  # fmt: skip
        with pytest.raises(DepthMapError) as caught:
            plan_for(planner, **seen)
        assert message in str(caught.value) and "\n" not in str(caught.value)
    assert plan_for(Planner.load("pretrained/paper"), **grid, alternatives=2).status == "ok"
    made = Planner(CellSpec(), planner=JointDBL(CellSpec(bin_items=2)))
    assert plan_for(made, **grid).status == "ok"


def test_warnings_count_the_items():
    planner = Planner.load("pretrained/mixed_grasp", bin_size=(8, 8, 1))
    depth, labels = bin_maps({1: (0, 0, 1, 1, 1), 2: (3, 3, 2, 2, 4), 3: (6, 6, 2, 2, 4)}, (8, 8))
    plan = plan_for(planner, depth, np.full((8, 8), 8), bin_labels=labels)
    assert plan.warnings == [
        "item of 2x2x4 cells: the policy met other sizes, up to 3x3x3.",
        "3 items in the bin: the policy met at most 1.",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("upper", "refused"),
    [
        (Box(0.3, 0.2, 0.03, 0.05, 0.12), True),  # it stands on the end of the lower one
        (Box(0.2, 0.2, 0.24, 0.15, 0.09), True),
        (Box(0.35, 0.2, 0.06, 0.05, 0.12, yaw=45), False),  # its corner overlaps by millimetres: an error of measuring
        (HiddenBox(0.3, 0.2, 0.03, 0.05, 0.03), False),
    ],
)
def test_an_item_that_stands_on_another_is_refused(upper, refused):
    """The lower one would be lifted with what stands on it."""
    cell = CellSpec(bin_size=(8, 8, 1), tote_size=(6, 6, 5), effector_size=(2, 2), pick_rule="seal", support="half")
    given = {
        "items": [Box(0.2, 0.2, 0.24, 0.15, 0.06), upper],
        "tote_depth": np.full((30, 30), 0.25),
        "cell_size": 0.05,
    }
    planner = Planner(cell, planner="joint_dbl")
    if refused:
        with pytest.raises(
            DepthMapError, match=r"^items\[1\] overlaps items\[0\] in plan view; expected items that stand"
        ):
            plan_for(planner, **given)
    else:
        assert plan_for(planner, **given).status == "ok"


@pytest.mark.parametrize("weights", ["mixed", "mixed_grasp"])
def test_what_is_only_in_the_way_is_no_item(weights):
    """A policy for one item plans beside a box that is not picked, and nothing but the other's way changes."""
    planner, tote = Planner.load(f"pretrained/{weights}", tote_size=(6, 6, 5)), np.full((30, 30), 0.25)
    item = Box(0.06, 0.06, 0.08, 0.06, 0.06)
    alone = planner.plan(Scene([item], tote, 0.05))
    assert alone.status == "ok" and alone.item_number == 0
    for kind in (HiddenBox, UnknownBox):
        beside = planner.plan(Scene([kind(0.21, 0.21, 0.03, 0.03, 0.2), item], tote, 0.05))
        assert beside.item_number == 1 and {each.item_number for each in beside.alternatives} == {1}
        assert (beside.pick, beside.place) == (alone.pick, alone.place)
        with pytest.raises(
            DepthMapError, match=r"^items: got 1 that are hidden in part or unknown, .* one that is seen"
        ):
            planner.plan(Scene([kind(0.21, 0.21, 0.03, 0.03, 0.2)], tote, 0.05))
    over = planner.plan(Scene([item, HiddenBox(0.06, 0.06, 0.03, 0.03, 0.2)], tote, 0.05))
    assert over.status == "impossible" and over.item_number is None
    with pytest.raises(DepthMapError, match="no plan avoids what the images leave unknown"):
        planner.plan(Scene([item, UnknownBox(0.06, 0.06, 0.03, 0.03, 0.2)], tote, 0.05))


def test_the_critic_of_a_search_sees_each_item():
    planner = Planner.load("pretrained/mixed_grasp", planner="lookahead", tote_size=(6, 6, 5))
    depth, labels = np.zeros((5, 5)), np.zeros((5, 5), dtype=int)
    for label, (corner, height) in enumerate(((slice(0, 1), 1), (slice(3, 5), 2)), 1):
        depth[corner, corner], labels[corner, corner] = height, label
    critics = [planner._planners[1, 0].critic]
    assert plan_for(planner, depth, np.full((6, 6), 5), bin_labels=labels).status == "ok"
    critics.append(planner._planners[2, 0].critic)
    assert [critic.in_keys[3:] for critic in critics] == [[], ["items"]]
    assert critics[0].network is critics[1].network


def test_items_of_a_fine_map_and_of_a_line():
    """Two items that touch, told apart by labels; and several boxes as JSON."""
    heights, labels = np.zeros((80, 80)), np.zeros((80, 80), dtype=int)
    for label, (x, y, w, d, h) in {
        8: (10, 10, 16, 10, 0.08),
        2: (26, 10, 12, 10, 0.05),
        5: (60, 60, 10, 10, 0.05),
    }.items():
        heights[x : x + w, y : y + d], labels[x : x + w, y : y + d] = h, label
    planner = Planner.load("pretrained/mixed_grasp", **MIXED)
    tote = {"tote_depth": np.full((30, 30), 0.25).tolist(), "cell_size": CELL}
    plan = plan_for(planner, heights, bin_labels=labels, **tote, alternatives=3)
    assert plan.status == "ok" and plan.item_number in (1, 2)  # the first one is lower than its neighbour
    assert plan.box.h == (0.05, 0.08)[plan.item_number == 2] and plan.alternatives[0].item_number == plan.item_number
    line = {"bin_depth": heights.tolist(), "bin_labels": labels.tolist(), **tote, "alternatives": 3}
    assert json.dumps(answer(planner, json.dumps(line).encode(), {})[1]) == json.dumps(plan.as_dict())
    boxes = [vars(box) for box in BOXES]
    _, reply, _ = answer(planner, json.dumps({"items": boxes, **tote}).encode(), {})
    assert reply["status"] == "ok" and reply["box"] == boxes[reply["item_number"]]
    _, bad, _ = answer(planner, json.dumps({"items": [*boxes, {"x": 1}], **tote}).encode(), {})
    assert bad == {"error": "items[3]: expected the keys x, y, w, d, h and any of yaw, mass, max_load."}
    for other in (boxes[0], "abc"):  # a single object is no list
        _, bad, _ = answer(planner, json.dumps({"items": other, **tote}).encode(), {})
        assert "items=" in bad["error"] and bad["error"].endswith(": expected a list of boxes."), bad


def test_no_alternatives_where_no_item_is_gripped():
    depth, labels = bin_maps({1: (0, 0, 4, 4, 1), 2: (4, 4, 4, 4, 2)}, (8, 8))
    plan = plan_for(Planner.load("pretrained/mixed_grasp", **MIXED), depth, np.full((6, 6), 5), bin_labels=labels)
    assert plan.status == "impossible" and plan.alternatives == []
