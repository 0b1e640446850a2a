"""Items cut from a full container: they tile it, come in the orders of CUT-1 and CUT-2, and can all be placed."""

import math
import pickle
from collections import Counter
from itertools import permutations, product
from random import Random

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.stats import chi2_contingency, chisquare

from pickplace import PickPlaceEnv
from pickplace.items import kept
from pickplace.items.cut import ORDERS, Cut
from pickplace.items.distributions import STREAMS, Kinds, search_items

BIN = (5, 5, 5)


def boxes_of(cut, count, first=0, stream="train", seed=0):
    """Return the boxes of episodes as lists of ``(x, y, z, w, d, h)``."""
    episode = torch.arange(first, first + count)
    return [
        [tuple(box) for box in each.tolist()] for each in cut.boxes(stream, torch.full_like(episode, seed), episode)
    ]


def sizes_of(cut, episode, count, stream="train", seed=0):
    """Return the first items of an episode as lists of ``(w, d, h)``, asked for one by one."""
    found = []
    for step in range(count):
        item = cut.sample(stream, torch.tensor([seed]), torch.tensor([episode]), torch.tensor([step]), BIN)
        found.append((int(item.w), int(item.d), int(item.h)))
    return found


def cells_of(x, y, z, w, d, h):
    return set(product(range(x, x + w), range(y, y + d), range(z, z + h)))


@st.composite
def cuts(draw):
    """Return settings of which no container is too large for the plain checks."""
    least = draw(st.integers(1, 3))
    greatest = draw(st.integers(least, least + 4))
    pieces = st.lists(st.integers(least, greatest), min_size=1, max_size=4)
    container = [sum(draw(pieces)) for _ in range(3)]
    assume(math.prod(side // least for side in container) <= 400)
    return {"container": container, "sides": [least, greatest], "order": draw(st.sampled_from(ORDERS))}


@settings(max_examples=60, deadline=None)
@given(cuts(), st.integers(0, 2**62 - 1), st.integers(0, 10**6), st.sampled_from(STREAMS))
def test_items_tile_the_container_in_an_order_in_which_they_can_be_stacked(given, seed, first, stream):
    cut = Cut(**given)
    sizes = set(map(tuple, cut.sizes.tolist()))
    assert len(sizes) == len(cut.sizes)
    for boxes in boxes_of(cut, 3, first, stream, seed):
        filled: set = set()
        for x, y, z, w, d, h in boxes:
            assert all(given["sides"][0] <= side <= given["sides"][1] for side in (w, d, h))
            assert (w, d, h) in sizes
            new = cells_of(x, y, z, w, d, h)
            assert not filled & new  # no overlap
            below = set() if z == 0 else cells_of(x, y, z - 1, w, d, 1)
            assert below <= filled  # all that it lies on has arrived
            filled |= new
        assert filled == cells_of(0, 0, 0, *given["container"])
        if given["order"] == "z":
            assert [box[2] for box in boxes] == sorted(box[2] for box in boxes)


@settings(max_examples=30, deadline=None)
@given(cuts(), st.integers(0, 10**6))
def test_the_stream_is_the_sizes_of_the_boxes_and_then_nothing(given, episode):
    cut = Cut(**given)
    (boxes,) = boxes_of(cut, 1, episode)
    expected = [box[3:] for box in boxes]
    assert sizes_of(cut, episode, len(boxes) + 2) == [*expected, (0, 0, 0), (0, 0, 0)]
    step = torch.arange(len(boxes) + 2)
    bin_size = (9, 8, 1)
    item = cut.sample("train", torch.tensor(0), torch.full_like(step, episode), step, bin_size)
    assert (item.x >= 0).all() and (item.x + item.w <= 9).all() and (item.y >= 0).all() and (item.y + item.d <= 8).all()
    assert torch.stack(item)[:, -2:].eq(0).all()
    nothing = torch.zeros(0, dtype=torch.int64)
    assert cut.sample("train", nothing, nothing, nothing, bin_size).w.tolist() == []


def test_the_paper_s_kinds():
    cut = Cut()
    assert sorted(map(tuple, cut.sizes.tolist())) == list(product(range(2, 6), repeat=3))
    arrived = {box[3:] for boxes in boxes_of(cut, 200) for box in boxes}
    assert arrived == set(map(tuple, cut.sizes.tolist()))
    assert cut.varies and not cut.has_corners
    imagined = search_items(cut)  # a search does not know the sequence
    assert isinstance(imagined, Kinds) and imagined.sizes.tolist() == cut.sizes.tolist()
    # 6 is not 5 and 1, 4 needs no cut, 9 is 4 and 5 only.
    assert {tuple(size) for size in Cut([6, 4, 3], [2, 5]).sizes.tolist()} == {(w, 4, 3) for w in (2, 3, 4)}
    assert sorted({size[0] for size in Cut([9, 4, 4], [4, 5]).sizes.tolist()}) == [4, 5]


def plain_cut(container, sides, rng):
    """Return the sizes of items: Algorithm 3 as its text reads, where a cut leaves parts that can be finished."""
    least, greatest = sides

    def can_be_finished(length):
        return length >= 0 and (
            length == 0 or any(can_be_finished(length - side) for side in range(least, greatest + 1))
        )

    invalid, valid = [tuple(container)], []
    while invalid:
        piece = invalid.pop(rng.randrange(len(invalid)))
        if all(side <= greatest for side in piece):
            valid.append(piece)
            continue
        axis = rng.choice([axis for axis in range(3) if piece[axis] > greatest])
        length = piece[axis]
        at = rng.choice([at for at in range(1, length) if can_be_finished(at) and can_be_finished(length - at)])
        invalid += [(*piece[:axis], part, *piece[axis + 1 :]) for part in (at, length - at)]
    return valid


@pytest.mark.parametrize(("container", "sides"), [((10, 10, 10), (2, 5)), ((10, 7, 4), (3, 4)), ((4, 5, 3), (1, 2))])
def test_cuts_are_as_frequent_as_in_plain_python(container, sides):
    rng, count = Random(5), 3000
    theirs = [plain_cut(container, sides, rng) for _ in range(count)]
    ours = [[box[3:] for box in boxes] for boxes in boxes_of(Cut(container, sides), count)]

    def compare(statistic):
        """Compare one number of each episode, so that the numbers are independent."""
        numbers = [Counter(map(statistic, episodes)) for episodes in (ours, theirs)]
        keys = [key for key in numbers[0] | numbers[1] if numbers[0][key] + numbers[1][key] >= 20]
        if len(keys) > 1:
            assert chi2_contingency([[number[key] for key in keys] for number in numbers]).pvalue > 1e-4

    compare(len)
    for axis in range(3):
        compare(lambda items, axis=axis: sum(size[axis] for size in items) * 10 // len(items))
        compare(lambda items, axis=axis: sum(size[axis] == sides[0] for size in items))


def test_cuts_of_a_length_of_four():
    """Into 1 and 3, 2 and 2, 3 and 1, equally likely; and the 3 into 1 and 2, or 2 and 1."""
    found = Counter(tuple(w for *_, w, _, _ in sorted(boxes)) for boxes in boxes_of(Cut([4, 1, 1], [1, 2]), 6000))
    expected = {(2, 2): 2000, (1, 2, 1): 2000, (1, 1, 2): 1000, (2, 1, 1): 1000}
    assert found.keys() == expected.keys()
    assert chisquare([found[key] for key in expected], [*expected.values()]).pvalue > 1e-4


def test_equal_heights_come_in_any_order():
    found = Counter(tuple(box[:2] for box in boxes) for boxes in boxes_of(Cut([2, 2, 1], [1, 1]), 9600))
    orders = list(permutations(product(range(2), repeat=2)))
    assert found.keys() == set(orders) and chisquare([found[order] for order in orders]).pvalue > 1e-4


def test_of_items_that_may_arrive_each_is_equally_likely():
    """Two columns of three cubes: each time the next cube of either column, with probability 1/2 if both have one."""
    count = 8000
    found = Counter(tuple(box[0] for box in boxes) for boxes in boxes_of(Cut([2, 1, 3], [1, 1], "stacking"), count))
    expected = {}
    for columns in set(permutations([0, 0, 0, 1, 1, 1])):
        free = sum(columns[:n].count(0) < 3 and columns[:n].count(1) < 3 for n in range(6))
        expected[columns] = count / 2**free
    assert found.keys() == expected.keys()
    assert chisquare([found[key] for key in expected], [*expected.values()]).pvalue > 1e-4


@pytest.mark.parametrize("order", ORDERS)
def test_an_item_is_a_function_of_its_address(order, monkeypatch):
    """It does not depend on the batch, on what was asked before, or on what is kept."""
    rng = Random(order)
    addresses = [(seed, episode, step) for seed in (0, 9) for episode in (0, 1, 7, 8) for step in range(30)]
    known = {}
    fresh = Cut(order=order)
    for address in addresses:
        item = fresh.sample("test", *(torch.tensor([part]) for part in address), BIN)
        known[address] = torch.stack(item)[:, 0].tolist()
    monkeypatch.setattr(kept, "MAX_CACHED_EPISODES", 3)
    cut = Cut(order=order)
    for _ in range(40):
        asked = rng.sample(addresses, rng.randint(1, 20))
        item = cut.sample("test", *map(torch.tensor, zip(*asked, strict=True)), BIN)
        assert torch.stack(item, 1).tolist() == [known[address] for address in asked]
        assert len(cut._kept._kept) <= max(3, 2 * len(asked))
        if rng.random() < 0.2:
            cut = pickle.loads(pickle.dumps(cut))  # as a worker gets it
    together = [len(boxes) for boxes in boxes_of(fresh, 20, stream="test")]
    assert together == [len(boxes_of(fresh, 1, number, "test")[0]) for number in range(20)]


def test_streams_seeds_and_episodes_differ_and_stay_as_they_are():
    """The sizes must not change: published results and checkpoints rest on them."""
    cut = Cut()
    episodes = [
        tuple(map(tuple, boxes))
        for stream in STREAMS
        for seed in (0, 1)
        for boxes in boxes_of(cut, 50, 0, stream, seed)
    ]
    assert len(set(episodes)) == 300
    first = {(order, stream): sizes_of(Cut(order=order), 0, 3, stream) for order in ORDERS for stream in STREAMS}
    assert first == FIRST


FIRST = {
    ("z", "train"): [(2, 4, 4), (2, 5, 4), (2, 3, 4)],
    ("z", "validation"): [(5, 5, 2), (5, 4, 3), (5, 2, 4)],
    ("z", "test"): [(4, 4, 5), (4, 2, 5), (4, 2, 5)],
    ("stacking", "train"): [(2, 4, 4), (2, 5, 4), (2, 5, 2)],
    ("stacking", "validation"): [(5, 5, 2), (5, 4, 3), (5, 2, 4)],
    ("stacking", "test"): [(4, 4, 5), (4, 2, 5), (4, 2, 5)],
}


@pytest.mark.parametrize("order", ORDERS)
def test_a_perfect_packing_is_feasible_in_the_benchmark_s_environment(order):
    """Each item goes where it was cut, in the environment itself; the rule of stability is never in the way."""
    cut, count = Cut(order=order), 40
    cell = {
        "bin_size": BIN, "tote_size": (10, 10, 10), "effector_size": (1, 1), "pick_rule": "overlap", "rotations": 1,
        "support": "corners",
    }  # fmt: skip
    env = PickPlaceEnv(items=cut, num_envs=count, stream="test", masks=("footprint",), **cell)
    boxes = boxes_of(cut, count, stream="test")
    observation, done = env.reset(), torch.zeros(count, dtype=torch.bool)
    for step in range(max(map(len, boxes))):
        here = torch.tensor([each[min(step, len(each) - 1)] for each in boxes])
        item = env.state.items.rows((slice(None), 0))
        playing = ~done
        assert torch.equal(item.cuboids[playing, 2:], here[playing, 3:])
        # The effector's only cell is on the item's first one, and goes to where that one belongs.
        pick = item.x * BIN[1] + item.y
        action = (pick * 10 + here[:, 0]) * 10 + here[:, 1]
        after = env.step(observation.set("action", action))["next"]
        last = torch.tensor([step == len(each) - 1 for each in boxes])
        assert (after["failure"][playing] == 0).all() and not after["terminated"][playing].any()
        assert torch.equal(after["truncated"][playing, 0], last[playing])
        assert (env.exact_occupancy[last & playing] == 1).all()
        done |= last
        observation = after
    assert done.all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"order": "x"}, "items.order='x': expected 'z' or 'stacking'"),
        ({"container": 10}, "items.container=10: expected 3 whole numbers >= 1 and <= 200"),
        ({"container": [10, 10]}, r"items.container=\[10, 10\]: expected 3 whole numbers"),
        ({"container": [10, 0, 10]}, "items.container=.*expected 3 whole numbers"),
        ({"container": [10, 201, 10]}, "items.container=.*expected 3 whole numbers"),
        ({"sides": 3}, r"items.sides=3: expected \[least, greatest\]"),
        ({"sides": [0, 2]}, r"items.sides=\[0, 2\]: expected \[least, greatest\]"),
        ({"sides": [5, 2]}, r"items.sides=\[5, 2\]: expected \[least, greatest\]"),
        ({"sides": [2, 2.5]}, "items.sides="),
        (
            {"sides": [6, 9]},
            r"items.container=\[10, 10, 10\], items.sides=\[6, 9\]: sides of 6 to 9 do not add up to 10",
        ),
        ({"container": [8, 8, 6], "sides": [4, 6]}, None),
        ({"container": [8, 8, 3], "sides": [4, 6]}, "do not add up to 3; expected some that do"),
        ({"sides": [11, 12]}, "do not add up to 10"),
        ({"container": [30, 30, 30]}, "an episode has up to 3,375 items; expected at most 1,000"),
        (
            {"container": [200, 200, 200], "sides": [20, 100]},
            "the container gives 531,441 kinds of items; expected at most",
        ),
        ({"container": [200, 20, 20], "sides": [20, 100]}, None),
    ],
)
def test_bad_settings_are_refused(given, message):
    if message is None:
        assert Cut(**given).sizes.numel()
        return
    with pytest.raises(ValueError, match=message) as caught:
        Cut(**given)
    assert "\n" not in str(caught.value)
