"""Curricula: every rule on scripted episodes, the state in checkpoints, errors, budgets, and every config."""

import json

import numpy as np
import pytest
import torch
from commands import composed
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import CellSpec
from pickplace.config.registry import build
from pickplace.items.distributions import Kinds
from pickplace.training.curriculum.advance import Advance, Frames, NoAdvance, Plateau, Staged, Threshold
from pickplace.training.curriculum.curriculum import Curriculum
from pickplace.training.curriculum.learning_progress import LearningProgress
from pickplace.training.curriculum.sample import Current, Recent, Uniform
from pickplace.training.curriculum.transform import ToteHeightCurriculum


def make(advance, sample=None, low=1, high=5, total_frames=1000, **heights):
    """A curriculum that is set up."""
    curriculum = Curriculum(advance, sample or Current(), **heights)
    curriculum.setup(CellSpec(tote_size=(6, 6, high)), Kinds([(1, 1, low)]), total_frames)
    return curriculum


def play(curriculum, frames, occupancy=(), height=None):
    """One batch whose episodes all had one height, by default the level; returns the logs without their prefix."""
    height = curriculum.level if height is None else height
    occupancy = torch.tensor(occupancy, dtype=torch.float32)
    logs = curriculum.update(torch.full(occupancy.shape, height), occupancy, frames)
    return {key.removeprefix("curriculum/"): value for key, value in logs.items()}


def each(count, *occupancies):
    """Batches of ``count`` episodes of these occupancies, 10 frames apart."""
    return [(10 * i, [occupancy] * count) for i, occupancy in enumerate(occupancies)]


def frames_only(*frames):
    return [(frame, []) for frame in frames]


STAGES = [{"frames": 100, "height": 3}, {"frames": 250, "height": None}]
# Rule, heights, batches (frames, occupancies at the level), levels after each.
SCRIPTS = {
    "frames: on schedule, and no higher than the end":
        (Frames(100), {}, frames_only(*range(40, 600, 40)), [1, 1, 2, 2, 3, 3, 3, 4, 4, 5, 5, 5, 5, 5]),
    "frames: null divides the budget evenly":
        (Frames(), {}, frames_only(199, 200, 400, 600, 799, 800), [1, 2, 3, 4, 4, 5]),
    "threshold: a full window, good enough, which then starts over":
        (Threshold(0.8, 4), {}, [(1, [1.0] * 3), (2, [0.1]), (3, [0.5, 0.9]), (4, [0.9] * 8), (5, [0.9] * 3),
                                 (6, [0.9])], [1, 1, 1, 2, 2, 3]),
    "threshold: 0.9 as a float32 lies below 0.9": (Threshold(0.9, 3), {}, [(10, [0.9] * 3)], [2]),
    "threshold: after max_frames, counted from the batch in which the level began":
        (Threshold(1.0, 4, max_frames_per_level=100), {}, [(f, [0.1]) for f in range(30, 340, 30)],
         [1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3]),
    "threshold: demotes, but not below the start":
        (Threshold(0.8, 4, demote_below=0.3), {}, each(4, 0.9, 0.9, 0.3, 0.29, 0.29, 0.29, 0.9), [2, 3, 3, 2, 1, 1, 2]),
    "threshold: demotes from the last level after its most frames":
        (Threshold(0.8, 2, 30, demote_below=0.3), {"high": 2},
         [(10, [0.5] * 2), (40, [0.5] * 2), (80, [0.5] * 2), (120, [0.1] * 2), (125, [0.5] * 2)], [1, 2, 2, 1, 1]),
    "threshold: demotes by a full window only":
        (Threshold(0.8, 4, demote_below=0.3), {}, [(10, [0.9] * 4), (20, [0.0] * 3), (30, [0.0])], [2, 2, 1]),
    "plateau: after windows without improvement":  # best: 0.3, 0.5, -, 0.62 (0.5 + 0.12), -, -
        (Plateau(2, 2, 0.1), {}, each(2, 0.3, 0.5, 0.55, 0.62, 0.65, 0.71), [1, 1, 1, 1, 1, 2]),
    "plateau: windows do not overlap": (Plateau(4, 1), {}, each(1, *[0.5] * 8), [1] * 7 + [2]),
    "plateau: an equal window is no improvement": (Plateau(2, 1, 0.0), {}, each(2, 0.5, 0.5), [1, 2]),
    "plateau: stays at the end": (Plateau(2, 1), {"start_height": 4}, each(2, *[0.5] * 4), [4, 5, 5, 5]),
    "staged: at its frames":
        (Staged(STAGES), {"start_height": 2}, frames_only(99, 100, 249, 250, 10**9), [2, 3, 3, 5, 5]),
    "staged: from frame 0, and down":
        (Staged([{"frames": 0, "height": 4}, {"frames": 10, "height": 2}]), {}, frames_only(0, 10), [4, 2]),
    "none: the last height": (NoAdvance(), {}, [(10, [0.0] * 500)], [5]),
}  # fmt: skip


def test_a_level_without_a_finished_episode_is_warned_of(caplog):
    curriculum = make(Frames(100))
    play(curriculum, 90, [0.5])
    play(curriculum, 100)
    assert (curriculum.level, caplog.text) == (2, "")
    play(curriculum, 200, [0.5], height=1)
    assert curriculum.level == 3 and "no episode at tote height 2 has ended" in caplog.text


@pytest.mark.parametrize("name", SCRIPTS)
def test_levels_follow_the_rule(name):
    rule, heights, batches, levels = SCRIPTS[name]
    curriculum = make(rule, **heights)
    assert [play(curriculum, *batch)["level"] for batch in batches] == levels


def test_even_shares_survive_a_longer_budget():
    curriculum, longer = make(Frames(), total_frames=1000), make(Frames(), total_frames=2000)
    for frames in (200, 400, 600, 800):
        play(curriculum, frames)
    longer.load_state_dict(curriculum.state_dict())
    assert play(longer, 801)["level"] == 5  # its schedule says 3, but a level does not go down


def test_logs_are_of_the_tally_that_the_rule_decided_on():
    curriculum = make(Threshold(0.8, 4))
    assert play(curriculum, 10, [1.0, 0.1, 0.5, 0.9])["occupancy"] == pytest.approx(0.625)
    logs = play(curriculum, 40, [0.9, 0.9, 0.9])
    assert (logs["level"], logs["episodes"], logs["frames_at_level"]) == (2, 7, 40)
    logs = play(curriculum, 50, [0.9] * 3)
    assert (logs["episodes"], logs["frames_at_level"]) == (3, 10)
    curriculum = make(Plateau(2, 2, 0.1))
    logs = [play(curriculum, *batch) for batch in each(2, 0.3, 0.5, 0.55, 0.62, 0.65, 0.71, 0.2)]
    assert [row["stale_windows"] for row in logs] == [0, 0, 1, 0, 1, 2, 0]  # a new level has a new best
    assert logs[5]["best_occupancy"] == pytest.approx(0.62)
    curriculum = make(Frames(10), low=2, high=4)
    assert [play(curriculum, frames)["progress"] for frames in (0, 10, 20)] == [0.0, 0.5, 1.0]
    assert play(make(Frames(10), low=3, high=3), 0)["progress"] == 1.0  # one level only


@pytest.mark.parametrize("height", [2, 4])
@pytest.mark.parametrize("rule", [Threshold(0.8, 4), Plateau(4, 1)])
def test_rules_count_only_episodes_at_the_level(rule, height):
    curriculum = make(rule, start_height=3)
    before = curriculum.state_dict()["advance"]
    logs = play(curriculum, 10, [1.0] * 100, height=height)
    assert (logs["level"], logs["episodes"], logs[f"occupancy_at_{height}"]) == (3, 0, 1.0)
    assert "occupancy" not in logs and curriculum.state_dict()["advance"] == before
    mixed = curriculum.update(torch.tensor([3, height] * 4), torch.tensor([0.1, 1.0] * 4), 20)
    assert mixed["curriculum/occupancy"] == pytest.approx(0.1) and curriculum.level == 3


def test_the_mean_does_not_depend_on_the_order_of_episodes():
    values = torch.rand(400, generator=torch.Generator().manual_seed(0)) ** 16  # of many magnitudes
    orders = (values, values.flip(0), values.sort().values)
    assert len({play(make(Threshold(1.0, 400)), 10, order.tolist())["occupancy"] for order in orders}) == 1


def test_heights_default_to_the_tallest_item_and_the_full_tote():
    assert make(Staged([{"frames": 0, "height": 4}])).level == make(NoAdvance(), high=4).level == 4  # from the first
    for heights, start, end in (({}, 2, 7), ({"start_height": 3, "end_height": 6}, 3, 6)):
        curriculum = make(Frames(10), low=2, high=7, **heights)
        assert (curriculum.level, curriculum.start, curriculum.end) == (start, start, end)


# --- any episodes, and checkpoints

RULES = {
    "frames": lambda: Frames(7), "even": Frames, "none": NoAdvance, "plateau": lambda: Plateau(2, 2, 0.05),
    "threshold": lambda: Threshold(0.6, 3, max_frames_per_level=40, demote_below=0.3),
    "staged": lambda: Staged([{"frames": 20, "height": 5}, {"frames": 60, "height": 2}]),
    "learning progress": lambda: LearningProgress(window=4, explore=0.3),
}  # fmt: skip
EPISODES = st.lists(st.tuples(st.integers(2, 5), st.floats(0, 1, width=32)), max_size=6)  # heights, occupancies
BATCHES = st.lists(st.tuples(st.integers(1, 30), EPISODES), max_size=30)  # frames, episodes


def run(curriculum, batches, frames=0):
    """Return the logs after each batch, and the frames played; half of the episodes are at the level."""
    history = []
    for new, episodes in batches:
        frames += max(new, len(episodes))  # an episode takes a frame at least
        heights = [curriculum.level if i % 2 else height for i, (height, _) in enumerate(episodes)]
        occupancy = torch.tensor([o for _, o in episodes], dtype=torch.float32)
        history.append(curriculum.update(torch.tensor(heights, dtype=torch.int64), occupancy, frames))
    return history, frames


@pytest.mark.parametrize("rule", RULES)
@settings(max_examples=20)
@given(batches=BATCHES, more=BATCHES, low=st.integers(1, 2), high=st.integers(5, 7))
def test_levels_stay_in_range_and_a_state_continues_exactly(rule, batches, more, low, high):
    straight, resumed = make(RULES[rule](), low=low, high=high), make(RULES[rule](), low=low, high=high)
    levels = [straight.level]
    history, frames = run(straight, batches)
    state = straight.state_dict()
    saved = json.dumps(state, allow_nan=False)
    rest, _ = run(straight, more, frames)
    assert json.dumps(state) == saved  # a copy
    resumed.load_state_dict(json.loads(saved))
    assert run(resumed, more, frames)[0] == rest and resumed.state_dict() == straight.state_dict()
    levels += [logs["curriculum/level"] for logs in history + rest]
    assert all(low <= level <= high for level in levels)
    if rule not in ("staged", "learning progress"):
        assert all(abs(after - before) <= 1 for before, after in zip(levels, levels[1:], strict=False))


# --- errors


class Own(Advance):
    """A user's rule that returns what it is given."""

    state_keys = ("seen",)

    def __init__(self, level, seen=0, logs=()):
        self.level, self.seen, self.logs = level, seen, logs if logs is None else dict(logs)

    def update(self, tally):
        return self.level, self.logs


class Weighted(NoAdvance):
    """A user's rule that draws by given weights."""

    def __init__(self, *weights):
        self.given = [*weights]

    def weights(self):
        return self.given


class Forgetful(Own):
    def update(self, tally):
        self.seen = None
        return super().update(tally)


class Misspelt(Own):
    state_keys = ("sean",)


NONE, STAGE = NoAdvance(), {"frames": 5, "height": 2}
ERRORS = [
    (lambda: make(NONE, start_height=9), "curriculum.start_height=9: .* >= 1 and <= 5"),
    (lambda: make(NONE, start_height=1, low=2), "curriculum.start_height=1: .* >= 2"),
    (lambda: make(NONE, end_height=6), "curriculum.end_height=6: .* <= 5"),
    (lambda: make(NONE, start_height=4, end_height=3), "curriculum.start_height=4: .* <= 3"),
    (lambda: make(NONE, total_frames=0), "total_frames=0: "),
    (lambda: Frames(0), "curriculum.advance.frames_per_level=0: "),
    (lambda: Threshold(1.5, 10), "curriculum.advance.occupancy=1.5: .* between 0 and 1"),
    (lambda: Threshold(0.5, 0), "curriculum.advance.window=0: "),
    (lambda: Threshold(0.5, 10, max_frames_per_level=-1), "curriculum.advance.max_frames_per_level=-1: "),
    (lambda: Threshold(0.5, 10, demote_below=0.5), "curriculum.advance.demote_below=0.5: .*0.5"),
    (lambda: Plateau(10, True), "curriculum.advance.patience=True: "),
    (lambda: Plateau(10, 3, -0.1), "curriculum.advance.min_improvement=-0.1: "),
    (lambda: Staged([]), r"curriculum.advance.stages=\[\]: "),
    (lambda: Staged([{"frames": 1}]), r"curriculum.advance.stages=\[{'frames': 1}\]: "),
    (lambda: Staged([STAGE] * 2), "curriculum.advance.stages: frames=5: .* >= 6"),
    (lambda: make(Staged([STAGE | {"height": 9}])), "curriculum.advance.stages: level=9: .* <= 5"),
    (
        lambda: Curriculum(Staged([STAGE]), Current(), levels=[{}]),
        "curriculum.advance.stages: height: expected level, a number, where curriculum.levels lists",
    ),
    (lambda: Recent(1.0), "curriculum.sample.share=1.0: expected a number below 1"),
    # States of another run; for damaged ones see test_resume.
    (lambda: make(Frames(1)).load_state_dict(make(Plateau(2, 2)).state_dict()), "advance='Frames': expected .*'best'"),
    (
        lambda: make(NONE).load_state_dict(make(NONE, high=9).state_dict()),
        "of the checkpoint=9: expected .* <= 5",
    ),
    (lambda: make(NONE).load_state_dict({"level": 1}), "the checkpoint's curriculum=.* saved"),
    # A user's rule.
    (lambda: play(make(Own(1.5)), 10), "advance: Own: its level=1.5: expected a whole number"),
    (lambda: play(make(Own(1, logs={"level": 7})), 10), "Own: it logs level, which the curriculum logs itself"),
    (lambda: play(make(Own(1, logs={"occupancy_at_9": 7})), 10), "Own: it logs occupancy_at_9, which the curriculum"),
    (lambda: play(make(Own(1, logs={"mood": "good"})), 10), "Own: it logs mood='good': expected a number"),
    (lambda: make(Own(1, torch.tensor(1))), r"Own: its state has seen=tensor\(1\): expected what JSON holds"),
    (lambda: make(Own(1, float("nan"))), "Own: its state has seen=nan"),
    (lambda: play(make(Forgetful(1)), 10), "Forgetful: its state has seen=None: expected a number, as at the start"),
    (lambda: make(Misspelt(1)), "Misspelt: state_keys='sean': expected the name of an attribute"),
    (lambda: play(make(Own(1, logs=None)), 10), r"Own: its update=\(1, None\): expected \(level, "),
    *(
        (lambda given=given: make(Weighted(*given)), "Weighted: its weights=.*: expected 5 numbers >= 0")
        for given in ([1], [0] * 5, [1, 1, 1, 1, -1], [1, 1, 1, 1, "a"], [1, 1, 1, 1, float("nan")])
    ),
]


@pytest.mark.parametrize(("call", "message"), ERRORS)
def test_errors_name_what_is_wrong(call, message):
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert str(error.value).endswith(".") and "\n" not in str(error.value)


@pytest.mark.parametrize(("wanted", "level"), [(9, 4), (4, 4), (-3, 2), (np.int64(3), 3)])
def test_a_level_beyond_the_heights_becomes_the_nearest(wanted, level):
    curriculum = make(Own(wanted), low=2, high=4)
    assert play(curriculum, 10)["level"] == json.loads(json.dumps(curriculum.state_dict()))["level"] == level


# --- budgets


BUDGETS = [  # rule, occupancies of a frame's episodes, frames that reach and train the last height
    (Frames(10), [], 41),  # 4 steps of 10 frames, then one frame at the last height
    (Threshold(0.5, 4), [1.0], 17),
    (Threshold(0.5, 50, max_frames_per_level=10), [], 41),
    (Plateau(2, 2), [0.0], 17),
    (Staged([{"frames": 30, "height": 3}, {"frames": 70, "height": 5}]), [], 71),
    (NoAdvance(), [], 1),
]


@pytest.mark.parametrize("batch", [1, 3, 50])
@pytest.mark.parametrize(("rule", "occupancy", "enough"), BUDGETS)
def test_a_budget_is_refused_if_the_last_height_is_not_reached(batch, rule, occupancy, enough):
    """Always if it is refused; with batches of one frame, one frame more reaches it."""
    curriculum, frames = make(rule), 0
    while message := curriculum.check_budget(frames + 1, batch):
        assert message.startswith(f"total_frames={frames + 1}: ") and "more than" in message and curriculum.level < 5
        frames += batch
        play(curriculum, frames, occupancy * batch)
    assert batch > 1 or (curriculum.level, frames + 1) == (5, enough)


def test_budgets_without_a_last_height():
    assert make(Frames(), total_frames=1000).check_budget(1000) is None  # even shares always fit
    assert "a stage of that level" in make(Staged([{"frames": 5, "height": 3}])).check_budget(10**9)
    assert "expected more than 300 frames" in make(Staged(STAGES)).check_budget(300, batch=100)  # it rises after them
    assert make(Staged(STAGES)).check_budget(301, batch=100) is None
    lower = make(NoAdvance(), end_height=3).check_budget(1000)
    assert "curriculum.end_height=3: the last level is not the full task, which validation" in lower


def test_settings_that_decide_nothing_are_named():
    levels = [{"tote_height": 2}, {}]
    (ignored,) = make(NoAdvance(), levels=levels).unused_settings()
    assert ignored == "curriculum.levels: NoAdvance plays the last level only; expected another curriculum/advance."
    (ignored,) = make(NoAdvance(), start_height=2).unused_settings()
    assert ignored.startswith("curriculum.start_height: NoAdvance plays the last level only")
    (ignored,) = make(LearningProgress(), Uniform()).unused_settings()
    assert ignored.startswith("curriculum.sample: Uniform is not used while the weights of LearningProgress draw")
    for used in (make(NoAdvance(), Uniform(), levels=levels), make(Frames(9), levels=levels), make(LearningProgress())):
        assert used.unused_settings() == []


# --- weights


@pytest.mark.parametrize("scale", [1, 1e300, 1e-300])
def test_weights_of_a_users_rule_may_be_any_numbers(scale):
    curriculum = make(Weighted(0, scale, 0, 3 * scale, 0))
    drawn = ToteHeightCurriculum(1, Current(), curriculum.levels, curriculum.weights)._draw(100)
    assert drawn.unique().tolist() == [2, 4]


def test_levels_are_drawn_by_how_much_their_occupancy_has_changed():
    curriculum = make(LearningProgress(window=4, explore=0.5), low=1, high=3)
    assert curriculum.weights == pytest.approx([1 / 3] * 3)  # nothing is known yet
    play(curriculum, 10, [0.1, 0.1, 0.5, 0.7], height=1)  # +0.5
    assert curriculum.weights == pytest.approx([1 / 3] * 3)  # the others may be as promising
    play(curriculum, 20, [0.8] * 9, height=2)  # mastered
    logs = play(curriculum, 30, [0.4, 0.4, 0.3, 0.3], height=3)  # -0.1: forgotten
    assert logs["learning_progress"] == pytest.approx(0.5) and logs["level"] == 1
    assert curriculum.weights == pytest.approx([1 / 6 + 0.5 * share for share in (5 / 6, 0, 1 / 6)])
    play(curriculum, 40, [0.7, 0.7], height=1)  # of the latest four now +0.1
    assert curriculum.weights == pytest.approx([1 / 6 + 0.5 * share for share in (0.5, 0, 0.5)])


@pytest.mark.parametrize("histories", [[], [[0.5]], [[0.5], [2.0], [], [], []], [[], [], [], [], "x"], 1, [0.1] * 5])
def test_a_damaged_history_is_refused(histories):
    curriculum = make(LearningProgress(window=4))
    state = curriculum.state_dict()
    with pytest.raises(ValueError, match="curriculum histories of the checkpoint"):
        curriculum.load_state_dict(state | {"advance": {"histories": histories}})


def test_a_resumed_run_may_have_a_shorter_window():
    before, after = make(LearningProgress(window=6), high=2), make(LearningProgress(window=4), high=2)
    play(before, 10, [0.9, 0.9, 0.1, 0.2, 0.3, 0.4], height=1)
    after.load_state_dict(before.state_dict())
    assert after.state_dict()["advance"]["histories"] == [pytest.approx([0.1, 0.2, 0.3, 0.4]), []]


# --- configs


COMPOSITIONS = [  # first level, episodes until the last one
    ("none", 5, [0]),
    ("paper", 1, [40_000]),  # 5 million frames a level
    ("adaptive", 1, [1600]),
    ("mixture", 1, range(1841, 2260)),  # a quarter does not count, but at the first level
]


@pytest.mark.parametrize(("name", "first", "episodes"), COMPOSITIONS)
def test_compositions_reach_full_height(name, first, episodes):
    """With an ideal policy, 20 episodes and 10,000 frames a batch: levels in order, none skipped."""
    curriculum = build("curriculum", composed(f"curriculum={name}").curriculum)
    curriculum.setup(CellSpec(), Kinds([(1, 1, 1)]), 25_000_000)
    assert curriculum.check_budget(25_000_000) is None
    torch.manual_seed(0)
    seen, frames = [curriculum.level], 0
    while curriculum.level < 5 and frames < 25_000_000:
        frames += 10_000
        heights = curriculum.sample(curriculum.level, curriculum.start, 20)
        level = curriculum.update(heights, torch.full((20,), 0.95), frames)["curriculum/level"]
        seen += [level] if level != seen[-1] else []
    assert seen == [*range(first, 6)] and frames // 500 in episodes
