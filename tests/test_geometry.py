"""What must hold of any packing problem, whatever its sizes: symmetries, and what a success may change."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import Rules
from pickplace.task.geometry import Item

SIDES, ODD = st.integers(1, 4), st.sampled_from([1, 3])


@st.composite
def problems(draw, effector_sides=SIDES, rotations=(1, 2, 3, 4)):
    """Rules, the height of the tote, the heights in it, and an item in the bin: ``(rules, rim, heights, item)``."""
    effector = draw(effector_sides), draw(effector_sides)
    bin_size = draw(st.integers(2, 5)), draw(st.integers(2, 5)), draw(st.integers(1, 3))
    tote_size = draw(st.integers(2, 6)), draw(st.integers(2, 6)), 6
    rules = Rules(
        bin_size, tote_size, effector, draw(st.sampled_from(rotations)), draw(st.sampled_from(["contain", "overlap"])),
        draw(st.sampled_from([0.0, 0.5, 0.75, 1.0])), draw(st.booleans()),
    )  # fmt: skip
    longest = min(*effector, *bin_size[:2]) if rules.pick_rule == "contain" else min(bin_size[:2])
    w, d, h = draw(st.integers(1, longest)), draw(st.integers(1, longest)), draw(st.integers(1, 3))
    item = draw(st.integers(0, bin_size[0] - w)), draw(st.integers(0, bin_size[1] - d)), w, d, h
    rim = draw(st.integers(1, 6))
    levels = draw(st.lists(st.integers(0, rim), min_size=1, max_size=3))
    heights = np.random.default_rng(draw(st.integers(0, 999))).choice(levels, size=tote_size[:2])
    return rules, rim, heights, item


def outcomes(rules, rim, heights, item):
    """Failure codes ``[W_B, D_B, W_T, D_T, R]`` and the heights after each action ``[.., W_T, D_T]``."""
    count = rules.num_actions
    many = torch.tensor(heights.copy(), dtype=torch.int32).expand(count, -1, -1)
    picked = Item(*(torch.full((count,), value) for value in item))
    step = rules.apply(many, torch.full((count,), rim), picked, torch.arange(count))
    grid = (*rules.bin_size[:2], *rules.tote_size[:2], rules.rotations)
    return step.failure.reshape(grid).numpy(), step.heights.reshape(*grid, *rules.tote_size[:2]).numpy()


@settings(max_examples=80)
@given(problems())
def test_a_success_adds_the_item_and_a_failure_nothing(problem):
    rules, rim, heights, item = problem
    failure, after = outcomes(*problem)
    rise = after - heights
    assert (rise[failure != 0] == 0).all()
    assert (rise >= 0).all() and (after <= max(rim, heights.max())).all()
    good = rise[failure == 0]
    w, d, h = item[2:]
    assert ((good > 0).sum((1, 2)) == w * d).all()  # what lies under the item is not raised anywhere else
    assert (good.sum((1, 2)) >= w * d * h).all()
    shown = Item(*(torch.tensor([value]) for value in item))
    tote = torch.tensor(heights, dtype=torch.int32)[None]
    mask = rules.action_mask(rules.placements(tote, torch.tensor([rim]), shown))
    assert ((failure == 0).ravel() == mask[0].numpy()).all()


@settings(max_examples=50)
@given(problems(), st.integers(1, 1000))
def test_raising_the_floor_and_the_rim_changes_nothing(problem, by):
    rules, rim, heights, item = problem
    failure, after = outcomes(*problem)
    raised, above = outcomes(rules, rim + by, heights + by, item)
    assert (failure == raised).all() and (after + by == above).all()


@settings(max_examples=50)
@given(problems(effector_sides=ODD, rotations=(1, 4)))
def test_a_mirrored_problem_has_the_mirrored_outcomes(problem):
    """The mirror turns clockwise into counter-clockwise. Odd effectors: an even one's reference is off its centre."""
    rules, rim, heights, (x, y, w, d, h) = problem
    failure, after = outcomes(*problem)
    flipped, seen = outcomes(rules, rim, heights[::-1], (rules.bin_size[0] - x - w, y, w, d, h))
    backwards = [-rotation % 4 for rotation in range(rules.rotations)]
    assert (failure == flipped[::-1, :, ::-1][..., backwards]).all()
    assert (after == seen[::-1, :, ::-1][..., backwards, ::-1, :]).all()


def quarter(problem):
    """The whole cell seen from the side: bin, tote, end effector and item turned counter-clockwise."""
    rules, rim, heights, (x, y, w, d, h) = problem
    (bin_w, bin_d, wall), (tote_w, tote_d, top), (ee_w, ee_d) = rules.bin_size, rules.tote_size, rules.effector_size
    turned = Rules(
        (bin_d, bin_w, wall), (tote_d, tote_w, top), (ee_d, ee_w),
        rules.rotations, rules.pick_rule, rules.min_support, rules.strict_support,
    )  # fmt: skip
    return turned, rim, np.rot90(heights), (bin_d - y - d, x, d, w, h)


@settings(max_examples=50)
@given(problems(effector_sides=ODD))
def test_a_turned_problem_has_the_turned_outcomes_and_four_turns_are_none(problem):
    failure, after = outcomes(*problem)
    there, landed = outcomes(*quarter(problem))
    assert (np.rot90(np.rot90(failure, axes=(0, 1)), axes=(2, 3)) == there).all()
    assert (np.rot90(np.rot90(np.rot90(after, axes=(0, 1)), axes=(2, 3)), axes=(5, 6)) == landed).all()
    again = quarter(quarter(quarter(quarter(problem))))
    assert again[0] == problem[0] and again[3] == problem[3] and (again[2] == problem[2]).all()
