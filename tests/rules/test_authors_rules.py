"""The stability rules of published code, against plain Python that says the same of a map of heights."""

from fractions import Fraction
from itertools import combinations, product

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pickplace import CellSpec
from pickplace.rules.gripper.rules import Contain
from pickplace.rules.placing import FootprintContact, LargeFootprintContact
from pickplace.rules.state import surface_from
from pickplace.rules.support.rules import Cdrl, Corners, Gopt


def cdrl(under):
    """The rule of Zhao et al., 2021, for an item on these heights, ``under[x][y]``."""
    cells = [height for row in under for height in row]
    corners = [under[x][y] for x, y in product((0, -1), repeat=2)]  # one cell may be several
    highest, share = corners.count(max(corners)), Fraction(cells.count(max(cells)), len(cells))
    carried = max(corners) == max(cells)
    return highest >= 3 and (
        share > Fraction(95, 100)
        or (carried and highest == 3 and share > Fraction(85, 100))
        or (carried and highest == 4 and share > Fraction(1, 2))
    )


def gopt(under):
    """The rule of GOPT; its centre and its middles are those of cells, counted in half cells."""
    w, d, highest = len(under), len(under[0]), max(height for row in under for height in row)
    points = [(2 * x - w + 1, 2 * y - d + 1) for x, y in product(range(w), range(d)) if under[x][y] == highest]
    if 2 * len(points) > w * d:
        return True
    if len(points) == 1:
        return False

    def turn(p, q, r=(0, 0)):
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    if not any(turn(p, q, r) for p, q, r in combinations(points, 3)):  # all on a line
        ends = min(points), max(points)
        return turn(*ends) == 0 and all(min(a, b) <= 0 <= max(a, b) for a, b in zip(*ends, strict=True))
    # Within the hull: on no side of any line through two middles with all middles on its other side.
    for p, q in combinations(points, 2):
        sides = [turn(p, q, r) for r in points]
        if (min(sides) >= 0 > turn(p, q)) or (max(sides) <= 0 < turn(p, q)):
            return False
    return min(y for _, y in points) < 0  # the crossing number leaves the edge of least y outside


RULES = {"cdrl": (Cdrl(), cdrl), "gopt": (Gopt(), gopt)}


def ours(rule, kind, maps, w, d):
    """Whether an item of ``w x d`` cells is stable on the first cells of each map."""
    side = maps.shape[1]
    cell = CellSpec((side, side, 1), (side, side, 9), Contain((side, side)), rotations=1, longest_side=max(w, d))
    sizes = (torch.full((1, 1, 1, len(maps)), size) for size in (w, d))
    return rule.stable(kind(cell, surface_from(maps), *sizes))[0, 0, 0].tolist()


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize(("w", "d"), [(1, 1), (1, 2), (1, 5), (5, 1), (2, 2), (2, 3), (3, 2), (3, 3), (3, 4), (4, 3)])
def test_every_pattern_under_a_small_item(name, w, d):
    """Cells that carry it, as all patterns or, of twelve cells, 4,095 of them; the others one or two lower."""
    rule, plain = RULES[name]
    patterns = torch.tensor([*product((0, 1), repeat=w * d)][1:]).view(-1, w, d)
    lower = torch.arange(w * d).view(w, d) % 2
    maps = torch.where(patterns > 0, 2, lower)
    square = torch.zeros(len(maps), 5, 5, dtype=torch.int64)
    square[:, :w, :d] = maps
    expected = [plain(each.tolist()) for each in maps]
    assert ours(rule, FootprintContact, square, w, d) == expected
    assert w * d < 3 or len({*expected}) == 2


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 30), st.integers(1, 2), st.integers(0, 10**6))
@example(1, 41, 2, 1, 0)  # ends that do not carry it, alike, of more than 40 cells
@example(9, 9, 3, 1, 3)
def test_larger_items(w, d, missing, levels, seed):
    """On cells of which some are lower; also corners, so that three that are level may all be lower."""
    random, side = torch.Generator().manual_seed(seed), max(w, d)
    maps = torch.full((40, side, side), 3)
    for number, each in enumerate(maps):
        places = torch.randperm(w * d, generator=random)[:missing]
        if number % 4 == 0:  # at the corners first
            corners = torch.tensor([0, d - 1, (w - 1) * d, w * d - 1])
            places = torch.cat([corners[torch.randperm(4, generator=random)][:missing], places])[:missing]
        each[places // d, places % d] = torch.randint(0, levels, (len(places),), generator=random)
    for name, (rule, plain) in RULES.items():
        expected = [plain(each[:w, :d].tolist()) for each in maps]
        for kind in (FootprintContact, LargeFootprintContact):
            assert ours(rule, kind, maps, w, d) == expected, name


def test_level_corners_that_do_not_carry_the_item():
    """77 of 81 cells carry it, and no corner does: three that are alike suffice, two do not."""
    maps = torch.full((3, 9, 9), 3)
    for each, corners in zip(maps, [(1, 1, 1, 1), (0, 1, 1, 1), (0, 0, 1, 1)], strict=True):
        each[0, 0], each[0, -1], each[-1, 0], each[-1, -1] = (torch.tensor(corner) for corner in corners)
    for kind in (FootprintContact, LargeFootprintContact):
        assert ours(Cdrl(), kind, maps, 9, 9) == [cdrl(each.tolist()) for each in maps] == [True, True, False]


def test_where_the_code_differs_from_the_text():
    """Of 20 cells 16 and three corners suffice in Zhao's text only, 11 and four corners in the code only."""
    three, four = ["0111", "0111", "0111", "0111", "1111"], ["1001", "0101", "0110", "1001", "1011"]
    maps = torch.zeros(2, 5, 5, dtype=torch.int64)
    maps[:, :, :4] = torch.tensor([[[int(cell) for cell in row] for row in each] for each in (three, four)])
    assert maps.sum((1, 2)).tolist() == [16, 11]
    for rule, expected in ((Corners(), [True, False]), (Cdrl(), [False, True])):
        assert ours(rule, FootprintContact, maps, 5, 4) == expected
