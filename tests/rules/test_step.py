"""Symmetries that any packing problem has, whatever its sizes; and the oracle itself."""

from dataclasses import replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import Oracle, Rules, rotate
from problems import Case, problems, state_of

from pickplace import CellSpec
from pickplace.rules.step import apply

ODD = st.sampled_from([1, 3])


def results(cell, case):
    """Return failure codes ``[W_B, D_B, W_T, D_T, R]``, and the heights after each action, ``[.., W_T, D_T]``."""
    step = apply(cell, state_of(case).repeat(cell.num_actions), torch.arange(cell.num_actions))
    grid = (*cell.bin_size[:2], *cell.tote_size[:2], cell.rotations)
    return step.failure.reshape(grid).numpy(), (step.surface >> 1).reshape(*grid, *cell.tote_size[:2]).numpy()


@settings(max_examples=50)
@given(problems(), st.integers(1, 1000))
def test_raising_the_floor_and_the_rim_changes_nothing(problem, by):
    cell, (case,) = problem
    failure, after = results(cell, case)
    raised, above = results(cell, case._replace(rim=case.rim + by, heights=case.heights + by))
    assert (failure == raised).all() and (after + by == above).all()


@settings(max_examples=50)
@given(problems(effector_sides=ODD, rotations=(1, 4)))
def test_a_mirrored_problem_has_the_mirrored_results(problem):
    """The mirror turns clockwise into counter-clockwise. Odd effectors: an even one's reference is off its centre."""
    cell, (case,) = problem
    failure, after = results(cell, case)
    x, y, w, d, h = case.item
    flipped, seen = results(
        cell, Case(case.rim, case.heights[::-1], case.bearing[::-1], (cell.bin_size[0] - x - w, y, w, d, h))
    )
    backwards = [-rotation % 4 for rotation in range(cell.rotations)]
    assert (failure == flipped[::-1, :, ::-1][..., backwards]).all()
    assert (after == seen[::-1, :, ::-1][..., backwards, ::-1, :]).all()


def quarter(cell, case):
    """Return the whole cell as seen from the side: bin, tote, end effector and item turned counter-clockwise."""
    (bin_w, bin_d, wall), (tote_w, tote_d, top), (ee_w, ee_d) = cell.bin_size, cell.tote_size, cell.gripper.size
    turned = CellSpec(
        (bin_d, bin_w, wall), (tote_d, tote_w, top), replace(cell.gripper, size=(ee_d, ee_w)),
        cell.rotations, cell.support,
    )  # fmt: skip
    x, y, w, d, h = case.item
    return turned, Case(case.rim, np.rot90(case.heights), np.rot90(case.bearing), (bin_d - y - d, x, d, w, h))


@settings(max_examples=50)
@given(problems(effector_sides=ODD))
def test_a_turned_problem_has_the_turned_results(problem):
    cell, (case,) = problem
    failure, after = results(cell, case)
    there, landed = results(*quarter(cell, case))
    assert (np.rot90(np.rot90(failure, axes=(0, 1)), axes=(2, 3)) == there).all()
    assert (np.rot90(np.rot90(np.rot90(after, axes=(0, 1)), axes=(2, 3)), axes=(5, 6)) == landed).all()


@given(*[st.tuples(st.integers(low, 9), st.integers(low, 9)) for low in (1, -9, 1)])
def test_the_rotation_table_is_a_group(effector, offset, size):
    turned = effector, offset, size
    for rotation in range(4):
        assert rotate(rotation, effector, offset, size) == turned
        turned = rotate(1, *turned)
    assert turned == (effector, offset, size)


def test_the_oracle_by_hand():
    """A few cases of the rules worked out on paper, so that the oracle is not its own judge."""
    rules = Rules()
    oracle = Oracle(rules, 5, (2, 1, 1), (0, 0))
    # Reference cell (1, 1): the corner pick puts the effector's corner on the item's.
    assert oracle.try_action(rules.join((1, 1), (1, 1), 0))[1][:3] == [[1] + [0] * 5] * 2 + [[0] * 6]
    # A quarter turn sends offset (0, 0) of a 2x1 item in a 3x3 effector to (2, 0), size 1x2.
    heights = oracle.try_action(rules.join((1, 1), (1, 1), 1))[1]
    assert [(x, y) for x in range(6) for y in range(6) if heights[x][y]] == [(2, 0), (2, 1)]
    # The effector hangs over the tote's wall, above the item's top.
    assert oracle.try_action(rules.join((1, 1), (5, 1), 0))[0] == 3
    assert oracle.try_action(rules.join((3, 3), (1, 1), 0))[0] == 1
    # The bin's walls are level with the item, so the effector may hang over them.
    assert oracle.try_action(rules.join((0, 0), (1, 1), 0))[0] == 0
    deep = Oracle(Rules(bin_size=(5, 5, 2)), 5, (2, 1, 1), (0, 0))
    assert deep.try_action(rules.join((0, 0), (1, 1), 0))[0] == 2
