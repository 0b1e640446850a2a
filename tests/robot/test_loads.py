"""Loads in metres: no plan puts more on an item than it bears."""

import math
from random import Random

import numpy as np
import pytest
from untrained import untrained_policy

from pickplace import Box, CellSpec, Planner, Scene
from pickplace.robot.box import DepthMapError
from pickplace.rules.observation import ToteCapacity, standard_terms
from pickplace.serve.options import plan_once
from pickplace.serve.request import PlanRequest

SIDE, RIM = 0.05, 0.25
CELL = CellSpec(bin_size=(6, 6, 1), tote_size=(6, 6, 5), effector_size=(3, 3), rotations=2)
SCENE = {"cell_size": SIDE, "accuracy": 0.002, "clearance": 0.005}


@pytest.fixture(scope="module")
def planner():
    return Planner(CELL, planner="joint_dbl")


def tote_of(placed) -> np.ndarray:
    """The remaining height over patches of 5 mm, of boxes that lie along the walls."""
    depth = np.full((60, 60), RIM)
    middle = (np.arange(60) + 0.5) * 0.005
    for box in placed:
        w, d = (box.w, box.d) if round(box.yaw / 90) % 2 == 0 else (box.d, box.w)
        inside = (abs(middle - box.x) < w / 2)[:, None] & (abs(middle - box.y) < d / 2)
        depth[inside] = np.minimum(depth[inside], RIM - box.h)
    return depth


def loads_by_hand(placed, heights) -> list[float]:
    """The mass above each box, over all that lie on it and on those: true positions, and the boxes' own heights."""

    def meet(a, b):
        return abs(a.x - b.x) < (a.w + b.w) / 2 - 1e-6 and abs(a.y - b.y) < (a.d + b.d) / 2 - 1e-6

    below: list[set[int]] = []
    for number, box in enumerate(placed):
        touched = [
            other for other in range(number)
            if meet(box, placed[other]) and abs(placed[other].h - (box.h - heights[number])) < 0.006
        ]  # fmt: skip
        below.append({*touched, *(deeper for other in touched for deeper in below[other])})
    return [
        sum(box.mass for box, under in zip(placed, below, strict=True) if number in under)
        for number in range(len(placed))
    ]


def test_no_item_carries_more_than_it_bears(planner):
    refused = 0
    for seed in range(12):
        random, placed, heights, failed = Random(seed), [], [], 0
        while failed < 4:
            w, d, h = (random.uniform(0.05, 0.12) for _ in range(3))
            limit = random.choice((None, 0.0, 1.0, 2.5))
            box = Box(0.15, 0.15, w, d, h, mass=random.choice((0.4, 1.0, 1.7)), max_load=limit)
            plan = planner.plan(Scene([box], tote_of(placed), placed=placed, **SCENE), alternatives=0)
            if plan.status != "ok":
                refused += "overloaded" in plan.reasons
                failed += 1
                continue
            placed.append(plan.placed)
            heights.append(h)
            assert (placed[-1].mass, placed[-1].max_load) == (box.mass, box.max_load)
            loads = loads_by_hand([each.upright() for each in placed], heights)
            limits = [math.inf if each.max_load is None else each.max_load for each in placed]
            assert all(load <= limit + 1e-9 for load, limit in zip(loads, limits, strict=True))
        assert len(placed) > 3
    assert refused > 10


@pytest.mark.parametrize(
    ("masses", "limits", "mass", "bears"),
    [
        ((1.0,), (1.0,), 1.0, True),
        ((1.0,), (1.0,), 1.001, False),
        ((1.0,), (0.0,), 0.1, False),
        ((1.0,), (0.0,), 0.0, False),  # its mass is not known
        ((1.0,), (None,), 0.0, True),
        ((0.0, 1.0), (None, None), 2.0, True),
        ((1.0, 0.0), (5.0, None), 0.1, False),  # what lies on the lowest is not known
        ((1.0, 3.0), (4.0, None), 1.0, True),  # a tower: the lowest bears all of it
        ((1.0, 3.0), (4.0, None), 1.1, False),
        ((0.5, 1.0, 1.5), (3.5, None, None), 1.0, True),
        ((0.5, 1.0, 1.5), (3.5, None, None), 1.1, False),
        ((1.0, 3.0), (2.0, None), 0.1, False),  # it is overloaded already
    ],
)
def test_a_tower(planner, masses, limits, mass, bears):
    """Slabs that cover the tote, one on another."""
    slabs = [
        Box(0.15, 0.15, 0.3, 0.3, 0.05 * level, mass=own, max_load=limit)
        for level, (own, limit) in enumerate(zip(masses, limits, strict=True), 1)
    ]
    item = Box(0.15, 0.15, 0.12, 0.08, 0.06, mass=mass)
    plan = planner.plan(Scene([item], np.full((60, 60), RIM - slabs[-1].h), placed=slabs, **SCENE))
    assert plan.status == ("ok" if bears else "stuck")
    if not bears:
        assert plan.reasons["overloaded"] > 0 and sum(plan.reasons.values()) == CELL.num_actions


def test_what_is_not_in_the_record_bears_nothing(planner):
    item, known = Box(0.15, 0.15, 0.12, 0.08, 0.06, mass=1.0), Box(0.02, 0.02, 0.03, 0.03, 0.05, max_load=9.0)
    flat = np.full((60, 60), RIM - 0.05)
    assert planner.plan(Scene([item], flat, placed=[known], **SCENE)).status == "stuck"
    flat[:, 30:] = RIM  # half of the floor is free
    plan = planner.plan(Scene([item], flat, placed=[known], **SCENE))
    assert plan.status == "ok" and plan.drop_height == 0


def test_a_mass_alone_trusts_nothing_unknown(planner):
    """With a record that lacks what is in the tote, and without a limit anywhere."""
    flat = np.full((60, 60), RIM - 0.1)
    heavy, light = (Box(0.15, 0.15, 0.12, 0.08, 0.06, mass=mass) for mass in (5.0, 0.0))
    assert planner.plan(Scene([heavy], flat, placed=[], **SCENE)).status == "stuck"
    assert planner.plan(Scene([light], flat, placed=[], **SCENE)).status == "ok"  # no box says anything of loads
    assert planner.plan(Scene([heavy], flat, **SCENE)).status == "ok"


def test_errors_of_heights_add_up(planner):
    """Left measured 104 mm, right 101 mm and recorded 98 mm: one lies on both if the true tops are 102 mm."""
    depth = np.full((60, 60), RIM - 0.104)
    depth[30:], depth[28:32] = RIM - 0.101, RIM
    halves = [Box(0.07, 0.15, 0.14, 0.3, 0.104), Box(0.23, 0.15, 0.14, 0.3, 0.098, max_load=0.0)]
    item = Box(0.15, 0.15, 0.08, 0.08, 0.06, mass=5.0)
    plan = planner.plan(Scene([item], depth, placed=halves, **SCENE))
    assert plan.status == "ok" and plan.placed.x + plan.placed.w / 2 < 0.15
    assert planner.plan(Scene([item], depth, placed=halves[1:], **SCENE)).status == "stuck"


def test_what_images_do_not_show_of_an_item_may_lie_on_something():
    cell = CellSpec(bin_size=(8, 8, 1), tote_size=(6, 6, 5), effector_size=(1, 1), pick_rule="seal", rotations=1)
    planner = Planner(cell, planner="joint_dbl")
    fragile = Box(0.27, 0.15, 0.06, 0.3, 0.05, max_load=0.0)
    base = Box(0.12, 0.15, 0.24, 0.3, 0.05)
    item = Box(0.15, 0.15, 0.245, 0.1, 0.06, edge_error=0.015, mass=5.0)
    plan = planner.plan(Scene([item], np.full((60, 60), RIM - 0.05), placed=[base, fragile], **SCENE))
    assert plan.status == "stuck" and plan.reasons["overloaded"] > 0


def test_a_neighbour_hides_no_carrier(planner):
    """C bears 1 kg and carries T with 1 kg, beside a tall N; nothing more may lie on T."""
    c = Box(0.1, 0.1, 0.14, 0.19, 0.05, mass=1.0, max_load=1.0)
    t = Box(0.1, 0.1, 0.14, 0.19, 0.1, mass=1.0)
    n = Box(0.22, 0.1, 0.09, 0.19, 0.09, mass=1.0)
    placed, full = [c, t, n], Box(0.15, 0.25, 0.3, 0.1, 0.25)
    item = Box(0.15, 0.15, 0.08, 0.08, 0.06, mass=0.5)
    for clearance in (0.005, 0.006, 0.008):
        scene = {**SCENE, "clearance": clearance}
        plan = planner.plan(Scene([item], tote_of([*placed, full]), placed=[*placed, full], **scene), alternatives=0)
        assert plan.status != "ok" or plan.placed.x > 0.17


def test_neighbours_do_not_carry_one_another(planner):
    """Items side by side, a full tote of them, fragile each: the gap between them is twice the clearance."""
    placed = []
    for _ in range(9):
        item = Box(0.15, 0.15, 0.09, 0.09, 0.1, mass=5.0, max_load=0.0)
        plan = planner.plan(Scene([item], tote_of(placed), placed=placed, **SCENE), alternatives=0)
        assert plan.status == "ok" and plan.drop_height == 0
        placed.append(plan.placed)
    assert planner.plan(Scene([item], tote_of(placed), placed=placed, **SCENE)).status == "stuck"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"placed": None}, r"^placed=None: some items have a max_load; expected what lies in the tote, plan.placed of"),
        ({"placed": [1]}, r"^placed=\[1\]: expected a list of Box"),
        ({"placed": [Box(0, 0, 1, 1, 0)]}, r"^placed\[0\].h=0: expected a length from 0.001 to 1000 m"),
        ({"items": [Box(0.1, 0.1, 0.1, 0.1, 0.1, mass=-1)]}, r"^items\[0\].mass=-1: expected a mass from 0 to 1000 kg"),
        (
            {"items": [Box(0.1, 0.1, 0.1, 0.1, 0.1, max_load="1")]},
            r"^items\[0\].max_load='1': expected a mass from",
        ),
    ],
)
def test_bad_loads_are_refused(planner, settings, message):
    given = {"items": [Box(0.1, 0.1, 0.1, 0.1, 0.1, max_load=1.0)], "placed": [], **settings}
    with pytest.raises(DepthMapError, match=message):
        planner.plan(Scene(given.pop("items"), np.full((6, 6), RIM), **given, **SCENE))


def test_whole_cells_have_no_loads():
    loaded = Planner(CellSpec(handling=True), planner="joint_dbl")
    item, tote = np.zeros((5, 5), dtype=int), np.full((6, 6), 5)
    item[1:3, 1] = 1
    with pytest.raises(
        ValueError, match=r"^env.handling=true: a scene in whole cells has no loads; expected one in me"
    ):
        loaded.plan(Scene.from_maps(item, tote))
    with pytest.raises(ValueError, match=r"^placed: the lengths are whole cells; expected a scene in metres"):
        Scene.from_maps(item, tote, placed=[])
    plan_once(loaded)  # as the commands do before the first request
    box = Box(0.1, 0.12, 0.08, 0.06, 0.05, mass=1.0, max_load=2.0)
    assert loaded.plan(Scene([box], np.full((6, 6), RIM), placed=[], **SCENE)).status == "ok"


def test_terms_of_loads_are_left_out():
    """A policy that does not read them plans all the same; one that does is refused."""
    cell = CellSpec(handling=True)
    terms = {**standard_terms(cell), "room": ToteCapacity()}
    policy = untrained_policy(cell)
    box = Box(0.1, 0.12, 0.08, 0.06, 0.05, mass=1.0, max_load=2.0)
    assert (
        Planner(cell, policy, terms=terms).plan(Scene([box], np.full((6, 6), RIM), placed=[], **SCENE)).action
        is not None
    )
    policy.in_keys = [*policy.in_keys, "room"]
    with pytest.raises(ValueError, match=r"^policy: it reads room, which a scene does not have; expected another"):
        Planner(cell, policy, terms=terms)


def test_a_request_has_loads(planner):
    slab = {"x": 0.15, "y": 0.15, "w": 0.3, "d": 0.3, "h": 0.05, "max_load": 1.5}
    item = {"x": 0.15, "y": 0.15, "w": 0.12, "d": 0.08, "h": 0.06}
    given = {"tote_depth": [[0.2] * 30] * 30, "placed": [slab], **SCENE}
    for mass, status in ((1.5, "ok"), (1.6, "stuck")):
        request = PlanRequest.parse({"items": [{**item, "mass": mass}], **given}, {})
        plan = request.plan(planner).as_dict()
        assert plan["status"] == status
        assert plan["placed"] is None or (plan["placed"]["mass"], plan["placed"]["h"]) == (mass, pytest.approx(0.11))
    with pytest.raises(ValueError, match=r"^placed\[0\]: expected the keys x, y, w, d, h and"):
        PlanRequest.parse({"items": [item], **given, "placed": [{"load": 1}]}, {})
