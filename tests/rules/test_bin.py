"""Bins with several items: what is taken, what stands in the way, how items arrive; against plain Python."""

from dataclasses import replace
from itertools import product
from random import Random

import pytest
import torch
from oracle import cells, shape_cells
from problems import random_effector

from pickplace import CellSpec, Item, PickPlaceEnv
from pickplace.items.arrival import refill
from pickplace.items.distributions import Kinds, Recorded, Uniform, hashed_uniform
from pickplace.rules.bin import (
    add_item,
    admit_coming_items,
    blocked_picks,
    has_occupied_bins,
    may_arrive,
    remove_item,
    select_item,
    take_item,
    taken_item,
)
from pickplace.rules.gripper.base import reference_cell
from pickplace.rules.item import bin_depth_from_items, bin_labels_from_items
from pickplace.rules.masks import action_footprints, action_mask, choice_mask, placing_maps
from pickplace.rules.state import EMPTY, REFILLS, EpisodeSettings, State, surface_from
from pickplace.rules.step import apply, put_down


def random_contents(rng: Random, size, count, most=3):
    """Return up to ``count`` items ``(x, y, w, d, h)`` that do not overlap."""
    found, full = [], set()
    for _ in range(count):
        w, d, h = rng.randint(1, most), rng.randint(1, most), rng.randint(1, 3)
        w, d = min(w, size[0]), min(d, size[1])
        x, y = rng.randint(0, size[0] - w), rng.randint(0, size[1] - d)
        if full.isdisjoint(cells((x, y), (w, d))):
            full.update(cells((x, y), (w, d)))
            found.append((x, y, w, d, h))
    return found


def as_items(contents, count):
    """Return lists of items as a batch, ``[N, count]``."""
    rows = [[*bin_, *[(0,) * 5] * (count - len(bin_))] for bin_ in contents]
    return Item.from_table(torch.tensor(rows))


@pytest.mark.parametrize("seed", range(20))
def test_what_a_pick_takes_and_what_stands_in_its_way(seed):
    rng = Random(seed)
    bin_size, effector = (rng.randint(3, 7), rng.randint(3, 7), 1), (rng.randint(1, 4), rng.randint(1, 4))
    shape = random_effector(rng, effector) if seed % 2 else {}
    rule = rng.choice(["contain", "overlap", "seal"]) if shape else "contain"
    cell = CellSpec(bin_size=bin_size, effector_size=effector, pick_rule=rule, bin_items=4, **shape)
    contents = [random_contents(rng, bin_size, 4) for _ in range(8)]
    items = as_items(contents, 4)
    blocked = blocked_picks(cell, items).view(8, 4, *bin_size[:2])
    body = shape_cells(shape.get("body", "rectangle"), effector, effector)
    cup = [(x, y) for x in range(effector[0]) for y in range(effector[1]) if cell.gripper.cup_mask[x][y]]
    for n, x, y in product(range(8), range(bin_size[0]), range(bin_size[1])):
        corner = x - reference_cell(effector[0]), y - reference_cell(effector[1])
        below, held = ({(corner[0] + a, corner[1] + b) for a, b in part} for part in (body, cup))
        gripped = []
        for number, (i, j, w, d, h) in enumerate(contents[n]):
            under = set(cells((i, j), (w, d)))
            shared = len(under & held)
            enough = {"contain": under <= held, "overlap": shared > 0, "seal": shared >= cell.gripper.least_cells}[rule]
            gripped += [(-h, number)] * enough
            in_the_way = [
                other for k, other in enumerate(contents[n])
                if k != number and other[4] >= h and below & set(cells(other[:2], other[2:4]))
            ]  # fmt: skip
            assert blocked[n, number, x, y] == bool(in_the_way)
        at = torch.full((8,), x), torch.full((8,), y)
        assert taken_item(cell, items, *at)[n] == (min(gripped)[1] if gripped else 0)


def test_items_are_taken_out_and_the_others_move_up():
    items = as_items([[(0, 0, 1, 1, 1), (1, 0, 1, 1, 2), (2, 0, 1, 1, 3)]] * 4, 3)
    left = remove_item(
        CellSpec(bin_items=3), items, torch.tensor([0, 1, 2, 1]), torch.tensor([True, True, True, False])
    )
    assert left.h.tolist() == [[2, 3, 0], [1, 3, 0], [1, 2, 0], [1, 2, 3]] and left.w[:3, 2].tolist() == [0, 0, 0]
    assert select_item(items, torch.tensor([2, 0, 1, 1])).h.tolist() == [3, 1, 2, 2]


def arrivals_by_hand(source, stream, address, contents, cell, arrived):
    """Return what lies in one bin after the arrivals, and how many have arrived."""
    found, (bin_w, bin_d, _) = list(contents), cell.bin_size
    while len(found) < cell.bin_items and not (cell.refill == "batch" and contents):
        where = *address, torch.tensor([arrived])
        item = source.sample(stream, *where, cell.bin_size)
        own_x, own_y, w, d, h = item.cuboids[0].tolist()
        uniform = float(hashed_uniform(stream, *where, 4)[3])
        full = {part for other in found for part in cells(other[:2], other[2:4])}
        places = [
            (x, y) for x, y in product(range(bin_w - w + 1), range(bin_d - d + 1))
            if full.isdisjoint(cells((x, y), (w, d)))
        ]  # fmt: skip
        keeps_place = source.has_corners or not found
        if h == 0 or not places or (keeps_place and (own_x, own_y) not in places):
            break
        x, y = (own_x, own_y) if keeps_place else places[int(uniform * len(places))]
        found.append((x, y, w, d, h))
        arrived += 1
    return found, arrived


@pytest.mark.parametrize("rule", ["each", "batch"])
@pytest.mark.parametrize("kind", ["uniform", "recorded", "placed"])
def test_items_arrive_in_their_order_where_they_have_room(kind, rule, tmp_path):
    rng, count = Random(kind), 5
    path = tmp_path / "items.csv"
    rows = [random_contents(rng, (5, 6), 1)[0] for _ in range(9)]
    lines = [f"{w},{d},{h},{x},{y}" if kind == "placed" else f"{w},{d},{h}" for x, y, w, d, h in rows]
    path.write_text("\n".join(["w,d,h,x,y" if kind == "placed" else "w,d,h", *lines]))
    source = Uniform() if kind == "uniform" else Recorded(path)
    cell = CellSpec(bin_size=(5, 6, 1), bin_items=count, refill=rule)
    contents = [random_contents(rng, (5, 6), rng.choice((0, 0, 2, 4))) for _ in range(60)]
    seed, episode, rows = torch.full((60,), 3), torch.arange(60), torch.arange(60) % 7 > 0
    arrived = torch.tensor([rng.randint(0, 10) for _ in range(60)])
    bins = as_items(contents, count)
    items, after = refill(
        cell, source, "train", seed, episode, arrived, bins, may_arrive(cell, bins, EpisodeSettings()) & rows
    )
    for n in range(60):
        address = seed[:1], episode[n : n + 1]
        found, number = contents[n], arrived[n]
        if rows[n]:
            found, number = arrivals_by_hand(source, "train", address, contents[n], cell, int(arrived[n]))
        assert [tuple(row) for row in items.cuboids[n].tolist() if row[4]] == found and after[n] == number


@pytest.mark.parametrize("varies", [False, True])
@pytest.mark.parametrize("count", [1, 4])
def test_what_is_seen_enters_in_its_order_at_the_first_place(count, varies):
    """Against plain Python: the first in an empty bin at its own place; and whether an unseen one may follow."""
    rng, size = Random(count), (5, 6)
    contents = [random_contents(rng, size, rng.choice((0, 0, 1, 3)))[:count] for _ in range(80)]
    queues = [[random_contents(rng, size, 1)[0] for _ in range(rng.randint(0, 3))] for _ in range(80)]
    limits, rules = [rng.randint(1, count) for _ in range(80)], [rng.randrange(2) for _ in range(80)]
    episode = (
        EpisodeSettings(bin_items=torch.tensor(limits), refill=torch.tensor(rules)) if varies else EpisodeSettings()
    )
    cell, empty = CellSpec(bin_size=(*size, 1), bin_items=count), torch.full((80, 6, 6), EMPTY, dtype=torch.int32)
    tote_height, coming = torch.full((80,), 5), as_items(queues, 3)
    after, awaits = admit_coming_items(
        cell, State(empty, tote_height, as_items(contents, count), episode, coming=coming)
    )
    for n, (found, queue) in enumerate(zip(contents, queues, strict=True)):
        most, is_batch = (limits[n], REFILLS[rules[n]] == "batch") if varies else (count, False)
        closed = is_batch and bool(found)
        while queue and len(found) < most and not closed:
            x, y, w, d, h = queue[0]
            full = {part for other in found for part in cells(other[:2], other[2:4])}
            places = [
                place for place in product(range(size[0] - w + 1), range(size[1] - d + 1))
                if full.isdisjoint(cells(place, (w, d)))
            ]  # fmt: skip
            if not places:
                break
            found = [*found, (*(places[0] if found else (x, y)), w, d, h)]
            queue = queue[1:]
        assert [tuple(item) for item in after.items.cuboids[n].tolist() if item[4]] == found
        assert [tuple(item) for item in after.coming.cuboids[n].tolist() if item[4]] == queue
        assert awaits[n] == (len(found) < most and not closed and not queue)
    assert awaits.any() and not awaits.all()


def test_places_are_drawn_evenly():
    cell, count = CellSpec(bin_size=(3, 4, 1), bin_items=2), 30_000
    first = as_items([[(0, 0, 1, 2, 1)]] * count, 2)
    zeros = torch.zeros(count, dtype=torch.int64)
    items, _ = refill(cell, Kinds([(1, 2, 1)]), "train", zeros, torch.arange(count), zeros, first, zeros == 0)
    places = torch.bincount(items.x[:, 1] * 4 + items.y[:, 1])
    free = {(x, y) for x in range(3) for y in range(3)} - {(0, 0), (0, 1)}
    assert set(places.nonzero()[:, 0].tolist()) == {x * 4 + y for x, y in free}
    assert (places[places > 0] - count / len(free)).abs().max() < 5 * (count / len(free)) ** 0.5


def test_a_bin_that_is_jammed_begins_with_one_item():
    """Nine equal items between high walls: none can be gripped without a neighbour; so the first one comes alone."""
    sizes = {"bin_size": (3, 3, 3), "effector_size": (2, 2), "tote_size": (4, 4, 3), "bin_items": 9}
    env = PickPlaceEnv(Kinds([(1, 1, 1)]), num_envs=16, pick_rule="contain", **sizes)
    observation = env.reset()
    assert observation["action_mask"].any(1).all()
    assert ((observation["items"][..., 4] > 0).sum(1) == 1).all() and (env.arrived == 1).all()


def same(one, other):
    """Return whether two results are equal: tensors, None, or tuples of results."""
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


@pytest.mark.parametrize("support", ["half", "bearing"])
def test_a_bin_for_one_item_takes_a_shorter_path_to_the_same_result(support):
    """The general path: a bin for two items, of which the second place is empty."""
    count, draw = 200, torch.Generator().manual_seed(0)
    numbers = torch.arange(count)
    lone, two = (CellSpec(bin_size=(5, 4, 1), support=support, bin_items=places) for places in (1, 2))
    lone, two = (replace(cell, longest_side=3) for cell in (lone, two))
    sizes = Uniform((1, 3), (1, 3), (1, 2))
    item, other = (sizes.sample("train", torch.full_like(numbers, s), numbers, numbers, lone.bin_size) for s in (0, 1))
    there, rows = (torch.rand(2, count, generator=draw) < 0.8).unbind(0)
    items = item.map(lambda part: torch.where(there, part, 0)).rows((slice(None), None))
    assert items.x.shape == (count, 1) and 0 < there.sum() < count
    padded = Item.from_table(torch.cat([items.table, torch.zeros_like(items.table)], 1))
    first = (slice(None), slice(0, 1))
    surface = surface_from(torch.randint(0, 3, (count, *lone.tote_size[:2]), generator=draw))
    height = torch.full((count,), lone.tote_size[2])
    state, general = (State(surface, height, each) for each in (items, padded))
    action = torch.randint(0, lone.num_actions, (count,), generator=draw)
    zero = torch.zeros_like(action)

    assert blocked_picks(lone, items) is None and not blocked_picks(two, padded)[::2].any()
    assert same(take_item(lone, items, action)[:2], take_item(two, padded, action)[:2])
    assert same(taken_item(lone, items, zero, zero), taken_item(two, padded, zero, zero))
    assert same(select_item(items, zero), select_item(padded, zero))
    for removed in (None, rows):
        left = remove_item(lone, items, zero, removed)
        assert same(left, remove_item(two, padded, zero, removed).rows(first))
        assert same(left.table, torch.stack(left, -1))
    open_ = rows & ~there
    assert (
        not has_occupied_bins(items, open_)
        and not has_occupied_bins(padded, open_)
        and has_occupied_bins(padded, there)
    )
    assert same(add_item(items, other, open_), add_item(padded, other, open_).rows(first))
    for shown in (bin_depth_from_items, bin_labels_from_items):
        assert same(shown(items, lone.bin_size), shown(padded, lone.bin_size))
    at = 2 * numbers
    assert same(state.each_item()[2], general.each_item()[2].rows(at))
    maps, wide = placing_maps(lone, state), placing_maps(two, general)
    for one, both in zip(maps[:4], wide[:4], strict=True):
        assert same(one, both.rows(at) if isinstance(both, Item) else both[at])
    assert same(action_mask(lone, maps), action_mask(two, wide))
    mask, choices = choice_mask(lone, maps), choice_mask(two, wide)
    assert mask.any() and same(mask, choices[:, : lone.num_footprints]) and not choices[:, lone.num_footprints :].any()
    assert same(action_footprints(lone, items), action_footprints(two, padded))
    step, step_of_two = apply(lone, state, action), apply(two, general, action)
    assert same(tuple(step), tuple(step_of_two))
    good = mask.any(1)
    choice = mask[good].int().argmax(1)
    (after, placed), (after_two, placed_two) = (
        put_down(cell, each.rows(good), choice) for cell, each in ((lone, state), (two, general))
    )
    assert same(placed, placed_two) and same(after[:2], after_two[:2]) and not after_two.items.exists.any()
    assert same(after.items, after_two.items.rows(first))


def test_what_is_written_to_an_item_changes_no_other():
    sides = torch.ones(3, dtype=torch.int64)
    item = Item(sides, sides, sides, sides, sides)
    item.turns[0], item.grams[:] = 1, 500
    other = Item(sides, sides, sides, sides, sides)
    assert other.turns.tolist() == [15, 15, 15] and other.grams.tolist() == [0, 0, 0]
