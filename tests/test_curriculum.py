"""Curricula: every rule and sampler on scripted episodes, the transform in the environment, every config."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from pickplace import PickPlaceEnv
from pickplace.runs.registry import build
from pickplace.training.curriculum import (
    Advance,
    Current,
    Curriculum,
    Frames,
    NoAdvance,
    Plateau,
    Recent,
    Staged,
    Threshold,
    ToteHeightCurriculum,
    Uniform,
    push_level,
)

CONF = Path(__file__).parents[1] / "conf"
COMPOSITIONS = sorted(p.stem for p in (CONF / "curriculum").glob("*.yaml"))


def make(advance, sample=None, low=1, high=5, total_frames=1000, **heights):
    """A curriculum that is set up."""
    curriculum = Curriculum(advance, sample or Current(), **heights)
    curriculum.setup(low, high, total_frames)
    return curriculum


def play(curriculum, frames, occupancy=(), height=None):
    """One batch whose episodes all had one height, by default the level; returns what is logged."""
    height = curriculum.level if height is None else height
    occupancy = torch.tensor(occupancy, dtype=torch.float32)
    return curriculum.update(torch.full(occupancy.shape, height), occupancy, frames)


def through_json(state):
    return json.loads(json.dumps(state, allow_nan=False))


# ---------------------------------------------------------------- advance rules


def test_frames_grow_on_schedule_and_stop_at_the_end():
    curriculum = make(Frames(100))
    levels = [play(curriculum, frames)["curriculum/level"] for frames in range(40, 600, 40)]
    assert levels == [1, 1, 2, 2, 3, 3, 3, 4, 4, 5, 5, 5, 5, 5]  # 40, 80, 120, ...: up at 100, 200, 300, 400


def test_frames_null_divides_the_budget_evenly_and_survives_a_longer_one():
    curriculum = make(Frames(), total_frames=1000)  # 5 levels
    levels = [play(curriculum, frames)["curriculum/level"] for frames in (199, 200, 400, 600, 799, 800)]
    assert levels == [1, 2, 3, 4, 4, 5]
    longer = make(Frames(), total_frames=2000)
    longer.load_state_dict(curriculum.state_dict())
    assert play(longer, 801)["curriculum/level"] == 5  # its schedule says 3, but a level does not go down


def test_threshold_promotes_when_the_window_is_full_and_good_enough():
    curriculum = make(Threshold(occupancy=0.8, window=4))
    assert play(curriculum, 10, [1.0, 1.0, 1.0])["curriculum/level"] == 1  # the window is not full
    assert play(curriculum, 20, [0.1])["curriculum/level"] == 1  # mean 0.775
    logs = play(curriculum, 30, [0.5, 0.9])  # the latest four: 1, 0.1, 0.5, 0.9
    assert logs["curriculum/level"] == 1
    assert logs["curriculum/occupancy"] == pytest.approx(0.625)
    logs = play(curriculum, 40, [0.9, 0.9])  # 0.5, 0.9, 0.9, 0.9: exactly 0.8
    assert logs["curriculum/level"] == 2
    assert logs["curriculum/episodes"] == 8
    assert logs["curriculum/frames_at_level"] == 40


def test_threshold_window_starts_over_after_a_level_change():
    curriculum = make(Threshold(occupancy=0.8, window=4))
    play(curriculum, 10, [0.9] * 8)
    logs = play(curriculum, 20, [0.9] * 3)
    assert logs["curriculum/level"] == 2
    assert logs["curriculum/frames_at_level"] == 10
    assert logs["curriculum/episodes"] == 3
    assert play(curriculum, 30, [0.9])["curriculum/level"] == 3


@pytest.mark.parametrize("height", [1, 2, 4])
def test_threshold_counts_only_episodes_at_the_levels_own_height(height):
    curriculum = make(Threshold(occupancy=0.8, window=4), start_height=3)
    logs = play(curriculum, 10, [1.0] * 100, height=height)
    assert logs["curriculum/level"] == 3
    assert logs["curriculum/episodes"] == 0
    assert "curriculum/occupancy" not in logs
    assert logs[f"curriculum/occupancy_at_{height}"] == 1.0
    mixed = curriculum.update(torch.tensor([3, height] * 4), torch.tensor([0.1, 1.0] * 4), 20)
    assert mixed["curriculum/occupancy"] == pytest.approx(0.1)
    assert curriculum.level == 3


def test_threshold_reached_in_float32_is_reached():
    """0.9 as a float32 lies below 0.9."""
    curriculum = make(Threshold(occupancy=0.9, window=3))
    assert play(curriculum, 10, [0.9] * 3)["curriculum/level"] == 2


def test_threshold_does_not_depend_on_the_order_of_episodes():
    values = torch.rand(400, generator=torch.Generator().manual_seed(0)) ** 16  # of many magnitudes
    means = set()
    for order in (values, values.flip(0), values.sort().values):
        logs = play(make(Threshold(occupancy=1.0, window=400)), 10, order.tolist())
        means.add(logs["curriculum/occupancy"])
    assert len(means) == 1


def test_threshold_promotes_anyway_after_max_frames():
    curriculum = make(Threshold(occupancy=1.0, window=4, max_frames_per_level=100))
    levels = [play(curriculum, frames, [0.1])["curriculum/level"] for frames in range(30, 340, 30)]
    # Counted from the batch in which the level began: up at 120 and 240.
    assert levels == [1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3]


def test_threshold_demotes_but_not_below_the_start():
    curriculum = make(Threshold(occupancy=0.8, window=4, demote_below=0.3))
    levels = [
        play(curriculum, 10 * i, [value] * 4)["curriculum/level"]
        for i, value in enumerate([0.9, 0.9, 0.3, 0.29, 0.29, 0.29, 0.9])
    ]
    assert levels == [2, 3, 3, 2, 1, 1, 2]


def test_threshold_demotes_only_by_a_full_window():
    curriculum = make(Threshold(occupancy=0.8, window=4, demote_below=0.3))
    play(curriculum, 10, [0.9] * 4)
    assert play(curriculum, 20, [0.0] * 3)["curriculum/level"] == 2
    assert play(curriculum, 30, [0.0])["curriculum/level"] == 1


def test_threshold_without_demotion_stays():
    curriculum = make(Threshold(occupancy=0.8, window=4))
    play(curriculum, 10, [0.9] * 4)
    assert play(curriculum, 20, [0.0] * 4)["curriculum/level"] == 2


def test_plateau_promotes_after_windows_without_improvement():
    curriculum = make(Plateau(window=2, patience=2, min_improvement=0.1))
    script = [0.3, 0.5, 0.55, 0.62, 0.65, 0.71]  # best: 0.3, 0.5, -, 0.62 (0.5 + 0.12), -, - -> up
    logs = [play(curriculum, 10 * i, [value] * 2) for i, value in enumerate(script)]
    assert [x["curriculum/level"] for x in logs] == [1, 1, 1, 1, 1, 2]
    assert [x["curriculum/stale_windows"] for x in logs] == [0, 0, 1, 0, 1, 2]
    assert logs[-1]["curriculum/best_occupancy"] == pytest.approx(0.62)
    logs = play(curriculum, 70, [0.2] * 2)  # a new level has a new best
    assert (logs["curriculum/stale_windows"], logs["curriculum/level"]) == (0, 2)


def test_plateau_compares_windows_that_do_not_overlap():
    curriculum = make(Plateau(window=4, patience=1))
    stale = [play(curriculum, 10 * i, [0.5])["curriculum/stale_windows"] for i in range(8)]
    assert stale == [0, 0, 0, 0, 0, 0, 0, 1]


def test_plateau_equal_windows_are_no_improvement():
    curriculum = make(Plateau(window=2, patience=1, min_improvement=0.0))
    assert [play(curriculum, 10 * i, [0.5] * 2)["curriculum/level"] for i in range(2)] == [1, 2]


def test_plateau_ignores_other_heights_and_stays_at_the_end():
    curriculum = make(Plateau(window=2, patience=1), start_height=4)
    play(curriculum, 10, [0.5] * 50, height=2)
    assert curriculum.state_dict()["advance"] == {"best": 0.0, "stale": 0, "compared": 0}
    levels = [play(curriculum, 10 * i, [0.5] * 2)["curriculum/level"] for i in range(6)]
    assert levels == [4, 5, 5, 5, 5, 5]


def test_staged_boundaries():
    curriculum = make(Staged([{"frames": 100, "height": 3}, {"frames": 250, "height": None}]), start_height=2)
    levels = [play(curriculum, frames)["curriculum/level"] for frames in (99, 100, 249, 250, 10**9)]
    assert levels == [2, 3, 3, 5, 5]


def test_staged_may_begin_at_frame_zero_and_go_down():
    curriculum = make(Staged([{"frames": 0, "height": 4}, {"frames": 10, "height": 2}]))
    assert curriculum.level == 4
    assert play(curriculum, 10)["curriculum/level"] == 2


def test_none_trains_at_the_last_height_from_the_start():
    curriculum = make(NoAdvance())
    assert curriculum.level == 5
    logs = play(curriculum, 10, [0.0] * 500)
    assert (logs["curriculum/level"], logs["curriculum/progress"]) == (5, 1.0)


def test_progress_runs_from_zero_to_one():
    curriculum = make(Frames(10), low=2, high=4)
    assert [play(curriculum, f)["curriculum/progress"] for f in (0, 10, 20)] == [0.0, 0.5, 1.0]
    assert play(make(Frames(10), low=3, high=3), 0)["curriculum/progress"] == 1.0  # one level only


def test_heights_default_to_tallest_item_and_full_tote():
    curriculum = make(NoAdvance(), low=2, high=7)
    assert (curriculum.start, curriculum.end) == (2, 7)
    curriculum = make(Frames(10), low=2, high=7, start_height=3, end_height=6)
    assert (curriculum.level, curriculum.start, curriculum.end) == (3, 3, 6)


RULES = {
    "frames": lambda: Frames(7),
    "even": Frames,
    "threshold": lambda: Threshold(0.6, 3, max_frames_per_level=40, demote_below=0.3),
    "plateau": lambda: Plateau(2, 2, 0.05),
    "none": NoAdvance,
    "staged": lambda: Staged([{"frames": 20, "height": 5}, {"frames": 60, "height": 2}]),
}
BATCHES = st.lists(
    st.tuples(
        st.integers(1, 30),  # frames
        st.lists(st.tuples(st.integers(1, 7), st.floats(0, 1, width=32)), max_size=6),  # heights, occupancies
    ),
    max_size=30,
)


def run(curriculum, batches, frames=0):
    """Levels and logs after each batch, and the frames played."""
    history = []
    for new, episodes in batches:
        frames += new
        # Half of the episodes at the level's own height, so that levels move.
        heights = [curriculum.level if i % 2 else height for i, (height, _) in enumerate(episodes)]
        occupancy = torch.tensor([o for _, o in episodes], dtype=torch.float32)
        history.append(curriculum.update(torch.tensor(heights, dtype=torch.int64), occupancy, frames))
    return history, frames


@pytest.mark.parametrize("rule", RULES)
@settings(max_examples=40)
@given(batches=BATCHES, low=st.integers(1, 2), high=st.integers(5, 7))
def test_level_stays_in_range_and_moves_by_one(rule, batches, low, high):
    curriculum = make(RULES[rule](), low=low, high=high)
    levels = [curriculum.level] + [logs["curriculum/level"] for logs in run(curriculum, batches)[0]]
    assert all(low <= level <= high for level in levels)
    if rule != "staged":
        assert all(abs(after - before) <= 1 for before, after in zip(levels, levels[1:], strict=False))


@pytest.mark.parametrize("rule", RULES)
@settings(max_examples=40)
@given(batches=BATCHES, more=BATCHES)
def test_state_through_json_continues_exactly(rule, batches, more):
    straight = make(RULES[rule]())
    _, frames = run(straight, batches)
    state = through_json(straight.state_dict())
    resumed = make(RULES[rule]())
    resumed.load_state_dict(state)
    assert run(resumed, more, frames) == run(straight, more, frames)
    assert resumed.state_dict() == straight.state_dict()


def test_state_is_a_copy():
    curriculum = make(Threshold(0.8, 4))
    play(curriculum, 10, [0.5] * 3)
    state = curriculum.state_dict()
    before = copy.deepcopy(state)
    play(curriculum, 20, [0.5])
    assert state == before


def test_state_of_another_rule_or_level_is_refused():
    curriculum = make(Plateau(2, 2))
    with pytest.raises(ValueError, match="curriculum.advance=Frames.*'best'.*expected"):
        make(Frames(10)).load_state_dict(curriculum.state_dict())
    high = make(NoAdvance(), high=9)
    with pytest.raises(ValueError, match="level of the checkpoint=9: expected .* <= 5"):
        make(NoAdvance()).load_state_dict(high.state_dict())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: make(NoAdvance(), start_height=9), "curriculum.start_height=9: .* >= 1 and <= 5"),
        (lambda: make(NoAdvance(), start_height=1, low=2), "curriculum.start_height=1: .* >= 2"),
        (lambda: make(NoAdvance(), end_height=6), "curriculum.end_height=6: .* <= 5"),
        (lambda: make(NoAdvance(), start_height=4, end_height=3), "curriculum.start_height=4: .* <= 3"),
        (lambda: make(NoAdvance(), start_height=2.5), "curriculum.start_height=2.5: "),
        (lambda: make(NoAdvance(), total_frames=0), "total_frames=0: "),
        (lambda: Frames(0), "curriculum.advance.frames_per_level=0: "),
        (lambda: Threshold(1.5, 10), "curriculum.advance.occupancy=1.5: .* between 0 and 1"),
        (lambda: Threshold(0.5, 0), "curriculum.advance.window=0: "),
        (lambda: Threshold(0.5, 10, max_frames_per_level=-1), "curriculum.advance.max_frames_per_level=-1: "),
        (lambda: Threshold(0.5, 10, demote_below=0.5), "curriculum.advance.demote_below=0.5: .*0.5"),
        (lambda: Plateau(10, True), "curriculum.advance.patience=True: "),
        (lambda: Plateau(10, 3, -0.1), "curriculum.advance.min_improvement=-0.1: "),
        (lambda: Staged([]), r"curriculum.advance.stages=\[\]: "),
        (lambda: Staged([{"frames": 1}]), "curriculum.advance.stages: got {'frames': 1}"),
        (lambda: Staged([7]), "curriculum.advance.stages: got 7"),
        (lambda: Staged([{"frames": 5, "height": 2}] * 2), "curriculum.advance.stages: frames=5: .* >= 6"),
        (lambda: make(Staged([{"frames": 5, "height": 9}])), "curriculum.advance.stages: height=9: .* <= 5"),
        (lambda: Recent("many"), "curriculum.sample.share='many': "),
        (lambda: ToteHeightCurriculum(1, Current(), 2), "level=1: .* >= 2"),
    ],
)
def test_bad_settings_are_named(build, message):
    with pytest.raises(ValueError, match=message) as error:
        build()
    assert str(error.value).endswith(".") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("advance", "enough"),
    [
        (lambda: Frames(100), 401),  # 4 steps of 100 frames, then one frame at the last height
        (lambda: Threshold(0.9, 50), 201),
        (lambda: Threshold(0.9, 50, max_frames_per_level=10), 41),
        (lambda: Plateau(10, 3), 121),
        (lambda: Staged([{"frames": 30, "height": 3}, {"frames": 70, "height": 5}]), 71),
        (NoAdvance, 1),
    ],
)
def test_budget_is_judged_to_the_frame(advance, enough):
    curriculum = make(advance())
    assert curriculum.check_budget(enough) is None
    message = curriculum.check_budget(enough - 1)
    assert message.startswith(f"total_frames={enough - 1}: ") and f"more than {enough - 1} frames" in message


def test_budget_message_is_true():
    """With a budget that is refused the last height is not reached; with one frame more it is."""
    for rule, occupancy in ((Frames(10), []), (Threshold(0.5, 4), [1.0]), (Plateau(2, 2), [0.0])):
        curriculum = make(rule)
        frames = 0
        while curriculum.check_budget(frames + 1):
            assert curriculum.level < 5
            frames += 1
            play(curriculum, frames, occupancy)
        assert curriculum.level == 5


@pytest.mark.parametrize("batch", [3, 50])
@pytest.mark.parametrize(
    ("rule", "occupancy"),
    [(lambda: Frames(10), []), (lambda: Threshold(0.5, 4), [1.0]), (lambda: Plateau(2, 2), [0.0])],
)
def test_budget_message_is_true_of_batches(batch, rule, occupancy):
    curriculum, frames = make(rule()), 0
    while curriculum.check_budget(frames + 1, batch):
        assert curriculum.level < 5
        frames += batch
        play(curriculum, frames, occupancy * batch)


def test_training_that_ends_below_full_height_says_so():
    curriculum = Curriculum(NoAdvance(), Current(), end_height=3)
    curriculum.setup(1, 5, 1000)
    assert "curriculum.end_height=3: nothing is trained at the full height, 5" in curriculum.check_budget(1000)


def test_budget_of_stages_that_never_reach_the_end():
    assert "a stage of that height" in make(Staged([{"frames": 5, "height": 3}])).check_budget(10**9)


def test_even_division_always_fits():
    assert make(Frames(), total_frames=1000).check_budget(1000) is None


# ---------------------------------------------------------------- height samplers


def test_current_is_the_level():
    assert Current()(4, 1, 3).tolist() == [4, 4, 4]


def test_uniform_covers_all_heights_evenly():
    torch.manual_seed(0)
    heights = Uniform()(5, 2, 4000)
    assert heights.dtype == torch.int64
    counts = heights.bincount(minlength=7).tolist()
    assert counts[:2] == [0, 0] and counts[6] == 0
    assert all(900 < count < 1100 for count in counts[2:6])


def test_recent_keeps_its_share_of_earlier_heights():
    torch.manual_seed(0)
    counts = Recent(0.25)(5, 2, 12000).bincount(minlength=7).tolist()
    assert counts[0] == counts[1] == counts[6] == 0
    assert all(900 < count < 1100 for count in counts[2:5])  # 1/12 each
    assert 8800 < counts[5] < 9200
    assert set(Recent(1.0)(5, 2, 1000).tolist()) == {2, 3, 4}
    assert set(Recent(0.0)(5, 2, 1000).tolist()) == {5}


@pytest.mark.parametrize("sampler", [Current(), Uniform(), Recent(1.0)])
def test_samplers_at_the_first_level(sampler):
    assert sampler(3, 3, 100).tolist() == [3] * 100


@pytest.mark.parametrize("sampler", [Uniform(), Recent(0.5)])
def test_samplers_draw_from_the_global_generator(sampler):
    torch.manual_seed(3)
    state = torch.get_rng_state()
    first = sampler(9, 1, 50)
    assert not torch.equal(first, sampler(9, 1, 50))
    torch.set_rng_state(state)
    assert torch.equal(first, sampler(9, 1, 50))


# ---------------------------------------------------------------- rules and samplers of one's own


class Own(Advance):
    """Gives and logs what it is told to."""

    remembers = ("seen",)

    def __init__(self, level, seen=0, logs=None):
        self.level, self.seen, self.logs = level, seen, logs or {}

    def update(self, tally):
        return self.level, dict(self.logs)


@pytest.mark.parametrize(("wanted", "level"), [(9, 4), (5, 4), (4, 4), (-3, 2), (np.int64(3), 3)])
def test_a_level_beyond_the_heights_is_the_nearest(wanted, level):
    curriculum = make(Own(wanted), low=2, high=4)
    assert play(curriculum, 10)["curriculum/level"] == curriculum.level == level
    again = make(Own(wanted), low=2, high=4)
    again.load_state_dict(through_json(curriculum.state_dict()))
    assert again.level == level


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (Own(1.5), "curriculum.advance: Own wants level 1.5; expected a whole number"),
        (Own(True), "Own wants level True"),
        (Own(1, logs={"mood": "good"}), "curriculum.advance: Own: it logs mood='good'; expected a number"),
        (Own(1, seen=torch.tensor(1)), r"Own remembers seen=tensor\(1\); expected a plain, finite number"),
        (Own(1, seen=float("nan")), "Own remembers seen=nan"),
    ],
)
def test_what_a_rule_of_ones_own_gives_is_checked_at_once(rule, message):
    with pytest.raises(ValueError, match=message):
        play(make(rule), 10)


@pytest.mark.parametrize("answer", [2, (2, None), None])
def test_a_rule_that_does_not_answer_with_a_level_and_logs_is_named(answer, monkeypatch):
    monkeypatch.setattr(Own, "update", lambda self, tally: answer)
    with pytest.raises(ValueError, match=r"Own: update gave .*; expected \(level, {name: number}\)"):
        play(make(Own(1)), 10)


def test_a_rule_that_lacks_what_it_remembers_is_told_before_the_first_batch():
    rule = Own(1)
    del rule.seen
    with pytest.raises(ValueError, match="Own remembers seen=None"):
        make(rule)


@pytest.mark.parametrize("drawn", [lambda count: torch.ones(count - 1).long(), lambda count: torch.ones(count), list])
def test_a_sampler_that_draws_something_else_is_named(drawn):
    def sampler(level, least, count):
        return drawn(count) if drawn is not list else [1] * count

    with pytest.raises(
        ValueError, match=r"curriculum.sample: function gave .*; expected heights, whole numbers in a tensor \[6\]"
    ):
        make_env(level=3, sampler=sampler).reset()


# ---------------------------------------------------------------- the transform


def make_env(level=3, sampler=None, num_envs=6):
    curriculum = ToteHeightCurriculum(level, sampler or Current(), 1)
    env = PickPlaceEnv(tote_size=(4, 4, 5), num_envs=num_envs)
    return TransformedEnv(env, Compose(curriculum, RewardSum(), StepCounter()))


def first_feasible(td):
    return td.set("action", td["action_mask"].int().argmax(-1))


def first_infeasible(td):
    return td.set("action", (~td["action_mask"]).int().argmax(-1))


def heights(td):
    return td["tote_height"].squeeze(-1).tolist()


def test_plain_reset_gets_the_level_and_the_env_honours_it():
    env = make_env(level=3)
    td = env.reset()
    assert heights(td) == [3] * 6
    assert td["tote_height"].dtype == torch.int64
    assert (td["tote_depth"] == 3).all()  # the environment itself works at that height
    env.transform[0].set_level(4)
    assert heights(env.reset()) == [4] * 6
    assert heights(env.reset(TensorDict(batch_size=[6]))) == [4] * 6
    assert heights(env.reset(td)) == [4] * 6  # what lies in the TensorDict does not decide


def test_without_compose_too():
    env = TransformedEnv(PickPlaceEnv(num_envs=2), ToteHeightCurriculum(2, Current(), 1))
    assert heights(env.reset()) == [2, 2]


def test_env_specs_hold():
    check_env_specs(make_env(sampler=Uniform()))


@pytest.mark.parametrize("hidden", [False, True], ids=["whole", "select_reset_only"])
def test_partial_reset_leaves_running_episodes_their_height(hidden):
    env = make_env(level=3)
    td = env.reset()
    env.transform[0].set_level(5)
    mask = torch.tensor([1, 0, 0, 1, 0, 0]).bool()
    td = env.reset(td.set("_reset", mask[:, None]), select_reset_only=hidden)
    assert heights(td) == [5, 3, 3, 5, 3, 3]
    assert td["tote_depth"][:, 0, 0].tolist() == [5, 3, 3, 5, 3, 3]
    td = env.step(first_feasible(td))["next"]
    assert heights(td) == [5, 3, 3, 5, 3, 3]  # and the environment goes on with them


def test_transform_keeps_running_rows_itself():
    """The environment ignores rows that are not reset, so look at what the transform hands to it."""
    transform = make_env(level=2).transform[0]
    td = TensorDict(
        {"_reset": torch.tensor([[True], [False]]), "tote_height": torch.tensor([[4], [4]])}, batch_size=[2]
    )
    assert heights(transform._reset_env_preprocess(td)) == [2, 4]


def test_automatic_resets_take_the_new_level_and_running_episodes_do_not():
    env = make_env(level=3)
    td = env.reset()
    env.transform[0].set_level(4)
    done = torch.tensor([0, 1, 0, 1, 0, 1]).bool()
    action = torch.where(done, first_infeasible(td.clone())["action"], first_feasible(td.clone())["action"])
    td, following = env.step_and_maybe_reset(td.set("action", action))
    assert td["next", "done"].squeeze(-1).tolist() == done.tolist()
    assert heights(td["next"]) == [3] * 6  # finished episodes report the height they were played at
    assert heights(following) == [3, 4, 3, 4, 3, 4]


def test_random_sampler_stays_in_range_over_a_rollout():
    torch.manual_seed(0)
    env = make_env(level=4, sampler=Uniform(), num_envs=32)
    td = env.rollout(20, first_infeasible, break_when_any_done=False)
    assert set(td["tote_height"].unique().tolist()) == {1, 2, 3, 4}


def test_level_is_in_the_state_dict():
    state = make_env(level=4).state_dict()
    env = make_env(level=2)
    env.load_state_dict(state)
    assert heights(env.reset()) == [4] * 6
    with pytest.raises(ValueError, match="level=0: .* >= 1"):
        env.transform[0].set_level(0)


def test_curriculum_makes_its_transform():
    curriculum = make(Frames(10), Uniform(), start_height=2)
    play(curriculum, 10)
    transform = curriculum.transform()
    assert (int(transform.level), transform.min_height, transform.sampler) == (3, 2, curriculum.sample)


@pytest.mark.parametrize("kind", ["single", "multi_sync"])
def test_push_level_reaches_every_process(kind):
    settings = {"frames_per_batch": 24, "total_frames": -1}
    if kind == "single":
        collector = Collector(make_env(), first_infeasible, **settings)
    else:
        collector = MultiSyncCollector([make_env] * 2, first_infeasible, **settings, cat_results=0)
    try:
        batches = iter(collector)
        assert set(next(batches)["tote_height"].flatten().tolist()) == {3}
        push_level(collector, 5)
        batch = next(batches)  # every episode lasts one step; those that had begun keep their height
        assert batch["tote_height"][:, 0].flatten().tolist() == [3] * len(batch)
        assert set(batch["tote_height"][:, 1:].flatten().tolist()) == {5}
    finally:
        collector.shutdown()


# ---------------------------------------------------------------- configs


def load(*overrides):
    """The curriculum that these overrides compose."""
    with initialize_config_dir(str(CONF), version_base=None):
        return build("curriculum", compose(overrides=[f"+{overrides[0]}", *overrides[1:]]).curriculum)


def test_there_are_the_promised_compositions():
    assert {"none", "paper", "adaptive", "mixture"} <= set(COMPOSITIONS)


@pytest.mark.parametrize("name", COMPOSITIONS)
def test_compositions_reach_full_height(name):
    """An ideal policy, 20 episodes and 10,000 frames a batch: levels in order, none skipped."""
    curriculum = load(f"curriculum={name}")
    curriculum.setup(1, 5, 25_000_000)
    assert curriculum.check_budget(25_000_000) is None
    torch.manual_seed(0)
    seen, frames = [curriculum.level], 0
    while curriculum.level < 5 and frames < 25_000_000:
        frames += 10_000
        drawn = curriculum.sample(curriculum.level, curriculum.start, 20)
        logs = curriculum.update(drawn, torch.full((20,), 0.95), frames)
        if logs["curriculum/level"] != seen[-1]:
            seen.append(logs["curriculum/level"])
    assert curriculum.level == 5
    assert seen == ([5] if name == "none" else [1, 2, 3, 4, 5])
    episodes = frames // 500
    expected = {"none": 0, "paper": 40_000, "adaptive": 4 * 400}
    if name == "mixture":  # a quarter of the episodes does not count, but at the first level all do
        assert 400 + 3 * 480 < episodes < 400 + 3 * 620
    elif name in expected:
        assert episodes == expected[name]


def test_paper_grows_each_five_million_frames():
    curriculum = load("curriculum=paper")
    curriculum.setup(1, 5, 25_000_000)
    levels = [play(curriculum, f)["curriculum/level"] for f in (4_999_999, 5_000_000, 9_999_999, 10_000_000)]
    assert levels == [1, 2, 2, 3]
    message = curriculum.check_budget(200_000)
    assert "total_frames=200000" in message and "20000000" in message


@pytest.mark.parametrize("group", ["advance", "sample"])
def test_every_leaf_instantiates_in_a_composition(group):
    files = sorted((CONF / "curriculum" / group).glob("*.yaml"))
    expected = {
        "advance": Advance,
        "sample": (Current, Uniform, Recent),
    }
    kinds = set()
    for file in files:
        curriculum = load("curriculum=none", f"curriculum/{group}={file.stem}")
        part = getattr(curriculum, group)
        assert isinstance(part, expected[group])
        kinds.add(type(part))
        curriculum.setup(1, 5, 1_000_000)
        curriculum.update(torch.tensor([1]), torch.tensor([0.5]), 100)
        assert file.read_text().startswith("# ")
    # Frames twice: evenly divided, and with the paper's 5 million a level.
    assert len(kinds) == len(files) - (group == "advance") == {"advance": 5, "sample": 3}[group]


def test_staged_can_be_given_on_the_command_line():
    curriculum = load(
        "curriculum=none",
        "curriculum/advance=staged",
        "curriculum.advance.stages=[{frames: 10, height: 2}, {frames: 20, height: 4}]",
    )
    curriculum.setup(1, 5, 100)
    assert [play(curriculum, f)["curriculum/level"] for f in (9, 10, 20)] == [1, 2, 4]


def test_a_users_curriculum_is_one_file(tmp_path):
    (tmp_path / "curriculum").mkdir()
    (tmp_path / "curriculum" / "mine.yaml").write_text(
        "defaults: [{advance: plateau}, {sample: uniform}, _self_]\n"
        "_target_: curriculum\n"
        "start_height: 2\n"
        "advance: {patience: 7}\n"
    )
    with initialize_config_dir(str(CONF), version_base=None):
        overrides = [f"hydra.searchpath=[file://{tmp_path}]", "+curriculum=mine"]
        config = compose(overrides=overrides, return_hydra_config=False)
    curriculum = build("curriculum", config.curriculum)
    curriculum.setup(1, 5, 100)
    assert (curriculum.level, curriculum.advance.patience) == (2, 7)
    assert isinstance(curriculum.sample, Uniform)


def test_unknown_key_is_refused():
    with pytest.raises(Exception, match="occupency"):
        load("curriculum=adaptive", "+curriculum.advance.occupency=0.5")
