"""Plans of a robot with a reach, in metres: what is called `ok` is in reach, by geometry in millimetres."""

from collections import Counter
from math import hypot

import numpy as np
import pytest
from scenes import fault, plan_for, random_scene

from pickplace import Box, CellSpec, Planner
from pickplace.rules.reach.annulus import Annulus
from pickplace.rules.reach.table import ReachTable

CELL, TOTE, ACCURACY = 0.05, (0.3, 0.3, 0.25), 0.002  # metres
ANNULUS_OF_ALL = Annulus((2, 20), (0, 10), (-9, -2.5, 0), (4, -3, 0))
ANNULUS = Annulus([4.2, 7.3], [-0.3, 3.7], [-7.1, -2.3, -0.7], [1.7, -3.2, 0.4])


def plan_of(planner, scene, draw):
    noise = draw.uniform(-ACCURACY, ACCURACY, (30, 30))
    box = Box(*scene.centre, *scene.item, scene.yaw)
    settings = {"tote_height": scene.tote[2], "cell_size": CELL, "accuracy": ACCURACY, "alternatives": 0}
    return plan_for(planner, items=[box], tote_depth=scene.tote_map(100, noise), **settings)


def pose_fault(reach, plan):
    """Return the pose of a plan that is out of the annulus, with lengths in millimetres; None if none is."""
    for name, pose, corner in (("pick", plan.pick, reach.bin), ("place", plan.place, reach.tote)):
        x, y, z = (1000 * (at + CELL * start) for at, start in zip(pose.center, corner, strict=True))
        distance = hypot(x, y)
        if not 50 * reach.radii[0] - 1e-3 <= distance <= 50 * reach.radii[1] + 1e-3:
            return f"{name}: {distance:.3f} mm from the axis"
        if not 50 * reach.heights[0] - 1e-3 <= z <= 50 * reach.heights[1] + 1e-3:
            return f"{name}: {z:.3f} mm high"
    return None


@pytest.mark.parametrize(("effector", "unit", "rotations"), [((3, 3), 1.0, 4), ((4, 3), 0.3, 4), ((2, 4), 1.0, 2)])
def test_no_plan_that_is_ok_is_out_of_the_annulus(effector, unit, rotations):
    sizes = {"effector_size": effector, "height_unit": unit, "rotations": rotations}
    planners = [Planner(CellSpec(**sizes, reach=reach), planner="joint_dbl") for reach in (ANNULUS, None)]
    draw, found = np.random.default_rng(sum(effector)), Counter()
    for _ in range(80):
        scene = random_scene(draw, TOTE)
        scene.bin, scene.effector = (0.25, 0.25, CELL * unit), tuple(CELL * side for side in effector)
        limited, free = (plan_of(planner, scene, np.random.default_rng(0)) for planner in planners)
        if limited.status == "ok":
            assert pose_fault(ANNULUS, limited) is None and fault(scene, limited, ACCURACY) is None
            assert free.status == "ok"
            found["another plan" if free.action != limited.action else "the same plan"] += 1
            found["free is out of reach"] += pose_fault(ANNULUS, free) is not None
        else:
            found["refused"] += free.status == "ok"
            found["names reach"] += "out_of_reach" in limited.reasons
            assert "none" not in limited.reasons  # each action that fails has its reason
    assert min(found[key] for key in ("another plan", "free is out of reach", "refused", "names reach")) > 3, found


def test_the_annulus_decides_to_the_millimetre():
    """A box gripped in its middle, 125 mm along both sides of the bin; one millimetre decides for the radius and for
    the height at which it is gripped: 60 mm and the accuracy."""
    box, accuracy = Box(0.125, 0.125, 0.14, 0.14, 0.06), 0.002
    seen = {"items": [box], "tote_depth": np.full((30, 30), 0.25), "cell_size": CELL, "accuracy": accuracy}
    flat = {"heights": [-9, 99], "bin": [0, -2.5, 0], "tote": [0, -3, 0]}

    def status(**values):
        reach = Annulus(**{"radii": [0, 99], **flat, **values})
        return plan_for(Planner(CellSpec(reach=reach), planner="joint_dbl"), **seen).status

    # The box fills the effector, but for its clearance: one pick, or the four about it, decides.
    assert status(radii=[0, 2.5], tote=[-3, -3, 0]) == "ok" and status(radii=[0, 2.48], tote=[-3, -3, 0]) != "ok"
    assert status(radii=[2.5, 99], tote=[9, 0, 0]) == "ok" and status(radii=[2.52, 99], tote=[9, 0, 0]) != "ok"
    assert status(heights=[-9, 1.24], tote=[0, -3, -5]) == "ok" and status(heights=[-9, 1.22], tote=[0, -3, -5]) != "ok"
    assert status(heights=[1.24, 99], tote=[0, -3, 5]) == "ok" and status(heights=[1.26, 99], tote=[0, -3, 5]) != "ok"
    # It lets go twice the accuracy above its top.
    assert (
        status(heights=[-9, 1.28], bin=[0, -2.5, -5]) == "ok" and status(heights=[-9, 1.26], bin=[0, -2.5, -5]) != "ok"
    )


def test_a_table_in_metres_needs_all_pick_cells_around(tmp_path):
    """Between pick cells the robot is taken to be where all four are reached; heights are in millimetres."""
    tote = [f"tote,{x},{y},{r},,{{}}" for x in range(6) for y in range(6) for r in range(4)]
    seen = {"tote_depth": np.full((30, 30), 0.25), "cell_size": CELL, "accuracy": 0.002}

    def plan(picks, centre, highest_pick="", highest_top=""):
        rows = [f"bin,{x},{y},,,{highest_pick}" for x, y in picks] + [row.format(highest_top) for row in tote]
        path = tmp_path / "reach.csv"
        path.write_text("\n".join(["where,x,y,rotation,lowest,highest", *rows]))
        planner = Planner(CellSpec(reach=ReachTable(str(path))), planner="joint_dbl")
        return plan_for(planner, items=[Box(*centre, 0.14, 0.14, 0.06)], **seen).status

    around = [(2, 2), (2, 3), (3, 2), (3, 3)]
    assert plan([(2, 2)], (0.125, 0.125)) == "ok"
    assert plan([(2, 3), (3, 2), (3, 3)], (0.125, 0.125)) == "impossible"
    assert plan(around, (0.14, 0.14)) == "ok" and plan(around[1:], (0.14, 0.14)) == "impossible"
    assert plan(around, (0.14, 0.14), highest_pick="1.24") == "ok"
    assert plan(around, (0.14, 0.14), highest_pick="1.22") == "impossible"
    assert plan(around, (0.14, 0.14), highest_top="1.28") == "ok"
    assert plan(around, (0.14, 0.14), highest_top="1.26") == "impossible"


def test_lookahead_ranks_what_the_robot_reaches():
    """Not what the cell of the training, whose limits are in height units, lets it reach."""
    depth = np.full((6, 6), 0.25)
    depth[:3, :3] = 0  # footprint 0 is taken
    planners = [Planner.load("pretrained/mixed", planner=name, tote_size=(6, 6, 5), reach=ANNULUS_OF_ALL)
                for name in (None, "lookahead")]  # fmt: skip
    for key, value in {"samples": 2, "rounds": 1, "candidates": 2, "horizon": 1}.items():
        setattr(planners[1]._planners[1, 0], key, value)
    for place in ((0.07, 0.07), (0.18, 0.06), (0.06, 0.18)):
        seen = {"items": [Box(*place, 0.1, 0.08, 0.06)], "tote_depth": depth, "cell_size": CELL, "alternatives": 0}
        assert [plan_for(planner, **seen).status for planner in planners] == ["ok", "ok"]
