"""Item distributions: who arrives, how often, and what is refused."""

import pytest
import torch
from scipy.stats import chisquare
from tensordict import TensorDict

from pickplace import PickPlaceEnv
from pickplace.task.items import MOST_SEEDS, STREAMS, Kinds, Recorded, Uniform, hashed_uniform
from pickplace.training import trainer
from pickplace.training.ppo import make_losses


def numbers(stream="train", seed=0, episode=0, count=50_000):
    steps = torch.arange(count)
    return hashed_uniform(stream, torch.tensor(seed), torch.full_like(steps, episode), steps, 3)


def test_hashed_numbers_are_uniform():
    by_step = numbers()
    episodes = torch.arange(50_000)
    by_episode = hashed_uniform("test", torch.tensor(2**63 - 1), episodes, torch.zeros_like(episodes), 3)
    by_seed = hashed_uniform("validation", episodes, torch.zeros_like(episodes), torch.zeros_like(episodes), 3)
    for row in (*by_step, *by_episode, *by_seed):
        assert float(row.min()) >= 0 and float(row.max()) < 1
        assert chisquare(torch.bincount((row * 100).long(), minlength=100)).pvalue > 1e-4
        pairs = (row[:-1] * 10).long() * 10 + (row[1:] * 10).long()  # one number says nothing about the next
        assert chisquare(torch.bincount(pairs, minlength=100)).pvalue > 1e-4


def test_streams_seeds_episodes_and_numbers_are_unrelated():
    rows = [row for stream in STREAMS for row in numbers(stream, count=20_000)]
    rows += [*numbers(seed=1, count=20_000), *numbers(episode=1, count=20_000)]
    correlation = torch.corrcoef(torch.stack(rows))
    off_diagonal = correlation - torch.eye(len(rows))
    assert float(off_diagonal.abs().max()) < 5 / 20_000**0.5


def test_no_two_addresses_share_a_number():
    """Families, seeds, episodes and steps: 10,000 addresses, 10,000 different numbers."""
    seed, episode, step = (part.flatten() for part in torch.meshgrid(*[torch.arange(15)] * 3, indexing="ij"))
    rows = torch.cat([hashed_uniform(stream, seed, episode, step, 1)[0] for stream in STREAMS])
    assert len(rows.unique()) == len(rows) == 3 * 15**3


def test_families_never_meet():
    """Two keys are one where ``seed * factor + family`` is: as its numbers show, for seeds too far apart."""
    factor = 0x2545F4914F6CDD1D
    for apart in (1, 2):
        seed = apart * pow(factor, -1, 2**64) % 2**64  # times the factor it makes up for the family's number
        seed = min(seed, 2**64 - seed)
        at = torch.tensor(seed)
        rows = {stream: hashed_uniform(stream, at, at * 0, at * 0, 3).tolist() for stream in STREAMS}
        base = {stream: hashed_uniform(stream, at * 0, at * 0, at * 0, 3).tolist() for stream in STREAMS}
        pairs = zip(STREAMS[apart:], STREAMS, strict=False)
        assert any(rows[a] == base[b] or rows[b] == base[a] for a, b in pairs)
        assert seed >= MOST_SEEDS


def test_items_do_not_depend_on_the_batch():
    kinds = Kinds([(1, 1, 1), (2, 1, 3)])
    steps = torch.arange(40)
    together = kinds.sample("test", torch.tensor(7), steps // 8, steps % 8, (5, 5, 1))
    for i in range(40):
        alone = kinds.sample("test", torch.tensor(7), steps[i : i + 1] // 8, steps[i : i + 1] % 8, (5, 5, 1))
        assert [int(part) for part in alone] == [int(part[i]) for part in together]


def test_positions_are_uniform_and_independent_of_the_kind():
    kinds = Kinds([(1, 1, 1), (2, 2, 1)])
    steps = torch.arange(40_000)
    item = kinds.sample("train", torch.tensor(0), torch.zeros_like(steps), steps, (4, 3, 1))
    for side, rooms in ((1, (4, 3)), (2, (3, 2))):
        of_kind = item.w == side
        cell = (item.x * rooms[1] + item.y)[of_kind]
        assert chisquare(torch.bincount(cell, minlength=rooms[0] * rooms[1])).pvalue > 1e-4
        assert len(cell.unique()) == rooms[0] * rooms[1]


def test_weights():
    kinds = Kinds([(1, 1, 1), (2, 1, 1), (1, 2, 1)], weights=[1, 0, 3])
    steps = torch.arange(40_000)
    item = kinds.sample("train", torch.tensor(0), torch.zeros_like(steps), steps, (5, 5, 1))
    assert not (item.w == 2).any()
    assert chisquare(torch.bincount(item.d)[1:], [10_000, 30_000]).pvalue > 1e-4
    assert kinds.sizes.tolist() == [[1, 1, 1], [1, 2, 1]]  # what may arrive: a weight of 0 is not checked for a fit


def test_uniform_ranges():
    items = Uniform((1, 2), (3, 3), (2, 4))
    assert sorted(items.sizes.tolist()) == [[w, 3, h] for w in (1, 2) for h in (2, 3, 4)]
    steps = torch.arange(30_000)
    item = items.sample("train", torch.tensor(0), torch.zeros_like(steps), steps, (5, 5, 1))
    assert chisquare(torch.bincount((item.w - 1) * 3 + item.h - 2)).pvalue > 1e-4


def test_lengths_of_numpy_are_lengths():
    two = torch.ones(1).int().numpy()[0] + 1
    assert Kinds([(two, two, 1)]).sizes.tolist() == [[2, 2, 1]]
    assert len(Uniform((1, two), (two, two)).sizes) == 2 * 1 * 3


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Kinds(5), "items.kinds=5"),
        (lambda: Kinds([]), r"items.kinds=\[\]"),
        (lambda: Kinds([1, 2]), "items.kinds: got 1"),
        (lambda: Kinds([("a", 1, 1)]), "items.kinds: got .'a', 1, 1., expected .w, d, h. in positive whole cells"),
        (lambda: Kinds([(True, 1, 1)]), "items.kinds: got"),
        (lambda: Kinds([(10**30, 1, 1)]), "items.kinds: got"),
        (lambda: Kinds([(1, 1)]), "items.kinds: got"),
        (lambda: Kinds([(1, 0, 1)]), "items.kinds: got"),
        (lambda: Kinds([(1, 1.5, 1)]), "items.kinds: got"),
        (lambda: Kinds([(1, 1, 1)], weights=3), "items.weights=3"),
        (lambda: Kinds([(1, 1, 1)], weights="x"), "items.weights='x'"),
        (lambda: Kinds([(1, 1, 1)], weights=[1, 2]), "expected 1 numbers"),
        (lambda: Kinds([(1, 1, 1)], weights=[0]), "not all 0"),
        (lambda: Kinds([(1, 1, 1)], weights=[float("nan")]), "not all 0"),
        (lambda: Kinds([(1, 1, 1)], weights=["x"]), "items.weights=.*expected finite numbers"),
        (lambda: Kinds([(1, 1, 1)] * 2, weights=[1e308, 1e308]), "items.weights=.*expected finite numbers"),
        (lambda: Uniform(width=3), r"items.width=3: expected \[least, greatest\]"),
        (lambda: Uniform(width=(1, "2")), "items.width"),
        (lambda: Uniform(width=(1.0, 2.5)), "items.width"),
        (lambda: Uniform(width=(1, 2, 3)), "items.width"),
        (lambda: Uniform(depth=(2, 1)), "items.depth"),
        (lambda: Uniform(height=(0, 1)), "items.height"),
        (lambda: Recorded("missing.csv"), "items.path='missing.csv': no such file"),
        (lambda: Recorded(5), "items.path='5': no such file"),
        (lambda: Recorded("missing.csv", loop="maybe"), "items.loop='maybe': expected true or false"),
    ],
)
def test_bad_arguments(make, key):
    with pytest.raises(ValueError, match=key):
        make()


def stream(tmp_path, text, **kwargs):
    path = tmp_path / "items.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
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


@pytest.mark.parametrize(
    "text",
    [
        "w,d,h\n1,2,1\n2,1,3",
        "w,d,h\r\n1,2,1\r\n2,1,3\r\n\r\n",
        " w, d ,h\n1, 2 ,1\n\n  \n2,1,3\n,,\n",
        '"w","d","h"\n"1","2","1"\n"2","1","3"',
    ],
)
def test_ways_to_write_the_same_file(tmp_path, text):
    assert stream(tmp_path, text).sizes.tolist() == [[1, 2, 1], [2, 1, 3]]


def test_recorded_positions_are_random_unless_given(tmp_path):
    items = stream(tmp_path, "w,d,h\n2,1,1\n")
    episodes = torch.arange(20_000)
    item = items.sample("train", torch.tensor(0), episodes, torch.zeros_like(episodes), (5, 5, 1))
    assert chisquare(torch.bincount(item.x * 5 + item.y, minlength=20)).pvalue > 1e-4
    items = stream(tmp_path, "w,d,h,x,y\n2,1,1,3,4\n")
    item = items.sample("train", torch.tensor(0), episodes, torch.zeros_like(episodes), (5, 5, 1))
    assert (item.x == 3).all() and (item.y == 4).all()


def test_a_recorded_stream_that_ends_while_others_play_on(tmp_path):
    """A failed action restarts an episode, so slots are at different rows; each is truncated at its own end."""
    items = stream(tmp_path, "w,d,h\n1,1,1\n1,1,1\n1,1,1\n")
    env = PickPlaceEnv(items=items, num_envs=2)
    observation = env.reset()
    for number in range(1, 6):
        action = observation["action_mask"].int().argmax(1)
        if number == 2:  # slot 1 fails
            action[1] = observation["action_mask"][1].int().argmin()
        after, observation = env.step_and_maybe_reset(observation.set("action", action))
        ends = [number == 3, number == 5]
        assert after["next", "truncated"][:, 0].tolist() == ends
        assert after["next", "terminated"][:, 0].tolist() == [False, number == 2]
        assert after["next", "done"][:, 0].tolist() == [ends[0], ends[1] or number == 2]


def test_a_learner_expects_nothing_after_the_end_of_a_recording(smoke, tmp_path, monkeypatch):
    """Though it truncates: nothing more comes, and no critic learns the value of an empty bin."""
    batches = []

    def recording(*args):
        advantage, loss = make_losses(*args)
        return lambda batch: batches.append(advantage(batch).clone()), loss

    monkeypatch.setattr(trainer, "make_losses", recording)
    stream(tmp_path, "w,d,h\n1,1,1\n2,1,1\n")
    smoke(tmp_path / "run", "items=recorded", f"items.path={tmp_path}/items.csv", "env.tote_size=[5,5,1]")
    ended = torch.cat([batch["next", "truncated"].flatten() for batch in batches])
    target = torch.cat([batch["value_target"].flatten() for batch in batches])
    assert ended.sum() > 20
    torch.testing.assert_close(target[ended], torch.full_like(target[ended], 2 * 0.25))  # 2 cells, by reward_scale


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
        ("w,d,h\n1,1\n", "line 2: got '1,1', expected w,d,h as whole numbers"),
        ("w,d,h\n1,1,1,1\n", "line 2: got '1,1,1,1'"),
        ("w,d,h\n1,1,1\n\n1,1,1.5\n", "line 4: got '1,1,1.5'"),
        ("w,d,h\n1_0,1,1\n", "line 2: got '1_0,1,1'"),
        ("w,d,h\n1,1,99999999999999999999\n", "line 2"),
        ("w,d,h,x,y\n1,1,1\n", "line 2: got '1,1,1', expected w,d,h,x,y"),
        ("W;D;H\n1;1;1\n", "the header is 'W;D;H', expected 'w,d,h' or 'w,d,h,x,y'"),
        ("w,d,h,x\n1,1,1,1\n", "the header is 'w,d,h,x'"),
        ("1,1,1\n", "the header is '1,1,1'"),
        (b"w,d,h\n1,1,\xff\n", "expected a CSV in UTF-8"),
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
        ("w,d,h\n1,1,1\n\n6,1,1\n", "line 4: item 6x1x1 does not fit bin_size"),
        ("w,d,h\n4,1,1\n", "line 2: item 4x1x1 does not fit effector_size"),
        ("w,d,h\n1,1,6\n", "line 2: item 1x1x6 is higher than the tote"),
        ("w,d,h,x,y\n1,1,1,0,0\n2,2,1,4,0\n", "line 3: item 2x2x1 at x=4, y=0 leaves the bin"),
    ],
)
def test_rows_that_do_not_fit(tmp_path, text, message):
    with pytest.raises(ValueError) as error:
        PickPlaceEnv(items=stream(tmp_path, text))
    assert message in str(error.value)


@pytest.mark.parametrize("seed", [-1, 2**62, 2**70, 1.5, "a", True])
def test_bad_seeds(seed):
    with pytest.raises(ValueError, match="seed=.*expected a whole number"):
        PickPlaceEnv(seed=seed)
    with pytest.raises(ValueError, match="seed=.*expected a whole number"):
        PickPlaceEnv().set_seed(seed)


@pytest.mark.parametrize("height", [4.5, 4.0, float("nan")])
def test_a_tote_height_is_an_integer(height):
    env = PickPlaceEnv(num_envs=2)
    with pytest.raises(ValueError, match=f"tote_height={height} .*: expected whole cells"):
        env.reset(TensorDict({"tote_height": torch.full((2, 1), height)}, [2]))
