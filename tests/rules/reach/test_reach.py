"""The robot's reach: an annulus against plane geometry with fractions, tables row by row, and what is refused."""

from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import problems, state_of

from pickplace import CellSpec, Failure
from pickplace.rules.checks import is_within_reach
from pickplace.rules.grasps import split_action
from pickplace.rules.masks import action_mask, footprint_mask, num_feasible, placing_maps
from pickplace.rules.reach.annulus import Annulus
from pickplace.rules.reach.table import ReachTable
from pickplace.rules.step import apply

HEADER = "where,x,y,rotation,lowest,highest\n"


def tenths(least, most):
    return st.integers(least, most).map(lambda value: value / 10)


@st.composite
def annuli(draw):
    """An annulus about a base near bin and tote, which reaches much of them; all lengths are decimal fractions."""
    radii = draw(tenths(0, 20)), draw(tenths(20, 90))
    lowest = draw(tenths(-10, 25))
    heights = lowest, round(lowest + draw(tenths(0, 40)), 1)
    bin, tote = ([draw(tenths(-50, 20)), draw(tenths(-30, 10)), draw(tenths(-15, 15))] for _ in range(2))
    return Annulus(radii, heights, bin, tote)


def exact(value):
    return Fraction(str(value))


def is_reached(reach, corner, unit, cell, sides, face):
    """Whether the centre of a rectangle of ``sides``, whose reference cell is at ``cell``, may be at this height."""
    centre = []
    for at, side, start in zip(cell, sides, corner, strict=False):
        covered = range(at - (side - 1) // 2, at - (side - 1) // 2 + side)
        centre.append(exact(start) + Fraction(covered[0] + covered[-1] + 1, 2))
    distance = centre[0] ** 2 + centre[1] ** 2
    height = exact(corner[2]) + face * exact(unit)
    return exact(reach.radii[0]) ** 2 <= distance <= exact(reach.radii[1]) ** 2 and exact(
        reach.heights[0]
    ) <= height <= exact(reach.heights[1])


@settings(max_examples=60)
@given(problems(count=1), annuli(), st.sampled_from([1.0, 0.1, 0.3, 0.5, 2.5]))
def test_an_annulus_is_the_geometry_in_step_and_masks(problem, reach, unit):
    """Reach is judged last. What else fails, fails as before; what succeeded is out of reach, or succeeds."""
    free, cases = replace(problem[0], height_unit=unit), problem[1]
    cell = replace(free, reach=reach)
    state, actions = state_of(*cases), torch.arange(cell.num_actions)
    before = apply(free, state.repeat(len(actions)), actions)
    expected = []
    for failure, top, *action in zip(
        before.failure.tolist(), before.top.tolist(),
        *(part.tolist() for part in split_action(cell, actions)), strict=True,
    ):  # fmt: skip
        pick, place, rotation = action[:2], action[2:4], action[4]
        w, d = cell.gripper.size
        sides = (d, w) if rotation in (1, 3) else (w, d)
        good = is_reached(reach, reach.bin, unit, pick, (w, d), cases[0].item[4])
        good = good and is_reached(reach, reach.tote, unit, place, sides, top)
        expected.append(failure if failure or good else int(Failure.OUT_OF_REACH))
    assert apply(cell, state.repeat(len(actions)), actions).failure.tolist() == expected
    maps = placing_maps(cell, state)
    mask = torch.tensor(expected) == 0
    assert torch.equal(action_mask(cell, maps)[0], mask)
    assert int(num_feasible(cell, maps)) == int(mask.sum()) and bool(footprint_mask(cell, maps).any()) == any(mask)


@settings(max_examples=60)
@given(problems(count=1), annuli(), st.sampled_from([1.0, 0.1, 0.3, 0.02]))
def test_the_tables_of_an_annulus(problem, reach, unit):
    """Every pick cell, place cell, rotation and height: also the boundaries, on which decimal fractions often lie."""
    cell = replace(problem[0], height_unit=unit, reach=reach)
    limits, (w, d) = cell.limits, cell.gripper.size
    tops = sorted({0, 1, 2, 3, *(round(h / unit) + at for h in reach.heights for at in range(-3, 3))} - {-3, -2, -1})
    for face in (top for top in tops if top >= 0):
        picks = limits.pick_ok & is_within_reach(limits.lowest_pick, limits.highest_pick, torch.tensor(face))
        picks = picks.view(cell.bin_size[:2])
        for x, y in torch.cartesian_prod(*map(torch.arange, cell.bin_size[:2])).view(-1, 2).tolist():
            assert picks[x, y] == is_reached(reach, reach.bin, unit, (x, y), (w, d), face)
        places = is_within_reach(limits.lowest_top, limits.highest_top, torch.tensor(face))
        for rotation in range(cell.rotations):
            sides = (d, w) if rotation % 2 else (w, d)
            for x, y in torch.cartesian_prod(*map(torch.arange, cell.tote_size[:2])).view(-1, 2).tolist():
                assert places[rotation, x, y] == is_reached(reach, reach.tote, unit, (x, y), sides, face)


def test_a_distance_that_is_exactly_a_radius_is_reached():
    """Sides of Pythagorean triangles in decimal fractions, whose hypotenuse is a radius."""
    for a, b, c in ((3, 4, 5), (5, 12, 13), (8, 15, 17), (7, 24, 25), (20, 21, 29)):
        for scale in (0.1, 0.3, 0.7, 1.1):
            for off, reached in ((0, True), (0.01, False)):
                corner = [a * scale - 0.5, b * scale - 0.5, 0]
                reach = [Annulus([least, most], [0, 9], corner, corner) for least, most in (
                    (c * scale + off, 99), (0, c * scale - off), (c * scale + off, c * scale + off)
                )]  # fmt: skip
                for one in reach:
                    limits = CellSpec((1, 1, 1), (1, 1, 5), effector_size=(1, 1), rotations=1, reach=one).limits
                    assert bool(limits.pick_ok) == (int(limits.highest_top) >= 0) == reached


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"radii": [2, 1]}, r"reach.radii=\[2.0, 1.0\]: expected \[least, greatest\] with 0 <= least <= greatest"),
        ({"radii": [-1, 1]}, r"reach.radii=\[-1.0, 1.0\]: expected"),
        ({"radii": 5}, "reach.radii=5: expected"),
        ({"radii": [1, "far"]}, r"reach.radii=\[1, 'far'\]"),
        ({"radii": [1, float("inf")]}, r"reach.radii=\[1, inf\]"),
        ({"heights": [1, 0]}, r"reach.heights=\[1.0, 0.0\]: expected \[lowest, highest\]"),
        ({"heights": None}, "reach.heights=None"),
        ({"bin": [0, 0]}, r"reach.bin=\[0, 0\]: expected \[x, y, z\], up to 100,000 sides of a cell"),
        ({"tote": [0, 0, 1e9]}, r"reach.tote=\[0, 0, 1000000000.0\]"),
    ],
)
def test_a_bad_annulus_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Annulus(**{"radii": [1, 2], "heights": [0, 1], "bin": [0, 0, 0], "tote": [0, 0, 0], **values})


@pytest.fixture
def table(tmp_path):
    """Make the reach of a CSV file, given as its text."""

    def make(text, name="reach.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return ReachTable(str(path))

    return make


def test_a_table_says_which_poses_are_reached(table):
    """Poses that are not listed are out of reach. Heights are in sides of a cell, which is two height units here."""
    rows = "\ufeff" + HEADER + "bin,1,2,,,\nbin,0,0,,0.4,1.2\n\ntote,2,1,3,1,2.9\ntote, 0 ,0,0,,\ntote,0,0,1,,0\n"
    cell = CellSpec((2, 3, 1), (4, 3, 5), rotations=4, height_unit=0.5, reach=table(rows))
    limits, any_height = cell.limits, 2**20
    assert limits.pick_ok.nonzero()[:, 0].tolist() == [0, 5]
    assert (limits.lowest_pick[[0, 5]].tolist(), limits.highest_pick[[0, 5]].tolist()) == ([1, 0], [2, any_height])
    reached = (limits.lowest_top <= limits.highest_top).nonzero().tolist()
    assert reached == [[0, 0, 0], [1, 0, 0], [3, 2, 1]]
    assert (int(limits.lowest_top[3, 2, 1]), int(limits.highest_top[3, 2, 1])) == (2, 5)
    assert (int(limits.highest_top[0, 0, 0]), int(limits.highest_top[1, 0, 0])) == (any_height, 0)
    assert replace(cell, rotations=2).limits.lowest_top.shape == (2, 4, 3)  # the other rows are of no use
    with pytest.raises(ValueError, match=r"reach.csv, line 5: x=2, y=1 is not in the tote; expected one of its 2x3"):
        replace(cell, tote_size=(2, 3, 5))


def test_tables_are_compared_by_content(table):
    rows = "bin,1,2,,,\ntote,0,0,0,0,1.50\n", "tote,0,0,0,,1.5\nbin,1,2,,,\n", "bin,1,2,,,\ntote,0,0,0,,1\n"
    a, b, c = (table(HEADER + text, f"{number}.csv") for number, text in enumerate(rows))
    assert a == b != c and hash(a) == hash(b) and "1.csv" in repr(b) and "rows" not in repr(b)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "reach.csv: 0 bytes"),
        (HEADER, "reach.csv: no rows"),
        ("where,x,y\n", "reach.csv: the header is 'where,x,y', expected 'where,x,y,rotation,lowest,highest'"),
        (HEADER.replace("lowest", "low"), "the header is 'where,x,y,rotation,low,highest'"),
        (b"\xff\xfe", "expected a text in UTF-8"),
        (HEADER + "bin,1,2,\n", "line 2: got 'bin,1,2,', expected where,x,y,rotation,lowest,highest"),
        (HEADER + "bin,1,2,,,\nshelf,1,2,,,\n", "line 3: where='shelf': expected bin or tote"),
        (HEADER + "bin,-1,2,,,\n", "line 2: x='-1': expected a cell, a whole number >= 0"),
        (HEADER + "bin,1,1.5,,,\n", "line 2: y='1.5'"),
        (HEADER + "bin,1,2,0,,\n", "line 2: rotation='0': expected nothing in the bin"),
        (HEADER + "tote,1,2,,,\n", "line 2: rotation='': expected 0, 1, 2 or 3 quarter turns"),
        (HEADER + "tote,1,2,90,,\n", "line 2: rotation='90'"),
        (HEADER + "tote,1,2,0,low,\n", "line 2: lowest='low': expected a height in sides of a cell, or nothing"),
        (HEADER + "tote,1,2,0,nan,\n", "line 2: lowest='nan'"),
        (HEADER + "tote,1,2,0,,inf\n", "line 2: highest='inf'"),
        (HEADER + "tote,1,2,0,2,1\n", "line 2: highest='1': expected at least lowest=2"),
        (HEADER + "tote,1,2,0,,\n\ntote,1,2,0,1,2\n", "line 4: got 'tote,1,2,0,1,2', the same pose as in line 2"),
    ],
)
def test_a_bad_table_is_refused(table, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        table(text)
    assert "\n" not in str(caught.value)


def test_a_missing_table_is_refused():
    with pytest.raises(ValueError, match="reach.path='missing.csv': no such file; expected a CSV with columns where,x"):
        ReachTable("missing.csv")
