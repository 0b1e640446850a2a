"""Published sequences: played as they stand on the test stream, drawn items elsewhere, refused by their place."""

import json
import pickle

import pytest
import torch
from commands import composed
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import PickPlaceEnv
from pickplace.config.registry import build
from pickplace.evaluation.play import play
from pickplace.items.cut import Cut
from pickplace.items.distributions import Kinds, Uniform, search_items
from pickplace.items.published import Published, published, read_sequences
from pickplace.planners.heuristics import JointDBL

BIN = (5, 5, 1)
END = [10, 10, 10]
SIZES = st.tuples(*[st.integers(1, 5)] * 3)
SEQUENCES = st.lists(st.lists(SIZES, min_size=1, max_size=9), min_size=1, max_size=8)


def write(path, sequences):
    """The authors write sequences as .pt, others as JSON."""
    torch.save(sequences, path) if path.suffix == ".pt" else path.write_text(json.dumps(sequences))
    return path


def sampled(items, stream, episodes, steps, seed=0):
    """The sizes of the first items of episodes, asked for all at once; (0, 0, 0) after the last one."""
    episode = torch.arange(episodes).repeat_interleave(steps)
    step = torch.arange(steps).repeat(episodes)
    item = items.sample(stream, torch.full_like(step, seed), episode, step, BIN)
    assert (item.x >= 0).all() and (item.x + item.w <= 5).all() and (item.y >= 0).all() and (item.y + item.d <= 5).all()
    sizes = torch.stack([item.w, item.d, item.h], 1)
    if stream == "test":
        there = item.exists
        assert torch.equal(items.sizes[item.kind[there]], sizes[there])
    return sizes.view(episodes, steps, 3).tolist()


@settings(max_examples=60, deadline=None)
@given(SEQUENCES, st.sampled_from([".json", ".pt"]), st.booleans(), st.integers(0, 10**6))
def test_the_test_stream_is_the_file(tmp_path_factory, sequences, suffix, ends, seed):
    written = [[*map(list, each), *[END] * ends] for each in sequences]
    path = write(tmp_path_factory.mktemp("published") / f"a{suffix}", written)
    drawn = Uniform([2, 5], [2, 5], [2, 5])
    items = pickle.loads(pickle.dumps(published(drawn, str(path), END)))  # as a worker gets it
    count = items.num_episodes("test")
    assert count == len(sequences) and items.num_episodes("train") is items.num_episodes("validation") is None
    found = sampled(items, "test", 2 * count, 11, seed)  # the file again after its last sequence
    assert found == 2 * [[*map(list, each), *[[0, 0, 0]] * (11 - len(each))] for each in sequences]
    number = torch.arange(count)
    assert items.num_items("test", number, number).tolist() == [*map(len, sequences)]
    for stream in ("train", "validation"):
        assert sampled(items, stream, 3, 20, seed) == sampled(drawn, stream, 3, 20, seed)
        assert items.num_items(stream, number, number).tolist() == [0] * count
    kinds = [tuple(size) for size in items.sizes.tolist()]
    assert kinds[:64] == [tuple(size) for size in drawn.sizes.tolist()] and len({*kinds}) == len(kinds)
    assert {*kinds[64:]} == {size for each in sequences for size in each if min(size) < 2}
    assert items.arrival_mask().all() and len(items.arrival_mask()) == len(kinds) and items.tallest() == 5


@pytest.mark.parametrize("drawn", [Uniform([2, 3], [2, 3], [2, 3]), Cut([4, 4, 4], [2, 3])])
def test_a_search_and_the_levels_of_a_curriculum_see_the_drawn_items(tmp_path, drawn):
    items = published(drawn, write(tmp_path / "a.json", [[[5, 1, 1], [2, 2, 2]]]))
    imagined = search_items(items)
    assert isinstance(imagined, Kinds) == drawn.sequential  # of a sequence all sizes, else what is drawn
    steps = torch.arange(50)
    seed = torch.zeros_like(steps)
    if not drawn.sequential:
        assert torch.equal(items.spread(seed, steps, 50, BIN).table, drawn.spread(seed, steps, 50, BIN).table)
        other = items.mixed([{"width": [3, 3]}])
        assert (other.mixes, items.mixes) == (2, 1)
        mix = torch.ones_like(steps)
        assert other.sample("train", seed, steps, steps, BIN, mix).w.eq(3).all()
        assert other.sizes[other.arrival_mask(1), 0].tolist() == [3, 3, 3, 3, 5]
        assert other.sample("test", seed, seed, seed, BIN, mix).w.eq(5).all()


def test_without_a_file_all_items_are_drawn():
    drawn = Uniform()
    assert published(drawn) is drawn
    with pytest.raises(ValueError, match="^items.end=10: expected 3 whole numbers"):
        published(drawn, end=10)
    with pytest.raises(ValueError, match="^items.drawn=None: expected an item distribution"):
        published(None)


@pytest.mark.parametrize("name", ["cdrl_rs", "cut1", "cut2"])
def test_a_benchmark_plays_the_sequences_of_a_file(tmp_path, name):
    """Every item that a planner places is the next one of the file; an episode ends with its sequence."""
    sequences = [[[5, 5, 5]] * 4, [[2, 3, 4], [5, 5, 2], [3, 2, 4]], [[5, 5, 5]] * 9]
    path = write(tmp_path / "a.json", [[*each, END] for each in sequences])
    cfg = composed(f"benchmark={name}", f"items.path={path}", name="evaluate")
    items = build("items", cfg["items"])

    def make_env(first, count):
        env = {key: value for key, value in cfg.env.items() if key not in ("num_envs", "observation")}
        return build("env", {**env, "num_envs": count}, items=items, stream="test", first_episode=first, masks=())

    probe = make_env(0, 1)
    assert isinstance(probe, PickPlaceEnv) and isinstance(items, Published)
    episodes = play(make_env, JointDBL(probe.cell), 3, 2, range(3))
    assert episodes.num_items.tolist() == [4, 3, 9] and episodes.items_placed.tolist() == [4, 3, 8]
    assert [each.ending.name for each in episodes.recordings] == ["NONE", "NONE", "STUCK"]
    placed = [[list(move.item[2:]) for move in each.moves] for each in episodes.recordings]
    assert placed == [sequences[0], sequences[1], sequences[2][:8]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[[[2,2,2]],\n[[2,2]]]", "sequence 2, item 1: got [2, 2], expected [w, d, h] in whole cells, each 1 or more."),
        ("[[[2,2,2],[2,0,2]]]", "sequence 1, item 2: got [2, 0, 2], expected"),
        ("[[[2,2,2.5]]]", "sequence 1, item 1: got [2, 2, 2.5], expected"),
        ("[[[2,2,true]]]", "sequence 1, item 1: got [2, 2, True], expected"),
        ("[[[2,2,99999999999]]]", "sequence 1, item 1: got [2, 2, 99999999999], expected"),
        ("[[[2,2,2]], 3]", "sequence 2: got 3, expected a list of items [w, d, h]."),
        ("[[[2,2,2]], []]", "sequence 2: no items, expected at least one."),
        ("[[[10,10,10]]]", "sequence 1: no items, expected at least one."),
        ("[]", ": no sequences, expected at least one."),
        ("{}", ": got {}, expected a list of sequences of items [w, d, h]"),
        ("[[[2,2,2]],\n[[2,2,]]]", ", line 2: "),
        ("[" * 100_000, ", line 1: "),
        ("", ": 0 bytes; expected a file with content."),
    ],
)
def test_files_that_cannot_be_used(tmp_path, content, message):
    path = tmp_path / "a.json"
    path.write_text(content)
    with pytest.raises(ValueError, match="^[^\n]*$") as error:
        read_sequences(path, END)
    assert str(error.value).startswith(str(path)) and message in str(error.value)


class Evil:
    def __reduce__(self):
        return (print, ("made",))


@pytest.mark.parametrize("content", [b"no file of torch's", Evil()])
def test_a_file_of_torch_s_holds_numbers_only(tmp_path, content, capsys):
    path = tmp_path / "a.pt"
    path.write_bytes(content) if isinstance(content, bytes) else torch.save([content], path)
    with pytest.raises(ValueError, match="a.pt: it is not read by torch; expected a list of sequences of items"):
        read_sequences(path)
    assert not capsys.readouterr().out


def test_an_item_that_does_not_fit_is_named(tmp_path):
    path = write(tmp_path / "a.json", [[[2, 2, 2]], [[3, 3, 3], [6, 2, 2]]])
    cell = {"bin_size": BIN, "tote_size": (10, 10, 10), "effector_size": (1, 1), "pick_rule": "overlap"}
    with pytest.raises(ValueError, match=r"a\.json, sequence 2, item 2: item 6x2x2 does not fit bin_size"):
        PickPlaceEnv(published(Uniform(), path), num_envs=1, **cell)
    with pytest.raises(ValueError, match="^items.path='nowhere.json': expected a file, a list of sequences"):
        read_sequences("nowhere.json")
