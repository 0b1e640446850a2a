"""Item distributions: which items arrive, how often, and what is refused."""

import pytest
import torch
from scipy.stats import chisquare

from pickplace import PickPlaceEnv
from pickplace.items import distributions as module
from pickplace.items.distributions import STREAMS, Kinds, Recorded, Uniform, hashed_uniform

ZERO = torch.tensor(0)


def numbers(stream="train", seed=0, episode=0, count=50_000):
    steps = torch.arange(count)
    return hashed_uniform(stream, torch.tensor(seed), torch.full_like(steps, episode), steps, 3)


def drawn(items, count, bin_size=(5, 5, 1)):
    """Return the first items of an episode."""
    steps = torch.arange(count)
    return items.sample("train", ZERO, torch.zeros_like(steps), steps, bin_size)


def is_even(index, count, expected=None):
    return chisquare(torch.bincount(index, minlength=count), expected).pvalue > 1e-4


def test_hashed_numbers_are_uniform_and_unrelated():
    episodes = torch.arange(50_000)
    none = torch.zeros_like(episodes)
    by_episode = hashed_uniform("test", torch.tensor(2**63 - 1), episodes, none, 3)
    by_seed = hashed_uniform("validation", episodes, none, none, 3)
    for row in (*numbers(), *by_episode, *by_seed):
        assert float(row.min()) >= 0 and float(row.max()) < 1
        assert is_even((row * 100).long(), 100)
        assert is_even((row[:-1] * 10).long() * 10 + (row[1:] * 10).long(), 100)  # pairs: one number tells no other
    rows = [row for stream in STREAMS for row in numbers(stream, count=20_000)]
    rows += [*numbers(seed=1, count=20_000), *numbers(episode=1, count=20_000)]
    correlation = torch.corrcoef(torch.stack(rows))
    assert float((correlation - torch.eye(len(rows))).abs().max()) < 5 / 20_000**0.5
    # Families, seeds, episodes and steps: 10,000 addresses, 10,000 different numbers.
    seed, episode, step = (part.flatten() for part in torch.meshgrid(*[torch.arange(15)] * 3, indexing="ij"))
    rows = torch.cat([hashed_uniform(stream, seed, episode, step, 1)[0] for stream in STREAMS])
    assert len(rows.unique()) == len(rows) == 3 * 15**3


@pytest.mark.parametrize("apart", [1, 2])
def test_families_never_meet(apart):
    """Keys are equal where ``seed * factor + family`` is: their numbers show it, for seeds that are too far apart."""
    seed = apart * pow(0x2545F4914F6CDD1D, -1, 2**64) % 2**64  # times the factor it is the difference of two families
    seed = min(seed, 2**64 - seed)
    there, here = (
        [hashed_uniform(stream, at, ZERO, ZERO, 3).tolist() for stream in STREAMS] for at in (torch.tensor(seed), ZERO)
    )
    assert any(there[i + apart] == here[i] or there[i] == here[i + apart] for i in range(3 - apart))
    assert seed >= module.MAX_SEED


def test_an_item_is_a_hash_of_its_address():
    """These numbers must not change: published results and checkpoints rest on them."""
    address = torch.tensor([0, 1, 7]), torch.tensor([0, 5, 123]), torch.tensor([0, 2, 40])
    expected = {
        "train": [[3, 2, 2, 2, 1], [3, 1, 2, 1, 1], [1, 4, 2, 1, 1]],
        "validation": [[0, 0, 1, 2, 1], [1, 4, 1, 1, 1], [3, 3, 2, 2, 1]],
        "test": [[3, 2, 2, 2, 1], [4, 1, 1, 2, 1], [4, 2, 1, 1, 1]],
    }
    for stream in STREAMS:
        for batch in (slice(0, 3), slice(1, 2)):
            item = Kinds(module.PAPER_KINDS).sample(stream, *(part[batch] for part in address), (5, 5, 1))
            assert item.cuboids.tolist() == expected[stream][batch]


def test_positions_are_uniform_and_independent_of_the_kind():
    item = drawn(Kinds([(1, 1, 1), (2, 2, 1)]), 40_000, (4, 3, 1))
    for side, (wide, deep) in ((1, (4, 3)), (2, (3, 2))):
        corner = (item.x * deep + item.y)[item.w == side]
        assert is_even(corner, wide * deep) and len(corner.unique()) == wide * deep


def test_a_systematic_sample_has_each_kind_in_proportion_to_its_weight():
    items, seed = Kinds([(1, 1, 1), (2, 1, 1), (2, 2, 1)], [1, 2, 1]), torch.arange(50)
    for count, least, greatest in ((8, (2, 4, 2), (2, 4, 2)), (6, (1, 3, 1), (2, 3, 2)), (2, (0, 1, 0), (1, 1, 1))):
        drawn = [items.spread(seed, torch.full_like(seed, rank), count, (5, 5)) for rank in range(count)]
        volume = torch.stack([item.volume for item in drawn])
        assert all((item.x + item.w).max() <= 5 and item.x.min() >= 0 for item in drawn)
        for kind, (low, high) in enumerate(zip(least, greatest, strict=True)):
            times = (volume == 2**kind).sum(0)
            assert times.min() == low and times.max() == high
    assert drawn[0].x.unique().numel() > 2  # at random places


def test_weights_and_ranges():
    kinds = Kinds([(1, 1, 1), (2, 1, 1), (1, 2, 1)], weights=[1, 0, 3])
    item = drawn(kinds, 40_000)
    assert not (item.w == 2).any() and is_even(item.d - 1, 2, [10_000, 30_000])
    assert kinds.sizes.tolist() == [[1, 1, 1], [1, 2, 1]]  # what may arrive: a weight of 0 is not checked for a fit
    items = Uniform((1, 2), (3, 3), (2, 4))
    assert sorted(items.sizes.tolist()) == [[w, 3, h] for w in (1, 2) for h in (2, 3, 4)]
    assert torch.equal(Uniform((1, 2), (3, 3), (2, 4), unit=5).sizes, 5 * items.sizes)
    item = drawn(items, 30_000)
    assert is_even((item.w - 1) * 3 + item.h - 2, 6)
    two = torch.ones(1).int().numpy()[0] + 1  # an integer of numpy's
    assert Kinds([(two, two, 1)]).sizes.tolist() == [[2, 2, 1]] and len(Uniform((1, two), (two, two)).sizes) == 6


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Kinds(5), "items.kinds=5"),
        (lambda: Kinds([]), r"items.kinds=\[\]"),
        (lambda: Kinds([1, 2]), "items.kinds: got 1"),
        (lambda: Kinds([("a", 1, 1)]), "items.kinds: got .'a', 1, 1., expected .w, d, h. in positive whole cells"),
        *(
            (lambda kind=kind: Kinds([kind]), "items.kinds: got")
            for kind in ((True, 1, 1), (10**30, 1, 1), (1, 1), (1, 0, 1), (1, 1.5, 1))
        ),
        (lambda: Kinds([(1, 1, 1)], weights=3), "items.weights=3"),
        (lambda: Kinds([(1, 1, 1)], weights="x"), "items.weights='x'"),
        (lambda: Kinds([(1, 1, 1)], weights=[1, 2]), "expected 1 numbers"),
        *(
            (lambda weights=weights: Kinds([(1, 1, 1)] * len(weights), weights), "items.weights=.*expected finite")
            for weights in ([0], [1, -1], [float("nan")], ["x"], [1e308, 1e308])
        ),
        (lambda: Uniform(width=3), r"items.width=3: expected \[least, greatest\]"),
        *(
            (lambda limits=limits: Uniform(depth=limits), "items.depth")
            for limits in ((1, "2"), (1.0, 2.5), (1, 2, 3), (2, 1), (0, 1))
        ),
        (lambda: Uniform((1, 100), (1, 100), (1, 100)), "items.width=.* the ranges have 1,000,000 kinds"),
        *(
            (lambda unit=unit: Uniform(unit=unit), "items.unit=.*: expected a whole number >= 1")
            for unit in (0, 1.5, "a", True)
        ),
        (lambda: Recorded("missing.csv"), "items.path='missing.csv': no such file"),
        (lambda: Recorded(5), "items.path='5': no such file"),
        (lambda: Recorded("missing.csv", loop="maybe"), "items.loop='maybe': expected true or false"),
        *(
            (lambda seed=seed: module.check_seed(seed, "planner.seed"), "planner.seed=.*expected a whole number >= 0")
            for seed in (-1, 2**62, 2**70, 1.5, "a", True)
        ),
    ],
)
def test_bad_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.fixture
def recorded(tmp_path):
    """Make the distribution of a recorded file, given as its text."""

    def make(text, **settings):
        path = tmp_path / "items.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return Recorded(path, **settings)

    return make


def test_a_recorded_stream_ends_each_episode_at_its_own_time(recorded):
    """A failed action restarts an episode at row 1, so slots are at different rows; each is truncated at its end."""
    env = PickPlaceEnv(items=recorded("\ufeffw,d,h,x,y\n1,2,1,3,0\n2,1,1,0,4\n1,2,1,3,0\n\n"), num_envs=2)
    observation, rows = env.reset(), [0, 0]
    for number in range(1, 6):
        assert env.item[:, 0, :5].tolist() == [[[3, 0, 1, 2, 1], [0, 4, 2, 1, 1], [3, 0, 1, 2, 1]][row] for row in rows]
        action = observation["action_mask"].int().argmax(1)
        if number == 2:  # slot 1 fails
            action[1] = observation["action_mask"][1].int().argmin()
        after, observation = env.step_and_maybe_reset(observation.set("action", action))
        truncated, terminated = [number == 3, number == 5], [False, number == 2]
        assert after["next", "truncated"][:, 0].tolist() == truncated
        assert after["next", "terminated"][:, 0].tolist() == terminated
        done = [a or b for a, b in zip(truncated, terminated, strict=True)]
        assert after["next", "done"][:, 0].tolist() == done
        assert not after["next", "bin_depth"][truncated].any() and not after["next", "action_mask"][truncated].any()
        rows = [0 if ends else row + 1 for row, ends in zip(rows, done, strict=True)]


def test_a_recorded_stream_may_loop_and_a_search_knows_its_sizes_only(recorded):
    items = recorded("w,d,h\n1,1,1\n2,1,1\n", loop=True)
    assert drawn(items, 6).w.tolist() == [1, 2, 1, 2, 1, 2]
    imagined = module.search_items(recorded("w,d,h,x,y\n1,1,1,0,0\n2,1,1,0,0\n"))
    assert isinstance(imagined, Kinds) and imagined.sizes.tolist() == items.sizes.tolist()
    # Positions are random unless given.
    item = drawn(recorded("w,d,h\n2,1,1\n", loop=True), 20_000)
    assert is_even(item.x * 5 + item.y, 20)
    item = drawn(recorded("w,d,h,x,y\n2,1,1,3,4\n", loop=True), 20_000)
    assert (item.x == 3).all() and (item.y == 4).all()


@pytest.mark.parametrize(
    "text",
    [
        "w,d,h\n1,2,1\n2,1,3",
        "w,d,h\r\n1,2,1\r\n2,1,3\r\n\r\n",
        " w, d ,h\n1, 2 ,1\n\n  \n2,1,3\n,,\n",
        '"w","d","h"\n"1","2","1"\n"2","1","3"',
    ],
)
def test_ways_to_write_the_same_file(recorded, text):
    assert recorded(text).sizes.tolist() == [[1, 2, 1], [2, 1, 3]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 bytes; expected a file with content"),
        ("w,h,d\n1,1,1\n", "the header is 'w,h,d'"),
        ("W;D;H\n1;1;1\n", "the header is 'W;D;H', expected 'w,d,h' or 'w,d,h,x,y'"),
        ("w,d,h,x\n1,1,1,1\n", "the header is 'w,d,h,x'"),
        ("1,1,1\n", "the header is '1,1,1'"),
        ("w,d,h\n", "no rows"),
        (b"w,d,h\n1,1,\xff\n", "line 2: got the byte 0xff; expected a text in UTF-8"),
        ("w,d,h\n1,1,1\n1,x,1\n", "line 3: got '1,x,1'"),
        ("w,d,h\n1,1\n", "line 2: got '1,1', expected w,d,h as whole numbers"),
        ("w,d,h\n1,1,1\n\n1,1,1.5\n", "line 4: got '1,1,1.5'"),
        *(
            (f"w,d,h\n{row}\n", f"line 2: got '{row}'")
            for row in ("0,1,1", "1_0,1,1", "1,1,1,1", "1,1,99999999999999999999")
        ),
        ("w,d,h,x,y\n1,1,1\n", "line 2: got '1,1,1', expected w,d,h,x,y"),
        ("w,d,h,x,y\n1,1,1,-1,0\n", "line 2"),
        # Rows that do not fit the cell.
        ("w,d,h\n1,1,1\n\n6,1,1\n", "line 4: item 6x1x1 does not fit bin_size"),
        ("w,d,h\n4,1,1\n", "line 2: item 4x1x1 does not fit gripper.size"),
        ("w,d,h\n1,1,6\n", "line 2: item 1x1x6 is higher than the tote"),
        ("w,d,h,x,y\n1,1,1,0,0\n2,2,1,4,0\n", "line 3: item 2x2x1 at x=4, y=0 leaves the bin"),
    ],
)
def test_bad_files_are_refused(recorded, text, message):
    with pytest.raises(ValueError) as error:
        PickPlaceEnv(items=recorded(text))
    assert message in str(error.value) and "items.csv" in str(error.value)
