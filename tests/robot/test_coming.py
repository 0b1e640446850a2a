"""Items that are seen to come, in a robot's scene: a plan with them is the plan of the evaluation."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import plan_for

from pickplace import CellSpec, Planner, Scene
from pickplace.planners.beam import Beam
from pickplace.policies.afterstate.policy import Afterstate
from pickplace.robot.box import Box
from pickplace.robot.measured_problem import read_metric
from pickplace.rules.gripper.rules import Overlap
from pickplace.serve.request import answer

ROW = CellSpec((3, 1, 1), (5, 1, 1), Overlap((1, 1)), rotations=1, support="half", preview=2)
SIDE = 0.05
ITEM, LONG = Box(0.025, 0.025, SIDE, SIDE, SIDE), Box(0.075, 0.025, 3 * SIDE, SIDE, SIDE)
SCENE = {
    "items": [ITEM], "tote_depth": [[SIDE], [SIDE], [SIDE], [0.0], [SIDE]], "cell_size": SIDE,
    "accuracy": 0.0, "clearance": 0.0, "tote_bearing": [[1]] * 5,
}  # fmt: skip


def a_policy():
    """A policy that keeps the last cell of a row free at any cost; see test_beam."""
    policy = Afterstate(ROW, grid=(4, 4, 3), filters=4, hidden=8, compute_dtype="float32").eval()
    policy.network.forward = lambda depth, *_: 10 * depth[:, 4, 0, None]
    return policy


@pytest.mark.parametrize("planner", [{"_target_": "beam", "depth": 2}, Beam(ROW, a_policy(), depth=2)])
def test_a_beam_leaves_room_for_what_comes(planner):
    robot = Planner(ROW, a_policy(), planner=planner)
    places = [plan_for(robot, **SCENE, coming=coming).place.cell for coming in (None, [], [LONG], [ITEM, LONG])]
    assert places == [(0, 0), (0, 0), (4, 0), (0, 0)]
    items, coming = ([{key: getattr(box, key) for key in "xywdh"}] for box in (ITEM, LONG))
    line = json.dumps({**SCENE, "items": items, "coming": coming}).encode()
    assert json.loads(answer(robot, line, {}).text)["place"]["cell"] == [4, 0]


def test_a_policy_sees_what_comes():
    torch.manual_seed(0)
    planner = Planner.load("pretrained/mixed", bin_size=(5, 5, 1), tote_size=(6, 6, 5), preview=3)
    torch.nn.init.normal_(planner.policy.network.waiting.sum.weight, std=1.0)
    coming = [Box(0.1, 0.1, 0.08, 0.04, 0.06, 30), Box(0.2, 0.1, 0.05, 0.05, 0.12)]
    free = np.full((30, 30), 0.25)
    free[:15, :10] = 0.2  # so that not all corners are alike
    scene = {"items": [Box(0.1, 0.1, 0.09, 0.09, 0.05)], "tote_depth": free, "cell_size": 0.05}
    seen = read_metric(planner.cell, Scene(scene["items"], scene["tote_depth"], 0.05, coming=coming), "cpu").seen
    assert seen.coming.table[0, :, 2:5].tolist() == [[2, 1, 1], [2, 2, 2]]
    asked = [plan_for(planner, **scene, coming=some).alternatives for some in (None, coming, coming[:1], coming[::-1])]
    chances = [{each.action: each.probability for each in some} for some in asked]
    assert chances[0] != pytest.approx(chances[1]) and chances[1] != pytest.approx(chances[2])
    assert chances[1] == pytest.approx(chances[3], rel=1e-3)  # one set


@pytest.mark.parametrize(("change", "message"), [
    ({"coming": [(0.1, 0.1)]}, "coming=.*: expected a list of Box"),
    ({"coming": [replace(ITEM, w=-1)]}, r"coming\[0\].w=-1: expected a length from 0.001 to 1000 m"),
    ({"coming": [ITEM, replace(ITEM, d=0.11)]}, r"coming\[1\].d=0.11: with its clearance it takes 3 cells"),
    ({"coming": [replace(ITEM, x=500)]}, r"coming\[0\].x=500: expected 0 to 0.15 m, in the bin"),
    ({"coming": [replace(ITEM, yaw=30)]}, r"coming\[0\].yaw=30: expected 0 with rotations=1"),
    ({"coming": [ITEM] * 101}, "coming: the list has 101 boxes; expected at most 100"),
])  # fmt: skip
def test_what_comes_is_checked(change, message):
    with pytest.raises(ValueError, match=message):
        plan_for(Planner(ROW, planner="corner"), **SCENE, **change)


def test_whole_cells_have_no_boxes():
    with pytest.raises(ValueError, match="coming: the lengths are whole cells; expected a scene in metres"):
        Scene.from_maps(np.ones((5, 5)), np.full((6, 6), 5), coming=[ITEM])
