"""Orders of a file: read in any units, rounded up to cells, in streams that share none, drawn like those that train."""

import csv
import json
import math
import pickle
from collections import Counter
from itertools import combinations, groupby

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import PickPlaceEnv
from pickplace.evaluation.play import check_play, play
from pickplace.items.order_file import MILLIMETRES, ORIENTATIONS, read_orders
from pickplace.items.orders import Orders
from pickplace.planners.heuristics import JointDBL
from pickplace.rules.item import NO_LIMIT
from pickplace.rules.state import Failure
from pickplace.rules.step import apply

BIN = (40, 40, 1)
SIDES = st.tuples(*[st.integers(1, 600)] * 3, st.integers(1, 30_000))  # mm and g
ORDERS = st.lists(st.lists(SIDES, min_size=1, max_size=8), min_size=3, max_size=12, unique_by=tuple)


def write_csv(path, orders, unit="mm", header=None, weight="kg"):
    """A CSV of orders of (length, width, height, grams), sides written in a unit."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header or ["order", f"length/{unit}", f"width/{unit}", f"height/{unit}", f"weight/{weight}"])
        for number, order in enumerate(orders):
            for *sides, grams in order:
                writer.writerow(
                    [number, *(side / MILLIMETRES[unit] for side in sides), grams / {"kg": 1000, "g": 1}[weight]]
                )
    return path


def write_bed_bpp(path, orders):
    items = [
        {
            str(number): {"id": f"{order}-{number}", "article": "a", "length/mm": w, "width/mm": d, "height/mm": h,
                          "weight/kg": grams / 1000, "sequence": number, "product_group": "b"}
            for number, (w, d, h, grams) in reversed([*enumerate(each, 1)])  # their numbers decide, not their place
        }
        for order, each in enumerate(orders)
    ]  # fmt: skip
    path.write_text(json.dumps({f"{n:08}": {"item_sequence": each, "properties": {}} for n, each in enumerate(items)}))
    return path


def episode(items, stream, number, seed=0, most=200):
    """The (w, d, h, grams) of an episode, asked for one by one."""
    found = []
    for step in range(most):
        item = items.sample(stream, *(torch.tensor([value]) for value in (seed, number, step)), BIN)
        if not item.exists:
            return found
        assert 0 <= item.x <= BIN[0] - item.w and 0 <= item.y <= BIN[1] - item.d
        found.append(tuple(int(part) for part in (item.w, item.d, item.h, item.grams)))
    raise AssertionError("the order does not end")


def runs(order):
    return [(kind, len([*run])) for kind, run in groupby(order)]


def in_cells(order, cell, unit):
    return [(math.ceil(w / cell), math.ceil(d / cell), math.ceil(h / (cell * unit)), grams) for w, d, h, grams in order]


@settings(max_examples=25, deadline=None)
@given(ORDERS, st.sampled_from(["mm", "cm", "m"]), st.sampled_from(["kg", "g"]))
def test_a_file_is_read_in_any_unit(tmp_path_factory, orders, unit, weight):
    folder = tmp_path_factory.mktemp("orders")
    files = write_csv(folder / "a.csv", orders, unit, weight=weight), write_bed_bpp(folder / "b.json", orders)
    header = ["order", "L", "W", "H", "mass/g"]
    for read in (*map(read_orders, files), read_orders(write_csv(folder / "c.csv", orders, "cm", header, "g"), "cm")):
        found = [[(*item[1:4], item.grams) for item in order.items] for order in read]
        assert [[pytest.approx(item, abs=1e-6) for item in order] for order in orders] == found


@settings(max_examples=10, deadline=None)
@given(ORDERS, st.sampled_from([(0.02, 1.0), (0.03, 0.25)]))
def test_streams_share_no_order_and_play_each_once(tmp_path_factory, orders, sizes):
    cell, unit = sizes
    path = write_csv(tmp_path_factory.mktemp("orders") / "a.csv", orders, "m", weight="g")

    def sizes_of(order):
        return tuple(sorted(item[:3] for item in order))

    alike = {*map(sizes_of, orders)}
    if len(alike) < 3:
        with pytest.raises(ValueError, match=f"has {len(alike)} orders of different sizes"):
            Orders(path, cell, unit, generate=False)
        return
    items = Orders(path, cell, unit, generate=False)
    played = {
        stream: [episode(items, stream, number) for number in range(items.num_episodes(stream) or 60)]
        for stream in ("train", "validation", "test")
    }
    expected = [in_cells(order, 1000 * cell, unit) for order in orders]
    for stream, each in played.items():
        number = torch.arange(len(each))
        assert items.num_items(stream, torch.zeros_like(number), number).tolist() == [*map(len, each)]
    assert all(order in expected for each in played.values() for order in each)
    counts = {stream: items.num_episodes(stream) for stream in ("validation", "test")}
    assert all(count >= 1 for count in counts.values()) and sum(counts.values()) < len(orders)
    # Orders with the same sizes are in one stream, in whatever sequence and on any grid; all are there.
    finer = Orders(path, cell / 2, unit, generate=False)
    assert finer._orders == items._orders
    shown = [
        {sizes_of([items._examples[kind][1:] for kind in order]) for order in each} for each in items._orders.values()
    ]
    assert all(not one & other for one, other in combinations(shown, 2))
    whole = {stream: [tuple(order) for order in items._orders[stream]] for stream in played}
    assert len({*whole["train"], *whole["validation"], *whole["test"]}) == len(orders) == sum(map(len, whole.values()))


@pytest.mark.parametrize(("header", "message"), [
    ("max_load/lb", "the column 'max_load/lb' is not known; expected max_load in g or kg."),
    ("Max. load (t)", "the column 'Max. load \\(t\\)' is not known; expected max_load in g or kg."),
    ("MaxLoad", "the column 'MaxLoad' is not known; expected max_load in g or kg."),
    ("Stackable?", "the column 'Stackable\\?' is not known; expected stackable."),
    ("Quantity (pcs)", "the column 'Quantity \\(pcs\\)' is not known; expected quantity."),
    ("orientations allowed", "expected orientations."), ("qty per line", "expected quantity."),
])  # fmt: skip
def test_a_column_that_is_almost_named_like_a_limit_is_refused(tmp_path, header, message):
    (path := tmp_path / "a.csv").write_text(f"l,w,h,kg,colour,{header}\n1,2,3,4,red,1\n")
    with pytest.raises(ValueError, match=f"a.csv, line 1: .*{message}"):
        read_orders(path)


def test_an_order_without_a_name_among_others_is_refused(tmp_path):
    (path := tmp_path / "a.csv").write_text("order,l,w,h,kg\n7,1,2,3,4\n,1,2,3,4\n")
    with pytest.raises(ValueError, match=r"line 3: its order has no name; expected one in each line, or in none"):
        read_orders(path)


def test_sizes_are_equal_in_any_unit(tmp_path):
    (path := tmp_path / "a.csv").write_text("l/m,w/cm,h/mm,kg\n1.003,100.3,69,1\n")
    assert read_orders(path)[0].items[0][1:4] == (1003, 1003, 69)


def test_an_order_in_bed_bpp_is_named_by_its_key(tmp_path):
    box = {"order_id": 9, "length/mm": 1, "width/mm": 2, "height/mm": 3, "weight/kg": 4}
    (path := tmp_path / "a.json").write_text(json.dumps({"x": {"item_sequence": {"1": box}}}))
    assert [order.name for order in read_orders(path)] == ["x"]


def test_drawn_orders_are_made_of_the_lines_of_those_that_train(tmp_path):
    draw, orders = torch.Generator().manual_seed(0), []
    for number in range(40):
        counts = torch.randint(1, 5, (6,), generator=draw).tolist()
        # The side along x says how far to the end of the order a line stands, the height which order it is from.
        orders.append(
            [(10 * (6 - line), 50, 10 * (number + 1), 100) for line, count in enumerate(counts) for _ in range(count)]
        )
    items = Orders(write_csv(tmp_path / "a.csv", orders), 0.01)
    train = [[tuple(items.sizes[kind].tolist()) for kind in order] for order in items._orders["train"]]
    lines = {line for order in train for line in runs(order)}
    drawn = [[each[:3] for each in episode(items, "train", number)] for number in range(300)]
    others = {each[2] for stream in ("validation", "test") for order in items._orders[stream]
              for each in items.sizes[list(order)].tolist()}  # fmt: skip
    assert not others & {size[2] for order in drawn for size in order}
    assert {len(order) for order in drawn} <= {len(order) for order in train}
    found = [line for order in drawn for line in runs(order)]
    # The line with which an order becomes too long is cut, and two of one article may meet.
    assert sum(line not in lines for line in found) < 1.1 * len(drawn)
    assert len({each for order in drawn for each in order}) > 0.9 * len({each for order in train for each in order})
    early, late = ([order[at][0] for order in drawn] for at in (0, -1))
    assert sum(early) / len(early) > 4.5 and sum(late) / len(late) < 2.5  # in the order of the lines
    assert len({tuple(order) for order in drawn}) > 290
    # In any batch, and asked for in any order, an episode is the same.
    addresses = torch.tensor([[7, 3], [0, 2], [7, 0], [299, 1]])
    items = pickle.loads(pickle.dumps(items))  # as a worker gets it
    batch = items.sample("train", torch.zeros(4, dtype=torch.int64), *addresses.T, BIN)
    assert [tuple(row) for row in batch.table[:, 2:5].tolist()] == [drawn[e][s] for e, s in addresses.tolist()]


def test_true_volumes_are_reported(tmp_path):
    orders = [[(95 + n, 100, 41 + 50 * n, 100)] * 3 for n in range(3)]
    items = Orders(write_csv(tmp_path / "a.csv", orders), 0.05)
    assert items.sizes.tolist() == [[2, 2, 1], [2, 2, 2], [2, 2, 3]]

    def make_env(first, count):
        return PickPlaceEnv(items, num_envs=count, stream="test", first_episode=first, masks=())

    episodes = play(make_env, JointDBL(make_env(0, 1).cell), 1, 1)
    number = items._orders["test"][0][0]
    assert episodes.items_placed.tolist() == episodes.num_items.tolist() == [3]
    assert episodes.occupancy.tolist() == [12 * (number + 1) / 180]
    volume = 3 * math.prod(orders[number][0][:3])
    assert episodes.true_occupancy.tolist() == [pytest.approx(volume / (300 * 300 * 250))]
    with pytest.raises(ValueError, match=r"^evaluation.episodes=2: the items of evaluation.stream=test have 1 "):
        check_play({"episodes": 2, "batch_size": 1, "stream": "test"}, make_env(0, 1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id,w,d\n1,2,3\n", r"line 1: no column height and no weight in 'id,w,d'; expected columns length"),
        ("l,w,h,kg\n1,2,3,0\n", r"line 2: kg='0': expected a number above 0, at most 10,000\."),
        ("l,w,h,kg\n1,2,3,nan\n", r"line 2: kg='nan': expected a number above 0"),
        ("l,w,h,kg\n\n1,2,99999,4\n", r"line 3: h='99999': expected a number above 0, at most 10,000\."),
        ("l,w,h,kg\n1,2,3\n", r"line 2: got 3 fields, expected 4 as in the header\."),
        ("# boxes\nl,w,h,kg\n", r"line 2: got 4 fields, expected 1 as in the header; line 1 is taken for it\."),
        ("l,w,h,g\n1,2,3,0\n", r"line 2: g='0': expected a number above 0, at most 10,000,000\."),
        ("l,w,h,kg\n1,2,3,4,5\n", r"line 2: got 5 fields, expected 4 as in the header; decimals need a point\."),
        ("l,w,h,kg\n1\n", r"line 2: got 1 field, expected 4 as in the header\."),
        ('l,w,h,kg\n1,2,"3,5",4\n', r"line 2: h='3,5': expected a number with a decimal point above 0, at most 10,000"),
        ("l;w;h;kg\n1;2;3;4.000,5\n", r"line 2: kg='4.000,5': expected a number with"),
        ("l,w,h,kg,qty\n1,2,3,4,1.5\n", r"line 2: 1.5 pieces; expected a whole number\."),
        ("l,w,h,weight/mm\n1,2,3,4\n", r"line 1: the column 'weight/mm' is in mm; expected g or kg\."),
        ("l,w,h,kg,max_load\n1,2,3,4,-1\n", r"line 2: max_load='-1': expected a number from 0 to 1,000,000, or"),
        ("l,w,h,kg,max_load/g\n1,2,3,4,nan\n", r"line 2: max_load/g='nan': expected a number from 0 to 1,000,000,000"),
        ("l,w,h,kg,max_load/mm\n1,2,3,4,5\n", r"line 1: the column 'max_load/mm' is in mm; expected g or kg\."),
        ("l,w,h,kg,max_load,maximum load\n1,2,3,4,5,5\n", r"line 1: columns 'max_load' and 'maximum_load'; expected"),
        ("l,w,h,kg,stackable\n1,2,3,4,perhaps\n", r"line 2: stackable='perhaps': expected yes or no\."),
        ("l,w,h,kg,orientations\n1,2,3,4,lwh hwd\n", r"line 2: orientations='lwh hwd': expected any, upright"),
        ("l,w,h,kg,orientations\n1,2,3,4,hlw\n", r"line 2: orientations=hlw: expected lwh or wlh among them; with"),
        ("id,l,w,h,kg,stackable\na,1,2,3,4,yes\na,1,2,3,4,no\n",
         r"line 3: item 'a' is 1 x 2 x 3 mm, 4 kg, at most 0 kg on top, but 1 x 2 x 3 mm, 4 kg in .*, line 2"),
        ("l,l,h,kg\n1,2,3,4\n", r"line 1: two columns 'l'; expected one\."),
        ("l,length,w,h,kg\n1,1,2,3,4\n", r"line 1: columns 'length' and 'l'; expected one of them\."),
        ("length,width,depth,h,kg\n1,2,3,4,5\n", r"line 1: columns 'width' and 'depth'; expected one of them\."),
        ("l,w,h,weight,gross weight\n1,2,3,4,5\n", r"line 1: columns 'weight' and 'gross_weight'; expected one of"),
        ('id,l,w,h,kg\na,1,2,3,4\n\n"b,1,2,3,4\nc,1,2,3,4\n', r"a\.csv, line 4: unexpected end of data; expected"),
        ("l,w,h,kg\n1_00,2,3,4\n", r"line 2: l='1_00': expected a number above 0"),
        ("l;w;h;g\n1;2;3;1.200\n", r"line 2: g='1.200': expected a number without separators of thousands \(three dec"),
        ("sep=;\nl;w;h\n1;2;3\n", r"line 2: no column weight in 'l,w,h'; expected"),
        (f"order,l,w,h,kg\n{101 * 'a'},1,2,3,4\n", r"line 2: order='a.*': expected at most 100 characters\."),
        ("id,l,w,h,kg\na,1,2,3,4\na,1,2,3,5\n", r"line 3: item 'a' is 1 x 2 x 3 mm, 5 kg, but 1 x 2 x 3 mm, 4 kg in"),
        ("l,w,h,kg\n", r"no items, expected at least one\."),
        ("l,w,h,kg\n1,2,3,4\n", r"the file has 1 orders of different sizes; expected three at least"),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused_with_its_line(tmp_path, text, message):
    (path := tmp_path / "a.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        Orders(path, 0.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "it cannot be read"),
        ('{"a": {}, "a": {}}', "'a' stands twice in an object"),
        ("[]", r"got \[\]; expected {order: "),
        ('{"a": {}}', "order 'a' has no item_sequence with numbers as its keys"),
        ('{"a": {"item_sequence": {"1": 3}}}', "order 'a', item 1 is 3; expected"),
        ('{"a": {"item_sequence": {}}}', "order 'a' has no items; expected"),
        ('{"a": {"item_sequence": {"1": 3, "01": 3}}}', "order 'a' has two items with one number; expected"),
        ('{"a": {"item_sequence": {"7": {"length/mm": 3}}}}', "order a, item 7: no column width and no height"),
        (
            '{"a": {"item_sequence": {"1": {"length/mm": true, "width/mm": 1, "height/mm": 1, "weight/kg": 1}}}}',
            "order a, item 1: length/mm=True: expected a number above 0",
        ),
        ("{}", "no items"),
        (
            '{"a\\nb": {"item_sequence": {"1": {"length/mm": 1' + 400 * "0" + ', "width/mm": 1, "height/mm": 1, '
            '"weight/kg": 1}}}}',
            r"order a\?b, item 1: length/mm=",
        ),
    ],
)
def test_bad_json_is_refused_with_its_order(tmp_path, text, message):
    (path := tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_orders(path)


def test_an_item_that_fits_nowhere_is_named_with_its_line(tmp_path):
    path = write_csv(tmp_path / "a.csv", [[(100, 100, 50 * n, 1)] for n in range(1, 7)])
    with pytest.raises(ValueError, match=r"a.csv, line 7: item 2x2x6, 100 x 100 x 300 mm, is higher than the tote"):
        PickPlaceEnv(Orders(path, 0.05))
    with pytest.raises(ValueError, match="items.cell_size=null: expected the side of a cell in metres"):
        Orders(path, None)


@pytest.mark.parametrize(
    ("header", "sides"),
    [
        ("w,d,h", (1, 2, 3)), ("w,h,d", (1, 3, 2)), ("l,w,h", (1, 2, 3)), ("length,width,height", (1, 2, 3)),
        ("length,depth,height", (1, 2, 3)), ("width,depth,height", (1, 2, 3)), ("Width [mm],Length [mm],h", (2, 1, 3)),
        ('"Length\n(mm)",Width,Height', (1, 2, 3)),
    ],
)  # fmt: skip
def test_names_of_sides(tmp_path, header, sides):
    (path := tmp_path / "a.csv").write_text(f"\n{header},kg,,\n1,2,3,4,,\n")
    assert read_orders(path)[0].items[0][1:4] == sides


@pytest.mark.parametrize(
    ("header", "column"),
    [
        ("length/cm,width,height,weight", "width"), ("length,width,height (cm),weight", "length"),
        ("length/mm,width/cm,height,weight", "height"), ("l,w,h,g,max_load", "max_load"),
        ("l,w,h,weight,max_load/g", "weight"),
    ],
)  # fmt: skip
def test_units_that_are_given_in_part_are_refused(tmp_path, header, column):
    (path := tmp_path / "a.csv").write_text(f"{header}\n1,2,3,4{',5' * (header.count(',') - 3)}\n")
    with pytest.raises(ValueError, match=f"a.csv, line 1: the column '{column}' has no unit, but others have one; exp"):
        read_orders(path)


def test_units_that_are_given_in_part_and_are_the_usual_ones(tmp_path):
    (path := tmp_path / "a.csv").write_text("length/mm,width,h,kg,max_load\n1,2,3,4,5\n")
    ((item,),) = (order.items for order in read_orders(path))
    assert (item[1:5], item.max_load) == ((1, 2, 3, 4000), 5000)


def test_boxes_of_robobpp(tmp_path):
    """The columns of its repetitive boxes: centimetres, litres, kilograms."""
    header, time = "Length,Width,Height,Vol/CS,Gross weight,Case_pick_finish_time", '"2022/06/07, 00:24:37"'
    (path := tmp_path / "a.csv").write_text(f"{header}\n35,20.3,20.8,14.8,6.324,{time}\n")
    assert [tuple(item[1:5]) for item in read_orders(path, "cm")[0].items] == [(350.0, 203.0, 208.0, 6324)]


@pytest.mark.parametrize("kind", ["csv", "json"])
def test_orders_for_a_target_all_of_them_to_test_on(tmp_path, kind):
    """A file of three orders, two for the pallet."""
    path, goals = tmp_path / f"a.{kind}", ["pallet", "cage", "pallet"]
    orders = [[(10 * number, 20, 30, 400)] * number for number in (1, 2, 3)]
    if kind == "csv":
        rows = [(goal, number, *size) for number, (goal, order) in enumerate(zip(goals, orders, strict=True))
                for size in order]  # fmt: skip
        path.write_text("target,order,l,w,h,g\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    else:
        content = json.loads(write_bed_bpp(path, orders).read_text())
        for order, goal in zip(content.values(), goals, strict=True):
            order["properties"]["target"] = goal
        path.write_text(json.dumps(content))
    items = Orders(path, 0.01, target="pallet", split=False)
    assert items.num_episodes("test") == 2 and [len(episode(items, "test", number)) for number in (0, 1)] == [1, 3]
    assert episode(items, "test", 1) == [(3, 2, 3, 400)] * 3
    for stream in ("train", "validation"):
        with pytest.raises(ValueError, match=f"^items.split=false: all orders are to test on; .* some for {stream}.$"):
            episode(items, stream, 0)
    assert Orders(path, 0.01, split=False).num_episodes("test") == 3 == len(read_orders(path))
    with pytest.raises(ValueError, match=r": no items for target=van, but for \['pallet', 'cage'\], expected at"):
        read_orders(path, target="van")
    with pytest.raises(ValueError, match="^items.path=.* has 2 orders of different sizes; expected three at least"):
        Orders(path, 0.01, target="pallet")
    with pytest.raises(ValueError, match="^items.target=3: expected a name"):
        Orders(path, 0.01, target=3)


def test_quantities_and_semicolons(tmp_path):
    (path := tmp_path / "a.csv").write_text("id;w;d;h;kg;qty\na;35;20.3;20.8;1.5;2\nb;10;10;10;0.0004;1\n")
    (order,) = read_orders(path, "cm")
    assert Counter(item.id for item in order.items) == {"a": 2, "b": 1}
    assert order.items[0][1:5] == (350.0, 203.0, 208.0, 1500) and order.items[2].grams == 1


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_of_a_spreadsheet(tmp_path, separator):
    """With a byte order mark, as some programs write; a comma in a name stays."""
    lines = ["id;l/mm;w/mm;h/mm;kg;max_load;note, if any", "a,1;100,5;20;30.25;1,25;2,5;b, c"]
    (path := tmp_path / "a.csv").write_text("\n".join(lines).replace(";", separator), encoding="utf-8-sig")
    ((_, (item,)),) = read_orders(path)
    assert item[:5] == ("a,1", 100.5, 20.0, 30.25, 1250) and item.max_load == 2500


def test_separators_of_thousands_are_refused(tmp_path):
    """Where commas are decimals, 1,200 mm could be 1.2; 1,250 kg is 1.25."""
    (path := tmp_path / "a.csv").write_text("l;w;h;kg\n1,200;100;20;1,250\n")
    with pytest.raises(ValueError, match="line 2: l='1,200': expected a number without separators of thousands"):
        read_orders(path)
    path.write_text("l/m;w/m;h/m;kg\n1,200;1;2;1,250\n")
    assert read_orders(path)[0].items[0][1:5] == (1200, 1000, 2000, 1250)


LIMITS = [
    ("", "", "", "", NO_LIMIT, ORIENTATIONS), ("2.5", "", "", "any", 2500, ORIENTATIONS),
    ("0", "", "", "", 0, ORIENTATIONS),
    ("2.5", "no", "", "", 0, ORIENTATIONS), ("", "Yes", "no", "upright", NO_LIMIT, ("lwh", "wlh")),
    ("7", "", "TRUE", "fixed", 0, ("lwh",)), ("", "", "", "wlh", NO_LIMIT, ("wlh",)),
    ("0.0009", "1", "0", "hwl LWH", 0, ("lwh", "hwl")),
    ("", "y", "N ", "lhw,hlw, wlh,", NO_LIMIT, ("wlh", "lhw", "hlw")), ("", "1.0", "", " ", NO_LIMIT, ORIENTATIONS),
]  # fmt: skip


def test_limits_by_hand(tmp_path):
    """As CSV, and as JSON, where an answer may be a bool and nothing may be null."""
    columns = ["Max Load [kg]", "stackable", "nothing on top", "Orientations"]
    with (tmp_path / "a.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["l", "w", "h", "kg", *columns], *[(3, 2, 1, 1, *row[:4]) for row in LIMITS]])
    json_of = {"": None, "no": False, "Yes": True, "TRUE": True, "1.0": 1.0, "hwl LWH": ["hwl", "LWH"]}
    size = {"length/mm": 3, "width/mm": 2, "height/mm": 1, "weight/kg": 1}
    items = {
        str(number): {**size, **{key: json_of.get(value, value) for key, value in zip(columns, row, strict=False)}}
        for number, row in enumerate(LIMITS)
    }
    (tmp_path / "a.json").write_text(json.dumps({"one": {"item_sequence": items}}))
    for file in ("a.csv", "a.json"):
        (order,) = read_orders(tmp_path / file)
        assert [(item.max_load, item.orientations) for item in order.items] == [row[4:] for row in LIMITS]
    assert [item.turns for item in order.items] == [15, 15, 15, 15, 15, 5, 10, 5, 10, 15]


def test_limits_are_obeyed(tmp_path):
    """Pairs of a table that bears nothing and a cup: they lie side by side, and the table as it does in the bin."""
    lines = [f"{n},2{n},30,10,1,0,fixed\n{n},10,10,10,1,,\n" for n in range(4)]
    (path := tmp_path / "a.csv").write_text("order,l,w,h,kg,max_load,orientations\n" + "".join(lines))
    items = Orders(path, 0.01, split=False)
    assert sorted({*map(tuple, items.handling.tolist())}) == [(5, 1000, 0), (15, 1000, NO_LIMIT)]
    settings = {"bin_size": (3, 3, 1), "tote_size": (3, 4, 3), "stream": "test", "num_envs": 1}
    with pytest.raises(ValueError, match=r"env.handling=false: the items have greatest loads or turns of their own"):
        PickPlaceEnv(items, **settings)
    env = PickPlaceEnv(items, **settings, handling=True)
    seen = env.reset()
    assert env.cell.room == 2 and seen["handling"].tolist() == [[[5, 1000, 0]]]
    feasible = seen["action_mask"][0].nonzero()[:, 0]
    assert len(feasible) and not (feasible % 2).any()  # never turned by a quarter
    for failures in ({Failure.NONE}, {Failure.NONE, Failure.OVERLOADED}):
        state = env.state.repeat(env.cell.num_actions)
        found = apply(env.cell, state, torch.arange(env.cell.num_actions)).failure.unique().tolist()
        assert failures <= {*found} and (Failure.OVERLOADED in failures) == (Failure.OVERLOADED in found)
        action = seen["action_mask"].int().argmax(1)
        _, seen = env.step_and_maybe_reset(seen.set("action", action))
