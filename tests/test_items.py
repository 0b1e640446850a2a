"""Item distributions: who arrives, how often, and what is refused."""

import pytest
import torch

from pickplace import PickPlaceEnv
from pickplace.items import STREAMS, Kinds, Recorded, Uniform, hashed_uniform


def numbers(stream="train", seed=0, episode=0, count=50_000):
    steps = torch.arange(count)
    return hashed_uniform(stream, torch.tensor(seed), torch.full_like(steps, episode), steps, 3)


def test_hashed_numbers_are_uniform():
    for row in numbers():
        assert float(row.min()) >= 0 and float(row.max()) < 1
        count = torch.histc(row.float(), 100, 0, 1)
        chi2 = float(((count - 500) ** 2 / 500).sum())
        assert chi2 < 99 + 5 * (2 * 99) ** 0.5


def test_streams_seeds_episodes_and_numbers_are_unrelated():
    rows = [row for stream in STREAMS for row in numbers(stream, count=20_000)]
    rows += [*numbers(seed=1, count=20_000), *numbers(episode=1, count=20_000)]
    correlation = torch.corrcoef(torch.stack(rows))
    off_diagonal = correlation - torch.eye(len(rows))
    assert float(off_diagonal.abs().max()) < 5 / 20_000**0.5


def test_items_do_not_depend_on_the_batch():
    kinds = Kinds([(1, 1, 1), (2, 1, 3)])
    steps = torch.arange(40)
    together = kinds.sample("test", torch.tensor(7), steps // 8, steps % 8, (5, 5, 1))
    for i in range(40):
        alone = kinds.sample("test", torch.tensor(7), steps[i : i + 1] // 8, steps[i : i + 1] % 8, (5, 5, 1))
        assert [int(part) for part in alone] == [int(part[i]) for part in together]


def test_weights():
    kinds = Kinds([(1, 1, 1), (2, 1, 1), (1, 2, 1)], weights=[1, 0, 3])
    steps = torch.arange(40_000)
    item = kinds.sample("train", torch.tensor(0), torch.zeros_like(steps), steps, (5, 5, 1))
    assert not (item.w == 2).any()
    assert float((item.d == 2).double().mean()) == pytest.approx(0.75, abs=0.01)


def test_uniform_ranges():
    sizes = Uniform((1, 2), (3, 3), (2, 4)).sizes.tolist()
    assert sorted(sizes) == [[w, 3, h] for w in (1, 2) for h in (2, 3, 4)]


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Kinds(5), "items.kinds=5"),
        (lambda: Kinds([]), r"items.kinds=\[\]"),
        (lambda: Kinds([1, 2]), "items.kinds: got 1"),
        (lambda: Kinds([("a", 1, 1)]), "items.kinds: got"),
        (lambda: Kinds([(1, 1)]), "items.kinds: got"),
        (lambda: Kinds([(1, 0, 1)]), "items.kinds: got"),
        (lambda: Kinds([(1, 1.5, 1)]), "items.kinds: got"),
        (lambda: Kinds([(1, 1, 1)], weights=3), "items.weights=3"),
        (lambda: Kinds([(1, 1, 1)], weights="x"), "items.weights='x'"),
        (lambda: Kinds([(1, 1, 1)], weights=[1, 2]), "expected 1 numbers"),
        (lambda: Kinds([(1, 1, 1)], weights=[0]), "not all 0"),
        (lambda: Kinds([(1, 1, 1)], weights=[float("nan")]), "not all 0"),
        (lambda: Uniform(width=3), "items.width=3"),
        (lambda: Uniform(depth=(2, 1)), "items.depth"),
        (lambda: Uniform(height=(0, 1)), "items.height"),
    ],
)
def test_bad_arguments(make, key):
    with pytest.raises(ValueError, match=key):
        make()


def stream(tmp_path, text, **kwargs):
    path = tmp_path / "items.csv"
    path.write_text(text)
    return Recorded(path, **kwargs)


def test_recorded_stream_ends_the_episode(tmp_path):
    items = stream(tmp_path, "\ufeffw,d,h,x,y\n1,2,1,3,0\n2,1,1,0,4\n\n")
    env = PickPlaceEnv(items=items, num_envs=2)
    observation = env.reset()
    expected = torch.zeros(5, 5)
    expected[3, 0:2] = 1
    assert torch.equal(observation["bin_depth"], expected.expand(2, 5, 5))
    for number in (1, 2):
        action = observation["action_mask"].int().argmax(1)
        after, observation = env.step_and_maybe_reset(observation.set("action", action))
        after = after["next"]
        assert after["truncated"].all() == (number == 2)
        assert not after["terminated"].any() and not after["failure"].any()
        assert (after["reward"] == 2).all()
    assert not after["bin_depth"].any() and not after["action_mask"].any()
    assert torch.equal(observation["bin_depth"], expected.expand(2, 5, 5))  # the next episode starts at row 1


def test_recorded_stream_may_loop(tmp_path):
    items = stream(tmp_path, "w,d,h\n1,1,1\n2,1,1\n", loop=True)
    env = PickPlaceEnv(items=items, num_envs=1)
    observation, sides = env.reset(), []
    for _ in range(6):
        sides.append(int(env.current_item.w))
        action = observation["action_mask"].int().argmax(1)
        after, observation = env.step_and_maybe_reset(observation.set("action", action))
        assert not after["next", "done"].any()
    assert sides == [1, 2, 1, 2, 1, 2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the header is ''"),
        ("w,h,d\n1,1,1\n", "the header is 'w,h,d'"),
        ("w,d,h\n", "no items"),
        ("w,d,h\n1,1,1\n1,x,1\n", "line 3: got '1,x,1'"),
        ("w,d,h\n1,1\n", "line 2"),
        ("w,d,h\n1,1,1,1\n", "line 2"),
        ("w,d,h\n0,1,1\n", "line 2: got '0,1,1'"),
        ("w,d,h,x,y\n1,1,1,-1,0\n", "line 2"),
    ],
)
def test_bad_files(tmp_path, text, message):
    with pytest.raises(ValueError) as error:
        stream(tmp_path, text)
    assert message in str(error.value) and "items.csv" in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("w,d,h\n1,1,1\n6,1,1\n", "row 2: item 6x1x1 does not fit bin_size"),
        ("w,d,h\n4,1,1\n", "row 1: item 4x1x1 does not fit effector_size"),
        ("w,d,h\n1,1,6\n", "row 1: item 1x1x6 is higher than the tote"),
        ("w,d,h,x,y\n2,2,1,4,0\n", "row 1: item 2x2x1 at x=4, y=0 leaves the bin"),
    ],
)
def test_rows_that_do_not_fit(tmp_path, text, message):
    with pytest.raises(ValueError) as error:
        PickPlaceEnv(items=stream(tmp_path, text))
    assert message in str(error.value)


@pytest.mark.parametrize("seed", [-1, 2**70, 1.5, "a"])
def test_bad_seeds(seed):
    with pytest.raises(ValueError, match="seed=.*expected a whole number"):
        PickPlaceEnv(seed=seed)
