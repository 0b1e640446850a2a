"""Levels that set more than the tote's height: read from a config, written into resets, trained and resumed."""

import shutil

import pytest
import torch
from commands import SETTINGS, after_batch, assert_same, composed
from torchrl.envs import Compose, TransformedEnv

from pickplace import CellSpec, PickPlaceEnv
from pickplace.items.distributions import PAPER_KINDS, Kinds, Recorded, Uniform
from pickplace.rules.state import REFILLS
from pickplace.runs.loggers import read_csv
from pickplace.training.curriculum.advance import NoAdvance
from pickplace.training.curriculum.curriculum import Curriculum
from pickplace.training.curriculum.levels import read_levels
from pickplace.training.curriculum.sample import Uniform as AnyLevel
from pickplace.training.curriculum.transform import ToteHeightCurriculum
from pickplace.training.train import resume_run, train

PAPER = Kinds(PAPER_KINDS)
SIZES = {"bin_size": (6, 6, 1), "tote_size": (6, 6, 5), "bin_items": 3, "preview": 2}
LEVELS = [
    {"tote_height": 2, "items": {"weights": [1, 0, 0, 0]}, "rotations": 1, "bin_items": 1},
    {"tote_height": 3, "items": {"width": [1, 2], "depth": [1, 1]}, "rotations": [0, 3]},
    {"items": {"weights": [1, 0, 0, 0]}, "refill": "batch", "preview": 0},
    {},
]


def levels_of(given, items=PAPER, **changes):
    return read_levels(given, CellSpec(**SIZES | changes), items)


def test_levels_are_numbered_from_1_and_what_they_leave_out_is_that_of_the_full_task():
    levels = levels_of(LEVELS)
    assert (levels.first, levels.last, levels.key, levels.is_full) == (1, 4, "level", True)
    numbers = {key: column[:, 0].tolist() for key, column in levels.entries.items() if key != "rotations"}
    assert numbers == {
        "tote_height": [2, 3, 5, 5], "level": [1, 2, 3, 4], "item_mix": [1, 2, 1, 0], "bin_items": [1, 3, 3, 3],
        "refill": [0, 0, 1, 0], "preview": [2, 2, 0, 2],
    }  # fmt: skip
    assert levels.entries["rotations"].int().tolist() == [[1, 0, 0, 0], [1, 0, 0, 1], [1] * 4, [1] * 4]
    assert [levels.items.arrival_mask(mix).int().tolist() for mix in range(3)] == [[1] * 4, [1, 0, 0, 0], [1, 1, 0, 0]]
    assert not levels_of([{}, {"rotations": 2}]).is_full
    assert levels_of([{"tote_height": 5}]).varies == ("level",)
    assert levels_of([{"tote_height": 2.0}, {}]).entries["tote_height"].tolist() == [[2], [5]]  # 2.0 is a whole number


def test_episodes_play_what_their_level_sets():
    torch.manual_seed(0)
    curriculum = Curriculum(NoAdvance(), AnyLevel(), levels=LEVELS)
    curriculum.setup(CellSpec(**SIZES), PAPER, 1000)
    levels = curriculum.levels
    base = PickPlaceEnv(levels.items, num_envs=64, varies=levels.varies, **SIZES)
    env = TransformedEnv(base, Compose(ToteHeightCurriculum(4, curriculum.sample, levels)))
    td, seen = env.reset(), set()
    for _ in range(12):
        level = td["level"][:, 0] - 1
        for key, entries in levels.entries.items():
            assert td[key].equal(entries[level])
        seen |= {*level.tolist()}
        mix, sizes, exists = levels.entries["item_mix"][level, 0], td["items"][..., 2:], td["items"][..., 4] > 0
        assert ((sizes == 1).all(-1) | ~exists)[mix == 1].all() and ((sizes[..., 1] == 1) | ~exists)[mix == 2].all()
        assert (exists.sum(1) <= td["bin_items"][:, 0]).all()
        assert ((td["coming"][..., 4] > 0).sum(1) == td["preview"][:, 0]).all()
        turned = td["action_mask"].unflatten(1, (-1, 4)).any(1)
        assert not (turned & ~td["rotations"]).any()
        action = td["action_mask"].float().multinomial(1)[:, 0]
        td = env.step_and_maybe_reset(td.set("action", action))[1]
    assert seen == {0, 1, 2, 3} and td["refill"].unique().tolist() == [*range(len(REFILLS))]


SMALL = {"weights": [1, 0, 0, 0]}
ERRORS = [
    ([], r"curriculum.levels=\[\]: expected a list of mappings"),
    (5, "curriculum.levels=5: "),
    ([3], r"curriculum.levels=\[3\]: "),
    ([{}] * 1001, "curriculum.levels: the list has 1,001 levels; expected at most 1,000"),
    ([{}, {"tote_heigth": 2}], r"curriculum.levels\[1\].tote_heigth: .*did you mean 'tote_height'"),
    ([{"level": 2}], r"curriculum.levels\[0\].level: there is no key 'level' .*; expected one of tote_height, items"),
    ([{"tote_size": [3, 3, 3]}], r"levels\[0\].tote_size: .* chain two runs: .* warm_start.weights=outputs/first"),
    ([{"gripper": "point"}], r"levels\[0\].gripper: a level sets tote_height, items, .*, refill, preview\."),
    ([{"tote_height": 6}], r"levels\[0\].tote_height=6: .* <= 5"),
    ([{"tote_height": None}], r"levels\[0\].tote_height=None: expected a whole number"),
    ([{"rotations": 5}], r"levels\[0\].rotations=5: expected how many quarter turns, 1 to 4"),
    ([{"rotations": []}], r"levels\[0\].rotations=\[\]"),
    ([{"rotations": [1.0]}], r"levels\[0\].rotations=\[1.0\]"),
    ([{"rotations": [True]}], r"levels\[0\].rotations=\[True\]"),
    ([{"items": []}], r"levels\[0\]: items=\[\]: expected {weights: "),
    ([{"rotations": [4]}], r"levels\[0\].rotations=\[4\]"),
    ([{"bin_items": 4}], r"levels\[0\].bin_items=4: .* <= 3"),
    ([{"preview": 3}], r"levels\[0\].preview=3: .* >= 0 and <= 2, env.preview"),
    ([{"refill": "never"}], r"levels\[0\].refill='never': expected 'each' or 'batch'"),
    ([{"items": {"weights": [1]}}], r"levels\[0\]: items.weights=\[1\]: expected 4 numbers"),
    ([{"items": {"weights": [0] * 4}}], r"levels\[0\]: items.weights=.*not all 0"),
    ([{"items": {"width": [3, 4]}}], r"levels\[0\]: items=.*: expected sizes that some kind of the full task has"),
    ([{"items": {"volume": 3}}], r"levels\[0\]: items=.*: expected {weights: "),
    ([{"items": "small"}], r"levels\[0\]: items='small': expected {weights: "),
]  # fmt: skip


@pytest.mark.parametrize(("levels", "message"), ERRORS)
def test_a_bad_level_is_named(levels, message):
    with pytest.raises(ValueError, match=message) as error:
        levels_of(levels)
    assert "\n" not in str(error.value)


def test_items_of_one_s_own_without_mixes_are_refused():
    class Own(Kinds):
        def sample(self, stream, seed, episode, step, bin_size):
            return super().sample(stream, seed, episode, step, bin_size)

    with pytest.raises(ValueError, match=r"items='Own': expected a class with sample\(stream, ..., bin_size, mix=None"):
        Own([(1, 1, 1), (2, 1, 1)]).mixed([{"width": [1, 1]}])


def test_a_level_at_which_no_episode_could_begin_is_named(tmp_path):
    tall = Uniform(height=(1, 3))
    with pytest.raises(ValueError, match=r"levels\[1\].tote_height=2: expected at least 3, the height of its tallest"):
        levels_of([{"items": {"height": [1, 2]}, "tote_height": 2}, {"tote_height": 2}], tall)
    long = {"tote_size": (4, 2, 5), "effector_size": (1, 1), "pick_rule": "overlap"}
    with pytest.raises(ValueError, match=r"levels\[0\]: item 1x3x1 at x=0, y=0 in the bin has no feasible action"):
        levels_of([{"rotations": [0, 2]}], Kinds([(1, 3, 1)]), **long)
    (tmp_path / "items.csv").write_text("w,d,h\n1,1,1\n")
    with pytest.raises(ValueError, match=r"levels\[0\]: items: Recorded has no mixes; expected items=kinds"):
        levels_of([{"items": SMALL}], Recorded(tmp_path / "items.csv", loop=True))
    with pytest.raises(ValueError, match="curriculum.end_height=3: expected null where curriculum.levels lists"):
        Curriculum(NoAdvance(), AnyLevel(), end_height=3, levels=LEVELS)


def test_mixes_draw_their_kinds_and_mix_0_is_the_distribution_itself():
    kinds = Kinds(PAPER_KINDS, [4, 0, 2, 1])
    mixed = kinds.mixed([{"weights": [0, 0, 3, 1]}, {"depth": [1, 1]}])
    seed, episode = torch.tensor(0), torch.arange(40_000)
    address = "train", seed.expand_as(episode), episode, torch.zeros_like(episode)
    plain = kinds.sample(*address, (5, 5))
    for mix, shares in enumerate(([4 / 7, 2 / 7, 1 / 7], [0, 3 / 4, 1 / 4], [1, 0, 0])):
        items = mixed.sample(*address, (5, 5), mix=torch.full_like(episode, mix))
        assert items.kind.bincount(minlength=3).tolist() == pytest.approx([40_000 * s for s in shares], rel=0.05)
        assert mix or all(map(torch.equal, items, plain))
        spread = mixed.spread(torch.zeros(64).long(), torch.arange(64), 64, (5, 5), mix=torch.full((64,), mix))
        assert spread.kind.bincount(minlength=3).tolist() == pytest.approx([64 * s for s in shares], abs=1)


SEVERAL = ["env.bin_items=2", "env.bin_size=[5,5,1]", "algo.advantages=gae"]


def test_a_run_over_such_levels_is_resumed_exactly(tmp_path):
    others = "{rotations: 2, bin_items: 1}, {refill: batch}"
    levels = f"curriculum.levels=[{{items: {{weights: [1, 0, 0, 0]}}, tote_height: 2}}, {others}, {{}}]"
    rule = ["curriculum=learning_progress", "curriculum.advance.window=4", levels, "collector=multi_sync"]
    usual = [word for word in SETTINGS if not word.startswith("curriculum")]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    with after_batch(5, lambda _: shutil.copytree(whole, killed)):
        train(composed(*usual, *SEVERAL, *rule), whole)
    resume_run([f"resume={killed}"])
    assert_same(whole, killed)
    rows = read_csv(whole / "metrics.csv")
    assert all(any(f"curriculum/occupancy_at_{level}" in row for row in rows) for level in (1, 2, 3))
