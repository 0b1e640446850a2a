"""Picks that failed are not planned again, on the grid and in metres."""

from dataclasses import replace
from itertools import count
from math import dist

import numpy as np
import pytest

from pickplace import Box, CellSpec, Planner, Scene
from pickplace.rules.reach.annulus import Annulus

ITEM = np.zeros((5, 5), dtype=np.int64)
ITEM[1:3, 2] = 1
BOXES = [Box(0.07, 0.07, 0.08, 0.06, 0.06, yaw=10), Box(0.2, 0.2, 0.06, 0.07, 0.06)]
REACH = Annulus(radii=(1, 90), heights=(-9, 90), bin=(-20, 0, 0), tote=(8, 0, 0))
SCENES = {
    "grid": (Scene.from_maps(ITEM, np.full((6, 6), 5)), 1.0),
    "metres": (Scene(BOXES[:1], np.full((30, 30), 0.25), 0.05), 0.05),
    "gaps": (Scene([replace(BOXES[0], edge_error=0.001)], np.full((30, 30), 0.25), 0.05), 0.05),
    "several": (Scene(BOXES, np.full((30, 30), 0.25), 0.05), 0.05),
}


@pytest.mark.parametrize("reach", [None, REACH])
@pytest.mark.parametrize("name", SCENES)
def test_each_failure_leads_to_another_pick_until_none_is_left(name, reach):
    """Then it says that the item must be taken out: the tote is empty."""
    planner, (scene, side) = Planner(CellSpec(reach=reach), planner="joint_dbl"), SCENES[name]
    first, failed, numbers = planner.plan(scene), [], set()
    for _ in count():
        plan = planner.plan(scene, exclude=failed)
        if plan.status != "ok":
            break
        assert all(dist(plan.pick.center[:2], before[:2]) > 0.49 * side for before in failed)
        failed.append(plan.pick.center)
        numbers.add(plan.item_number)
        assert len(failed) < 60
    assert plan.status == "impossible" and len(failed) > 3 and len(numbers) == (2 if name == "several" else 1)
    assert planner.plan(scene).as_dict() == first.as_dict()  # nothing is remembered


@pytest.mark.parametrize("name", SCENES)
def test_a_pick_that_moved_a_little_is_the_same(name):
    """A new image shows the item some millimetres elsewhere; picks a cell away are others."""
    planner, (scene, side) = Planner(CellSpec(), planner="joint_dbl"), SCENES[name]
    x, y, _ = planner.plan(scene).pick.center
    near, far = ([(x + share * side, y)] for share in (0.3, 40.0))
    assert planner.plan(scene, exclude=near).pick.center[:2] != (x, y)
    assert planner.plan(scene, exclude=far).pick.center[:2] == (x, y)


@pytest.mark.parametrize("exclude", ["x", [1], [[1]], [["a", 1]], [[float("nan"), 0]], [[1, 2, 3, 4]], [[0, 0]] * 1001])
@pytest.mark.parametrize("name", ["grid", "metres"])
def test_points_that_are_none_are_refused(name, exclude):
    with pytest.raises(ValueError, match="^exclude.*: expected "):
        Planner(CellSpec(), planner="joint_dbl").plan(SCENES[name][0], exclude=exclude)
