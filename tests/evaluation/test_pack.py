"""``pickplace-pack``: every item once, inside its container, apart from the others, and carried; files and errors."""

import csv
import io
import json
import math
import random
import shutil
import sys
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from scipy.spatial import ConvexHull

from pickplace.common.validate import refuse_if
from pickplace.evaluation import pack as packing
from pickplace.evaluation import pack_command
from pickplace.evaluation.pack import OrderPacker
from pickplace.items.order_file import ORIENTATIONS, OrderItem
from pickplace.physics.engine import build_engine
from pickplace.physics.plans import read_plans
from pickplace.rules.item import NO_LIMIT
from pickplace.views import replay

ORDERS = Path(__file__).resolve().parents[2] / "docs/examples/orders/orders.csv"
CONTAINER, CELL = (419, 315, 250), 20  # whole cells leave 19 and 15 mm
SIDES = st.tuples(st.integers(5, 200), st.integers(25, 200), st.one_of(st.integers(20, 120), st.floats(20, 120)))
FEW_KINDS = st.lists(SIDES, min_size=1, max_size=3).flatmap(
    lambda kinds: st.lists(st.sampled_from(kinds), min_size=1, max_size=25)
)


def overlap(one, other, axes=(0, 1, 2)):
    """Least length of the common part of two boxes along some axes, mm."""
    return min(
        min(one.corner[a] + one.size[a], other.corner[a] + other.size[a]) - max(one.corner[a], other.corner[a])
        for a in axes
    )


def clipped(polygon, box):
    """The part of a convex polygon above or below a box, as its corners in their order."""
    for axis, sign, edge in [
        (a, s, s * (box.corner[a] + (box.size[a] if s > 0 else 0))) for a in (0, 1) for s in (1, -1)
    ]:
        found = []
        for one, two in zip(polygon, [*polygon[1:], *polygon[:1]], strict=True):
            at, to = sign * one[axis] - edge, sign * two[axis] - edge
            found += [one] if at <= 0 else []
            found += [one + (two - one) * at / (at - to)] if at * to < 0 else []
        polygon = found
    return polygon


def all_carried(items):
    """Whether each item has its four corners, or its centre by 10 mm, in the hull of its true contact with what is
    below; there, only what lies in the hull of that item's own contact counts. By plane geometry."""
    hulls = []
    for place, packed in enumerate(items):
        low = np.array(packed.corner[:2])
        corners = low + np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * packed.size[:2]
        hulls.append([*corners])
        if packed.corner[2] > 0:
            points = [
                point
                for other, hull in zip(items[:place], hulls, strict=False)
                if abs(other.corner[2] + other.size[2] - packed.corner[2]) < 1.0
                and overlap(packed, other, (0, 1)) > 1e-6
                for point in clipped(hull, packed)
            ]
            hull = ConvexHull(points)
            outside = np.column_stack([[*corners, low + np.array(packed.size[:2]) / 2], np.ones(5)]) @ hull.equations.T
            if outside[4].max() > 1e-6 - 10 and outside[:4].max() > 1e-6:
                return False
            hulls[-1] = [*hull.points[hull.vertices]]
    return True


@settings(max_examples=12, deadline=None)
@given(st.one_of(st.lists(SIDES, min_size=1, max_size=25), FEW_KINDS), st.booleans(), st.booleans())
def test_items_lie_apart_inside_and_are_carried(sizes, keep, tipping):
    items = [OrderItem(str(n), *map(float, sides), 100, f"line {n}") for n, sides in enumerate(sizes)]
    _, containers = OrderPacker(CONTAINER, CELL, tipping=tipping).pack(items, keep_sequence=keep)
    numbers = [packed.number for each in containers for packed in each.items]
    assert sorted(numbers) == [*range(1, len(items) + 1)]
    for each in containers:
        assert not keep or [packed.number for packed in each.items] == sorted(packed.number for packed in each.items)
        for place, packed in enumerate(each.items):
            assert items[packed.number - 1] is packed.item
            sides = dict(zip(packed.orientation, packed.size, strict=True))
            assert sides == {"l": packed.item.length, "w": packed.item.width, "h": packed.item.height}
            assert tipping or packed.size[packed.turned] == packed.item.length
            assert all(0 <= packed.corner[a] <= CONTAINER[a] - packed.size[a] + 1e-6 for a in range(3))
            assert all(overlap(packed, other) < 1e-6 for other in each.items[:place])
        assert all_carried(each.items), each.items
        volume = sum(math.prod(packed.size) for packed in each.items)
        assert each.occupancy == pytest.approx(volume / math.prod(CONTAINER))


LIMITS = st.tuples(
    st.integers(1, 9), st.sampled_from([NO_LIMIT, NO_LIMIT, 20, 8, 0]),
    st.sampled_from([ORIENTATIONS, ORIENTATIONS, ("lwh",), ("wlh", "hwl"), ("lwh", "wlh", "hlw")]),
)  # fmt: skip


@settings(max_examples=12, deadline=None)
@given(st.lists(st.tuples(SIDES, LIMITS), min_size=1, max_size=25), st.booleans(), st.booleans())
def test_loads_and_turns_are_as_the_items_allow(sizes, keep, tipping):
    """By the items' true sides: the loads are counted again, from the first item up."""
    items = [
        OrderItem(str(n), *map(float, sides), grams, f"line {n}", max_load, orientations)
        for n, (sides, (grams, max_load, orientations)) in enumerate(sizes)
    ]
    _, containers = OrderPacker(CONTAINER, CELL, tipping=tipping).pack(items, keep_sequence=keep)
    assert sum(len(each.items) for each in containers) == len(items)
    for each in containers:
        below = []
        load = [0] * len(each.items)
        for packed in each.items:
            assert packed.orientation in packed.item.orientations[: None if tipping else 2]
            carriers = {
                number
                for number, other in enumerate(each.items[: len(below)])
                if abs(other.corner[2] + other.size[2] - packed.corner[2]) < 1e-6 and overlap(packed, other, (0, 1)) > 0
            }
            below.append(carriers.union(*(below[number] for number in carriers)))
            for number in below[-1]:
                load[number] += packed.item.grams
        assert all(total <= packed.item.max_load for total, packed in zip(load, each.items, strict=True))


@pytest.mark.parametrize(("orientations", "tipping", "containers"), [
    (("lhw", "wlh"), True, 1), (ORIENTATIONS, True, 2), (("lwh", "wlh"), True, 3), (ORIENTATIONS, False, 3),
    (("lwh", "hlw"), True, 3),
])  # fmt: skip
def test_boxes_that_may_lie_on_their_side(orientations, tipping, containers):
    """In 200 x 180 x 100 mm one box of 200 x 100 x 60 mm lies flat, with another one on its side; or three on their
    sides, as lhw."""
    items = [OrderItem("box", 200.0, 100.0, 60.0, 9, "line 1", orientations=orientations)] * 3
    cell, found = OrderPacker((200, 180, 100), CELL, tipping=tipping).pack(items)
    assert len(found) == containers
    for move in (move for each in found for move in each.recording.moves):  # the page shows an item alone in a bin
        assert move.item[:2] == (0, 0) and not move.others and move.item[2] <= cell.bin_size[0] and cell.bin_items == 1


def test_what_bears_nothing_comes_last_if_that_packs_more():
    """A plate on which nothing may lie fits on top of two cubes; first, it would leave no room for them."""
    items = [
        OrderItem("plate", 200.0, 100.0, 20.0, 9, "line 1", 0),
        *(OrderItem("cube", *[100.0] * 3, 9, "line 2"),) * 2,
    ]
    _, (one,) = OrderPacker((200, 100, 130), CELL).pack(items)
    assert [packed.item.id for packed in one.items] == ["cube", "cube", "plate"]
    _, several = OrderPacker((200, 100, 130), CELL).pack(items, keep_sequence=True)
    assert len(several) == 2


@settings(max_examples=3, deadline=None)
@given(st.lists(SIDES, min_size=10, max_size=20), st.booleans())
def test_the_first_container_is_the_best_of_the_sequences_one_by_one(sizes, tipping):
    items = [OrderItem(str(n), *map(float, sides), 100, f"line {n}") for n, sides in enumerate(sizes)]
    keys = (
        lambda item: -item.length * item.width,
        lambda item: -item.length * item.width * item.height,
        lambda item: -item.height,
    )
    alone = []
    for planner in ("heightmap_minimisation", "joint_dbl"):
        if not alone or any(len(each.items) == len(items) for each in alone):
            for key, tipped in product(keys, [True, False] if tipping else [False]):
                packer = OrderPacker(CONTAINER, CELL, planner, tipped)
                alone.append(packer.pack(sorted(items, key=key), keep_sequence=True)[1][0])
    _, (together, *_) = OrderPacker(CONTAINER, CELL, tipping=tipping).pack(items)
    best = min(alone, key=lambda each: (-len(each.items), -each.occupancy, each.top))
    found, expected = (
        [(packed.item.id, packed.corner, packed.orientation) for packed in each.items] for each in (together, best)
    )
    assert found == expected


def test_what_is_left_lies_on_the_floor_if_there_is_room():
    """The heuristic that minimises gaps would build a tower of five."""
    items = [OrderItem("box", 270.0, 390.0, 262.0, 9, "line 1")] * 6
    _, (one,) = OrderPacker((1200, 800, 1500), CELL).pack(items)
    assert one.top == 262 and all_carried(one.items)
    _, (tower,) = OrderPacker((1200, 800, 1500), CELL, "heightmap_minimisation").pack(items)
    assert tower.top == 5 * 262


def test_equal_items_are_not_tried_again_in_a_full_container(monkeypatch):
    """With two kinds, a container costs a try for each item in it, and few more."""
    tried = Mock(side_effect=packing.placing_maps)
    monkeypatch.setattr(packing, "placing_maps", tried)
    kinds = [OrderItem("a", 100.0, 80.0, 60.0, 9, "line 1"), OrderItem("b", 90.0, 80.0, 50.0, 9, "line 2")]
    _, containers = OrderPacker((200, 100, 120), CELL, "joint_dbl").pack([kinds[n % 2] for n in range(60)])
    assert sum(len(each.items) for each in containers) == 60 and len(containers) >= 10
    assert tried.call_count <= 60 + 6 * len(containers)


def test_an_equal_item_is_tried_again_once_another_one_is_placed():
    """A plate lies on two cubes, not on one."""
    cube, plate = (OrderItem(str(h), side, 100.0, h, 9, "line 1") for side, h in ((100.0, 100.0), (200.0, 30.0)))
    _, (first, second) = OrderPacker((200, 100, 130), CELL).pack([cube, plate, cube, plate], keep_sequence=True)
    assert [[packed.number for packed in each.items] for each in (first, second)] == [[1, 3, 4], [2]]


@pytest.mark.parametrize("planner", ["joint_dbl", "best_fit", "individual_heuristic"])
def test_a_planner_that_finds_no_place_leaves_the_item(planner):
    """individual_heuristic finds none in some containers where there is one."""
    draw = random.Random("FalseFalseFalse")
    items = [OrderItem(str(n), *(draw.uniform(40, 160) for _ in range(3)), 100, f"line {n}") for n in range(14)]
    _, containers = OrderPacker((300, 240, 250), CELL, planner).pack(items)
    assert sorted(packed.number for each in containers for packed in each.items) == [*range(1, 15)]
    for each in containers:
        assert all_carried(each.items)
        assert all(overlap(a, b) < 1e-6 for place, a in enumerate(each.items) for b in each.items[:place])


def test_tops_that_are_rounded_alike_are_not_level():
    """The pile of ten ends 8 mm below the box beside it, though ten heights of 10.1 mm rounded up make 110 mm, too."""
    sizes = [(40, 100, 109.2), *[(160, 100, 10.1)] * 10, (200, 100, 20)]
    items = [OrderItem(str(n), *map(float, sides), 100, f"line {n}") for n, sides in enumerate(sizes)]
    _, containers = OrderPacker((200, 100, 300), CELL).pack(items, keep_sequence=True)
    for each in containers:
        assert all_carried(each.items)
    assert len(containers) == 2  # nothing carries the last item in the first one


@pytest.mark.parametrize("sizes", [
    # The last one's cells have their middle 21 mm from the diagonal edge of the support; its centre is 8 mm from it.
    [(80, 20, 10), (40, 20, 50), (20, 60, 10), (100, 60, 10), (20, 20, 50), (80, 20, 10), (20, 20, 50), (101, 81, 20)],
    # The third one's support ends diagonally in its last cells: the last one lies above the hull of the cells only.
    [(120, 20, 50), (60, 80, 50), (101, 81, 20), (100, 20, 30), (60, 20, 30), (40, 19, 30)],
])  # fmt: skip
def test_cells_that_an_item_fills_in_part_do_not_mislead(sizes):
    items = [OrderItem("", *map(float, each), 9, "line 1", orientations=("lwh",)) for each in sizes]
    _, containers = OrderPacker((120, 100, 120), CELL, "joint_dbl").pack(items, keep_sequence=True)
    assert all(all_carried(each.items) for each in containers)
    assert len(containers) == 2


@pytest.mark.parametrize("side", [75.0, 41.5, 35.0])
def test_boxes_that_fill_no_whole_cells_stack(side):
    """Nine piles of eight, and one box more."""
    pitch = 20 * math.ceil(side / 20)
    items = [OrderItem("", side, side, 30.0, 9, "line 1", max_load=63)] * 73
    _, (first, second) = OrderPacker((3 * pitch, 3 * pitch, 250), CELL).pack(items)
    assert (len(first.items), len(second.items)) == (72, 1) and all_carried(first.items)


@pytest.mark.parametrize(("side", "corners"), [(35, [(0, 0, 30), (0, 40, 30)]), (36, [(0, 0, 30)])])
def test_an_item_lies_on_a_larger_one_up_to_its_far_side(side, corners):
    """Of 75 mm, 35 mm are free beside the second item, from 40 mm on. A third one of 36 mm would stick out."""
    sides = [(35, 75, 30), (35, 35, 20), (35, side, 20)]
    items = [OrderItem("", *map(float, each), 9, "line 1", orientations=("lwh",)) for each in sides]
    _, (first, *_) = OrderPacker((40, 80, 100), CELL, "joint_dbl").pack(items, keep_sequence=True)
    assert [packed.corner for packed in first.items[1:]] == corners


@pytest.mark.parametrize("planner", ["joint_dbl", "heightmap_minimisation", "individual_heuristic"])
def test_an_item_is_turned_to_lie_on_another_one(planner):
    """Both take 4 x 4 cells. The second one fits on the first if it is turned, and only if it may be turned."""
    for orientations, count in ((ORIENTATIONS, 2), (("lwh",), 1)):
        items = [OrderItem("", 75.0, 65.0, 30.0, 9, "line 1", orientations=("lwh",))]
        items.append(OrderItem("", 65.0, 75.0, 30.0, 9, "line 1", orientations=orientations))
        _, (first, *_) = OrderPacker((80, 80, 100), CELL, planner).pack(items, keep_sequence=True)
        assert [packed.turned for packed in first.items] == [False, True][:count]
        assert all_carried(first.items)


@pytest.mark.parametrize("planner", ["joint_dbl", "heightmap_minimisation", "best_fit", "corner", "online_bph"])
def test_boxes_that_lie_turned_stack(planner):
    """Four piles of eight: a place on another one is not taken for one of the other turn."""
    items = [OrderItem("", 75.0, 65.0, 30.0, 9, "line 1", orientations=("wlh",))] * 32
    _, containers = OrderPacker((160, 160, 250), CELL, planner).pack(items, keep_sequence=True)
    assert [len(each.items) for each in containers] == [32]


def test_an_item_lies_beside_sheets_that_bear_nothing():
    """The sheets end below the same whole millimetre as the box on which they lie."""
    sides = [(155, 75, 30.2, 9, NO_LIMIT), (15, 75, 0.5, 9, 20), (15, 75, 0.5, 50, 0), (55, 55, 20, 9, NO_LIMIT)]
    items = [OrderItem("", *map(float, each), grams, "line 1", load, ("lwh",)) for *each, grams, load in sides]
    _, (one,) = OrderPacker((160, 80, 60), CELL, "joint_dbl").pack(items, keep_sequence=True)
    assert [packed.corner[0] for packed in one.items] == [0, 0, 20, 40]


def test_an_item_lies_on_one_that_bears_it():
    """The lower one bears 5 g only."""
    sides = [(75, 75, 30, 5), (75, 75, 50, NO_LIMIT), (75, 75, 10, NO_LIMIT)]
    items = [OrderItem("", *map(float, each), 9, "line 1", max_load) for *each, max_load in sides]
    _, (one,) = OrderPacker((80, 160, 100), CELL, "joint_dbl").pack(items, keep_sequence=True)
    assert [packed.corner for packed in one.items] == [(0, 0, 0), (0, 80, 0), (0, 80, 50)]


def test_the_last_cells_of_an_item_under_another_one_still_carry_nothing_else():
    """The first one does not fill them. The second one lies on it wholly, the third one would lie across."""
    sides = [(123, 128, 47), (41, 114, 65), (80, 15, 57)]
    items = [OrderItem("", *map(float, each), 9, "line 1", orientations=("lwh",)) for each in sides]
    _, containers = OrderPacker((182, 274, 207), 25).pack(items, keep_sequence=True)
    assert all(all_carried(each.items) for each in containers)


def test_tiny_items_and_orders_of_one_name_end(pack, tmp_path):
    """Orders keep apart, with one name in both files: those that differ by a control character, or clash with another
    one's second container."""
    (path := tmp_path / "a.csv").write_text(
        "order,l,w,h,kg\n7,300,200,200,1\n7,300,200,200,1\n7#2,60,50,20,1\n8,1e-6,50,20,1e-9\n8\x1b[31m,50,50,50,1\n"
        "8\x1c[31m,50,50,50,1\na,50,50,50,1\n"
    )
    folder, out = pack(path, "--container", "300x200x200")
    names = ["7", "7#2'", "8", "8?[31m", "8?[31m'", "a"]
    assert [*json.loads((folder / "plan.json").read_text())] == ["7", "7#2", *names[1:]]
    with (folder / "plan.csv").open() as file:
        assert [*dict.fromkeys(row["order"] for row in csv.DictReader(file))] == names
    assert "\x1b" not in out


def test_a_plan_of_bed_bpp_is_what_its_code_reads(pack, tmp_path):
    """Whole millimetres, the names of the input, and two orientations: a tipped item has the sides as it lies."""
    names = {"article": "tea-7", "id": "7", "product_group": "tea"}
    box = {**names, "length/mm": 200, "width/mm": 100, "height/mm": 60, "weight/kg": 1.5, "sequence": 1}
    (path := tmp_path / "a.json").write_text(json.dumps({"a": {"item_sequence": {str(n): box for n in range(1, 4)}}}))
    folder, _ = pack(path, "--container", "200x180x100", "--tipping")
    with (folder / "plan.csv").open() as file:
        rows = [*csv.DictReader(file)]
    actions = [action for each in json.loads((folder / "plan.json").read_text()).values() for action in each]
    assert {*names.items()} <= {*actions[0]["item"].items()}
    assert {row["orientation"] for row in rows} & {*ORIENTATIONS[2:]}
    for row, action in zip(rows, actions, strict=True):
        sides = [action["item"][key] for key in ("length/mm", "width/mm", "height/mm")]
        assert {*map(type, [*sides, *action["flb_coordinates"]])} == {int}
        if action["orientation"]:
            sides[:2] = sides[1::-1]
        assert sides == [float(row[key]) for key in ("along_x/mm", "along_y/mm", "height/mm")]
        assert action["orientation"] in (0, 1)


def test_all_orders_are_packed_before_the_first_file_and_old_pages_go(pack, tmp_path, monkeypatch):
    (path := tmp_path / "a.csv").write_text("order,l,w,h,kg\n1,50,50,50,1\n2,50,50,50,1\n")
    folder, _ = pack(path, "--container", "100x100x100")
    for name in ("replay.html", "replay_3.html", "replay_03.html"):
        (folder / name).write_text("old")
    pack(path, "--container", "100x100x100")
    left = {file.name for file in folder.iterdir()} - {"plan.csv", "plan.json", "plans.jsonl"}
    assert left == {"replay_1.html", "replay_2.html", "replay_03.html"}
    shutil.rmtree(folder)
    packed = OrderPacker.pack

    def fail(self, items, keep):
        refuse_if(items[0].place.endswith("line 3"), "late")
        return packed(self, items, keep)

    monkeypatch.setattr(OrderPacker, "pack", fail)
    pack(path, "--container", "100x100x100", code=2)
    assert not [*folder.iterdir()]
    folder.rmdir()
    folder.write_text("")
    error, _ = pack(path, "--container", "100x100x100", code=2)  # before it packs
    assert "File exists" in error and "late" not in error


def test_the_rule_that_picks_first_packs_an_item_that_fits_tipped_only(pack, tmp_path):
    (path := tmp_path / "a.csv").write_text("l,w,h,kg\n60,80,200,1\n60,80,40,1\n")
    pack(path, "--container", "250x250x150", "--tipping", "--planner", "individual_heuristic")


def test_a_reader_that_ends_early_costs_no_plan(pack, tmp_path, monkeypatch):
    (path := tmp_path / "a.csv").write_text("order,l,w,h,kg\n1,10,20,30,1\n2,10,20,30,1\n", encoding="utf-8")
    written = []
    monkeypatch.setattr(pack_command, "write_output", lambda text: written.append([*tmp_path.rglob("plan.csv")]))
    pack(path, "--container", "300x300x250")
    assert all(map(len, written)) and len(written) == 1


def test_bad_arguments_in_python_are_named():
    for container in ((300, 300), (300.5, 300, 250), "300"):
        with pytest.raises(ValueError, match="^container=.*: expected 3 whole numbers"):
            OrderPacker(container)
    with pytest.raises(ValueError, match="^items: the order has none; expected at least one"):
        OrderPacker((300, 300, 250)).pack([])


def test_a_name_that_the_terminal_cannot_show_loses_nothing(pack, tmp_path, monkeypatch):
    (path := tmp_path / "a.csv").write_text("order,l,w,h,kg\n\u0410,10,20,30,1\n", encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written := io.BytesIO(), encoding="ascii"))
    folder, _ = pack(path, "--container", "300x300x250")
    assert b"\\u0410, container 1 of 1: 1 item" in written.getvalue() and (folder / "replay.html").is_file()


def test_a_failure_leaves_the_old_plan(pack, tmp_path, monkeypatch):
    (path := tmp_path / "a.csv").write_text("l,w,h,kg\n50,50,50,1\n")
    folder, _ = pack(path, "--container", "100x100x100")
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    monkeypatch.setattr(replay, "page", lambda *_: refuse_if(True, "late"))
    path.write_text("l,w,h,kg\n50,50,40,1\n")
    pack(path, "--container", "100x100x100", code=2)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_there_is_room_for_the_items_that_fit_a_container_only():
    """Of a thousand items, so that loads take little memory; none is left out although heights are rounded up."""
    items = [OrderItem("a", 100.0, 100.0, 62.1, 9, "line 1", max_load=10**6)] * 1000
    packer = OrderPacker((200, 100, 312), 20)
    cell, (first, *others) = packer.pack(items[:25])
    assert cell.room == 10 and [len(each.items) for each in (first, *others)] == [10, 10, 5]
    assert packer._cell_for(items).room == 10


def test_an_order_is_checked_for_a_cell_that_is_too_fine():
    item = OrderItem("sheet", 2000.0, 1000.0, 5.0, 9, "line 1")
    with pytest.raises(ValueError, match="^cell=5 mm is too fine: tote_size="):
        OrderPacker((2000, 1000, 250), 5).check([item])


def test_a_sheet_as_large_as_the_container():
    """Its bin has as many cells as the container: their product says nothing about packing."""
    items = [OrderItem("sheet", 1200.0, 800.0, 5.0, 9, "line 1")] * 2
    _, (one,) = OrderPacker((1200, 800, 100), 10).pack(items, keep_sequence=True)
    assert len(one.items) == 2


def test_a_sheet_that_may_be_tipped():
    """Its bin shows it on each side, so that it has three times as many cells as the container."""
    OrderPacker((1500, 1500, 1800), 10, tipping=True).check([OrderItem("sheet", 1490.0, 1480.0, 300.0, 9, "line 1")])


def test_an_order_whose_loads_would_fill_the_memory():
    items = [OrderItem("pill", 20.0, 20.0, 20.0, 9, "line 1", max_load=9)] * 8_000
    with pytest.raises(ValueError, match="^line 1: the order has 8,000 items, some with limits; 8,000 fit"):
        OrderPacker((1200, 800, 1500), 20).check(items)


@pytest.fixture
def pack(run, tmp_path):
    """Run ``pickplace-pack``; returns its folder, or standard error if it fails, and standard output."""

    def call(*words, code=0):
        found, out, err = run("pack", *words, "--out", tmp_path / "out")
        assert found == code, err
        return err if code else tmp_path / "out", out

    return call


def test_the_command_writes_what_it_prints(pack):
    folder, out = pack(ORDERS, "--container", "300x300x250", "--cell", "10")
    assert sorted(path.name for path in folder.iterdir()) == [
        "plan.csv", "plan.json", "plans.jsonl", *(f"replay_{number}.html" for number in range(1, 7)),
    ]  # fmt: skip
    assert "1001, container 1 of 1: 6 items, 14.8% of its volume, 2.8 kg" in out
    with (folder / "plan.csv").open() as file:
        rows = [*csv.DictReader(file)]
    plan = json.loads((folder / "plan.json").read_text())
    assert [*plan] == ["1001", "1002", "1003", "1004", "1005", "1006"]
    actions = [action for actions in plan.values() for action in actions]
    assert len(rows) == len(actions) == 39
    for row, action in zip(rows, actions, strict=True):
        assert [float(row[key]) for key in ("x/mm", "y/mm", "z/mm")] == action["flb_coordinates"]
        assert (row["id"], int(row["turned"])) == (action["item"]["id"], action["orientation"])
    plans = read_plans(folder / "plans.jsonl")  # which checks that nothing overlaps or floats
    assert all(
        outcome.ending == "done" for outcome in build_engine(OmegaConf.create({"_target_": "settle"})).carry_out(plans)
    )
    assert (folder / "replay_6.html").read_text().startswith("<!DOCTYPE html>")


def test_a_second_container_takes_what_is_left(pack, tmp_path):
    (path := tmp_path / "pallet.csv").write_text("l,w,h,kg,qty\n200,300,200,1,3\n100,100,30,1,1\n")
    folder, out = pack(path, "--container", "400x300x250")
    assert "pallet, container 1 of 2: 3 items" in out and "pallet, container 2 of 2: 1 item," in out
    assert [*json.loads((folder / "plan.json").read_text())] == ["pallet", "pallet#2"]
    assert (folder / "replay.html").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--container", "0x300x250"], "--container=0x300x250: expected sides of 1 mm or more."),
        (["--container", "400x300"], "--container=400x300: expected whole millimetres, such as 1200x800x1500."),
        (["--container", "15x300x250"], "container=15x300x250: expected a length and a width of at least 20 mm."),
        (["--container", "4000x4000x250", "--cell", "2000"], "cell=2000: expected a whole number >= 1 and <= 1,000."),
        (["--container", "100x100x250"], "orders.csv, line 4: 140 x 90 x 45 mm; expected an item that fits the"),
        (["--container", "400x300x250", "--planner", "policy"], "planner=policy: expected joint_dbl, corner, best_fit"),
        (["--container", "400x300x250", "--planner", "jointdbl"], "planner=jointdbl: expected joint_dbl, corner, "),
        (["--container", "400x300x250", "--planner", "test_pack.ORDERS"], "test_pack.ORDERS: there is no such class"),
        (["--container", "400x300x250", "--unit", "inch"], "--unit='inch': expected 'mm'"),
        (["--container", "1000x1000x250", "--cell", "1"], "cell=1 mm is too fine: tote_size=[1000, 1000, 250]"),
        (["--container", "400x300x9999"], "container=400x300x9999: expected a height of 1 to 2,000 mm."),
    ],
)  # fmt: skip
def test_bad_words_are_refused_in_one_sentence(pack, words, message):
    err, _ = pack(ORDERS, *words, code=2)
    assert message in err and err.count("\n") == 1


def test_columns_that_are_not_read_are_named(pack, tmp_path):
    (path := tmp_path / "a.csv").write_text("l,w,h,kg,fragile,amount,,note\n200,300,200,1,yes,3,,\n")
    _, out = pack(path, "--container", "400x300x250")
    assert f"\n{path}: not read: fragile, amount, note.\n" in out
    _, out = pack(ORDERS, "--container", "300x300x250")
    assert "not read" not in out


def test_a_planner_of_the_user(pack, monkeypatch):
    monkeypatch.syspath_prepend(str(ORDERS.parents[1] / "own_planner"))
    words = ["--container", "300x300x250", "--planner", "own_planner.SoftDBL"]
    assert (
        "or a subclass of pickplace.planners.base.MapPlanner that needs no training" in pack(ORDERS, *words, code=2)[0]
    )


def test_the_lines_that_fit_no_container_are_counted(pack, tmp_path):
    (path := tmp_path / "pallet.csv").write_text("l,w,h,kg,qty\n200,300,200,1,3\n700,100,30,1,2\n800,20,20,1,1\n")
    err, _ = pack(path, "--container", "400x300x250", code=2)
    assert "line 3: 700 x 100 x 30 mm, and 1 more line of this order; expected" in err
