"""The planner for a robot cell, against the oracle, plane geometry, and what a depth camera may deliver."""

import json
from collections import Counter
from dataclasses import replace
from math import cos, radians, sin

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import oracle_of, problems, state_of
from scenes import plan_for
from untrained import untrained_policy, write_checkpoint

from pickplace import CellSpec, DepthMapError, Failure, Planner, Scene
from pickplace.planners.policy import PolicyPlanner
from pickplace.robot.planner import Box
from pickplace.rules.observation import STANDARD_TERMS, observe

EMPTY = np.full((6, 6), 5)
ITEM = np.zeros((5, 5), dtype=np.int64)
ITEM[1:3, 2] = 1


@pytest.fixture(scope="module")
def planner():
    return Planner(CellSpec(), untrained_policy(CellSpec()))


@settings(max_examples=40)
@given(problems(), st.sampled_from(["all", 1, 7]), st.booleans(), st.integers(0, 5))
def test_plans_agree_with_the_oracle_and_with_plane_geometry(problem, candidates, mask, seed):
    cell, (case,) = problem
    rim, heights, bearing, item = case[:4]
    x, y, w, d, h = item
    bin_depth = np.zeros(cell.bin_size[:2])
    bin_depth[x : x + w, y : y + d] = h
    policy = untrained_policy(cell, mask, seed)
    result = plan_for(
        Planner(cell, policy, candidates), bin_depth, rim - heights, rim, alternatives=6, tote_bearing=bearing
    )
    oracle, empty = (
        oracle_of(cell, case),
        oracle_of(cell, case._replace(heights=np.zeros_like(heights), bearing=np.ones_like(heights))),
    )
    codes = [oracle.try_action(action)[0] for action in range(cell.num_actions)]
    assert result.item == dict(zip("xywdh", item, strict=True))
    assert result.occupancy_before == pytest.approx(heights.sum() / heights.size / rim)

    # The decision equals that of the planner in evaluation.
    observation = observe(STANDARD_TERMS, cell, state_of(case))
    action = int(PolicyPlanner(cell, policy, candidates).decide(observation))
    feasible, ok = 0 in codes, codes[action] == 0
    nothing = "stuck" if any(empty.try_action(action)[0] == 0 for action in range(cell.num_actions)) else "impossible"
    assert result.status == ("ok" if ok else "rejected" if feasible else nothing)
    assert result.action == (action if ok else None)
    left = oracle.bearing_after(action) if ok else bearing.tolist()
    assert result.tote_bearing == (left if cell.support.marks_bearing else None)
    names = {failure: Failure(failure).name.lower() for failure in set(codes)}
    counted = [codes[action]] if feasible else codes
    assert result.reasons == (None if ok else {names[code]: count for code, count in Counter(counted).items()})

    # Alternatives: simulated as the oracle does, best first, the chosen one the first that would succeed.
    for other in result.alternatives:
        assert other.rejected == (names[codes[other.action]] if codes[other.action] else None)
        assert (other.pick_cell, other.place_cell, other.rotation_degrees // 90) == oracle.rules.split(other.action)
    shares = [other.probability for other in result.alternatives]
    assert all(0 <= share <= 1 + 1e-5 for share in shares)
    assert all(a >= b for a, b in zip(shares[:6], shares[1:6], strict=False))
    chosen = [other for other in result.alternatives if other.chosen]
    assert [other.action for other in chosen] == [action] * ok
    if candidates == "all":  # only what can be carried out counts, and all of it is listed if there is little
        assert all(other.rejected is None for other in result.alternatives)
        assert len(shares) == 6 or sum(shares) == pytest.approx(float(ok), abs=1e-4)
    if not ok:
        assert result.pick is result.place is result.drop_height is result.rotation_degrees is None
        assert result.occupancy_after == result.occupancy_before
        return
    good = [other.probability for other in result.alternatives if other.rejected is None]
    assert chosen[0].probability == pytest.approx(good[0], rel=1e-5)

    # Turning the item about the end effector's centre, as a robot would, leaves it where the oracle says.
    after = np.array(oracle.try_action(action)[1])
    changed = np.argwhere(after != heights)
    angle = radians(result.rotation_degrees)
    arm = np.array([x + w / 2, y + d / 2]) - np.array(result.pick.center[:2])
    turned = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]]) @ arm
    assert np.allclose(np.array(result.place.center[:2]) + turned, (changed.min(0) + changed.max(0) + 1) / 2)
    top = after[tuple(changed[0])]
    assert result.pick.center[2] == h and result.place.center[2] == top and result.drop_height == top - h
    assert result.occupancy_after == pytest.approx(result.occupancy_before + w * d * h / heights.size / rim)


@pytest.mark.parametrize("height_unit", [1.0, 0.5])
def test_whole_cells_in_metres_give_the_plan_of_whole_cells(height_unit):
    """With maps that are exact, lengths along x and y are multiples of the cell's side, heights of the height unit."""
    cell, unit = CellSpec(height_unit=height_unit), 0.05 * height_unit
    planner = Planner(cell, untrained_policy(cell))
    low = EMPTY - 2  # something two units high lies everywhere
    ones = np.ones((6, 6))
    exact = {"cell_size": 0.05, "accuracy": 0, "tote_bearing": ones}
    plain, metric = (
        plan_for(planner, ITEM, low),
        plan_for(planner, ITEM * unit, torch.from_numpy(low * unit), 5 * unit, **exact),
    )
    assert metric.action == plain.action and metric.status == "ok" and metric.tote_bearing == plain.tote_bearing
    assert plain.drop_height == 2 and metric.drop_height == pytest.approx(2 * unit)
    for pose, other in ((plain.pick, metric.pick), (plain.place, metric.place)):
        assert other.cell == pose.cell and other.yaw == pose.yaw
        assert other.center == pytest.approx(np.multiply(pose.center, [0.05, 0.05, unit]))
    assert json.loads(json.dumps(metric.as_dict()))["place"]["cell"] == list(metric.place.cell)
    assert (metric.item, metric.occupancy_before) == (plain.item, pytest.approx(0.4))
    assert metric.occupancy_after == pytest.approx(plain.occupancy_after)
    assert [other.rejected for other in metric.alternatives] == [other.rejected for other in plain.alternatives]
    full = plan_for(planner, ITEM * unit, ones * 0, 5 * unit, **exact), plan_for(planner, ITEM, ones * 0)
    assert full[0].reasons == full[1].reasons and full[0].status == "stuck"


def test_stuck_in_this_tote_or_in_any(planner):
    """A robot that is told to bring an empty tote must not be told so for ever."""
    full = plan_for(planner, ITEM, np.zeros((6, 6)))
    assert full.status == "stuck" and sum(full.reasons.values()) == planner.cell.num_actions
    long = np.zeros((5, 5))
    long[:4, 1] = 1  # an end effector of 3x3 does not cover it
    assert plan_for(planner, long, EMPTY).status == plan_for(planner, long, np.zeros((6, 6))).status == "impossible"
    assert plan_for(planner, ITEM * 6, EMPTY).status == "impossible"
    assert plan_for(planner, ITEM * 6, EMPTY + 1, tote_height=6).status == "ok"


def test_maps_of_other_kinds(planner):
    plain = plan_for(planner, ITEM, EMPTY)
    makes = (
        lambda a: torch.tensor(a, dtype=torch.bfloat16),
        lambda a: torch.tensor(a, dtype=torch.float32, requires_grad=True),
        lambda a: np.ma.masked_array(a, mask=False),
        lambda a: np.asfortranarray(a.astype(">u2")),
    )
    for make in makes:
        assert plan_for(planner, make(ITEM), make(EMPTY)) == plain


def changed(array, cell, value, dtype=float):
    array = array.astype(dtype)
    array[cell] = value
    return array


BOX = Box(0.1, 0.1, 0.12, 0.08, 0.06)


def boxes(*items):
    return {"bin_depth": None, "items": list(items), "tote_depth": EMPTY * 0.05, "cell_size": 0.05}


TWO_ITEMS = changed(ITEM, (4, 4), 1)
BAD = [
    ({"bin_depth": ITEM[:4]}, "bin_depth: got shape [4, 5], expected [5, 5]"),
    ({"bin_depth": [[1, 2], [3]]}, "bin_depth: expected an array of 5x5 numbers"),
    ({"bin_depth": ITEM.astype(bool)}, "bin_depth: got values of type bool"),
    ({"bin_depth": np.zeros((5, 5))}, "bin_depth: got no cell above 0, expected one item"),
    ({"bin_depth": TWO_ITEMS}, "bin_depth[1, 3]: got 0 cells, expected 1: one cuboid"),
    ({"bin_depth": changed(ITEM, (2, 2), 2)}, "bin_depth[1, 2]: got 1 cells, expected 2: one cuboid"),
    ({"bin_depth": changed(ITEM, (0, 0), np.nan)}, "bin_depth[0, 0]: got nan cells"),
    ({"bin_depth": changed(ITEM, (4, 0), -1)}, "bin_depth[4, 0]: got -1 cells, expected 0 to"),
    ({"bin_depth": changed(ITEM, (1, 2), 1.3)}, "bin_depth[1, 2]: got 1.3 cells, expected a whole number of cells"),
    ({"bin_depth": np.ma.masked_equal(ITEM, 1)}, "bin_depth[1, 2]: got 1, which is masked, expected a measured value."),
    ({"tote_depth": EMPTY.T[:, :5]}, "tote_depth: got shape [6, 5], expected [6, 6]"),
    ({"tote_depth": changed(EMPTY, (3, 1), 6)}, "tote_depth[3, 1]: got 6 cells, expected 0 to 5 cells"),
    ({"tote_depth": EMPTY * 0.05 + 0.04, "bin_depth": ITEM * 0.05, "cell_size": 0.05},
     "tote_depth[0, 0]: got 0.29 m, expected -0.012 to 0.262 m"),
    ({"tote_depth": EMPTY * 0.05, "bin_depth": np.zeros((7, 7)), "cell_size": 0.05}, "or a multiple of it"),
    ({"tote_depth": np.full((12, 12), 5)}, "expected [6, 6]; finer maps are in metres, with cell_size"),
    ({"bin_depth": None}, "bin_depth: got shape [], expected [5, 5]"),
    ({"tote_depth": None}, "tote_depth: got shape [], expected [6, 6]"),
    ({"bin_depth": None, "items": [BOX]}, "cell_size=None: expected the side of a cell in metres, as items or"),
    (boxes(), "items: got 0 boxes, expected 1 to 100: an empty bin"),
    (boxes(*[BOX] * 101), "items: got 101 boxes, expected 1 to 100: too many"),
    (boxes(1), "items=[1]: expected a list of Box"),
    (boxes(replace(BOX, h=0)), "items[0].h=0: expected a length from 0.001 to 1000 m"),
    (boxes(replace(BOX, yaw=float("nan"))), "items[0].yaw=nan: expected -1000 to 1000"),
    (boxes(replace(BOX, x=0.3)), "items[0].x=0.3: expected 0 to 0.25 m, in the bin"),
    (boxes(replace(BOX, w=0.25)), "items[0].w=0.25: with its clearance it takes 6 cells; expected at most 5"),
    ({"accuracy": -1}, "accuracy=-1: expected metres between 0 and 0.1"),
    ({"clearance": 2}, "clearance=2: expected metres between 0 and 0.1"),
    ({"placement_error": -1}, "placement_error=-1: expected metres between 0 and 0.1"),
    ({"placement_error": 0.006}, "placement_error=0.006: expected at most clearance=0.005 m, which"),
    ({"tote_samples": "middle"}, "tote_samples='middle': expected 'area' or 'centre'"),
    ({"cell_size": 0.05, "tote_height": 3}, "tote_height=3: expected metres between 0.001 and 2"),
    ({"cell_size": "5cm"}, "cell_size='5cm': expected metres"),
    ({"cell_size": 1e-320}, "cell_size=1e-320: expected metres between 0.001 and 10"),
    ({"tote_height": 0}, "tote_height=0: expected a whole number >= 1 and <= 1,048,575"),
    ({"tote_height": 10**400}, "tote_height=1000"),
    ({"alternatives": -1}, "alternatives=-1: expected a whole number >= 0"),
]  # fmt: skip


#: What is wrong with every image: no DepthMapError, after which a robot takes another one.
SETTINGS = ("accuracy", "clearance", "placement_error", "tote_samples", "cell_size", "tote_height", "alternatives")
HALVES = [
    (
        {"tote_depth": EMPTY * 1.1},
        "got 5.5 height units, expected a whole number of height units; measured heights are",
    ),
    ({"tote_depth": EMPTY * 2}, "got 10 height units, expected 0 to 5 height units"),
    ({"tote_height": 0.13}, "tote_height=0.13: expected a whole number >= 1"),
]
CASES = [(1.0, *case) for case in BAD] + [(0.5, *case) for case in HALVES]


@pytest.mark.parametrize(("unit", "given", "message"), CASES)
@pytest.mark.filterwarnings("error")
def test_bad_maps_are_refused_in_one_sentence(planner, unit, given, message):
    cell = CellSpec(height_unit=unit)
    chosen = planner if unit == 1 else Planner(cell, untrained_policy(cell))
    with pytest.raises(ValueError) as caught:
        plan_for(chosen, **{"bin_depth": ITEM, "tote_depth": EMPTY, **given})
    assert message in str(caught.value) and "\n" not in str(caught.value)
    is_setting = any(message.startswith(f"{key}=") for key in SETTINGS)
    assert isinstance(caught.value, DepthMapError) != is_setting


def test_a_planner_takes_a_scene(planner):
    for wrong in (ITEM, {"bin_depth": ITEM, "tote_depth": EMPTY}, None):
        with pytest.raises(ValueError, match=r"^scene: got (ndarray|dict|NoneType), expected a Scene"):
            planner.plan(wrong)


def test_load():
    four = plan_for(Planner.load("pretrained/paper"), ITEM, EMPTY, alternatives=3)  # a policy of another kind
    assert four.status == "ok" and sum(other.chosen for other in four.alternatives) == 1
    shipped = Planner.load("pretrained/r4", tote_size=(8, 7, 9), candidates=10)
    assert shipped.cell.tote_size == (8, 7, 9) and shipped.cell.bin_size == (5, 5, 1)
    assert plan_for(shipped, ITEM, np.full((8, 7), 9)).status == "ok"
    turned = Planner.load("pretrained/unmasked", effector_size=(2, 3), tote_size=(7, 8, 5))
    assert plan_for(turned, ITEM, np.full((7, 8), 5)).status == "ok"  # without a mask, end effectors as long as its own


@pytest.mark.parametrize(("path", "sizes", "message"), [
    ("pretrained/r4", {"tote_sizes": 1}, "tote_sizes=1: expected one of bin_size"),
    ("pretrained/r4", {"rotations": 5}, "rotations=5"),
    ("pretrained/r4", {"effector_size": (0, 3)}, r"gripper.size=\(0, 3\)"),
    ("pretrained/r4", {"candidates": 0}, "candidates=0"),
    ("pretrained/r9", {}, "pretrained/r9.*expected .*pretrained/r4"),
    (None, {}, "path=None: expected a run folder"),
    ("pretrained/unmasked", {"effector_size": (4, 4)},
     r"env.gripper.size=\[4, 4\]: the checkpoint was trained with \[3, 3\], and"),
])  # fmt: skip
def test_load_refuses(path, sizes, message):
    with pytest.raises(ValueError, match=message):
        Planner.load(path, **sizes)


def test_load_of_a_policy_whose_grasps_depend_on_the_items(tmp_path):
    """With ``pick_rule=overlap`` and no mask the number of grasp classes follows from the longest item in training."""
    cell = CellSpec(tote_size=(5, 5, 2), pick_rule="overlap", longest_side=2)
    overrides = ["env.gripper._target_=overlap", "model.mask_infeasible=false", "env.tote_size=[5,5,2]"]
    loaded = Planner.load(write_checkpoint(tmp_path / "it", cell, *overrides))
    assert plan_for(loaded, ITEM, np.full((5, 5), 2)).status == "ok"
    with pytest.raises(DepthMapError, match="the item is 3 cells long, longer than .*; expected at most 2"):
        plan_for(loaded, changed(ITEM, (3, 2), 1), np.full((5, 5), 2))


@pytest.mark.filterwarnings("error")
def test_numbers_of_numpy_are_as_good_as_others():
    box = Box(*map(np.float32, (0.125, 0.125, 0.125, 0.0625, 0.0625)), yaw=np.int64(20))
    plain = Box(0.125, 0.125, 0.125, 0.0625, 0.0625, yaw=20)
    planner, tote = Planner(CellSpec(), planner="joint_dbl"), np.full((30, 30), 0.25)
    found, expected = (planner.plan(Scene([each], tote, 0.05)).as_dict() for each in (box, plain))
    assert found == expected and json.dumps(found) == json.dumps(expected)


def test_a_box_that_may_be_nowhere_is_planned_for():
    """Each side may lie inside the measured one by more than half of it."""
    box = Box(0.125, 0.125, 0.02, 0.07, 0.06, yaw=25, edge_error=0.02)
    scene = Scene([box], np.zeros((30, 30)), 0.05)
    assert [(each.w, each.d) for each in scene.without_gaps().items] == [(0.001, pytest.approx(0.03))]
    assert Planner(CellSpec(), planner="joint_dbl").plan(scene).status in ("stuck", "impossible")
