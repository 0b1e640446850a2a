"""Grippers: what they refuse, the cells of discs, the offsets that follow from the cup, and an own grip rule."""

from dataclasses import dataclass, replace

import pytest
import torch

from pickplace import CellSpec
from pickplace.rules.gripper.base import Gripper, reference_cell
from pickplace.rules.gripper.rules import Contain, Overlap, Seal
from pickplace.rules.gripper.shapes import boxes, centred


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(({"size": value}, r"gripper.size=\(.*: expected 2") for value in ((3, -3), (3, 3, 1), (3, 65), (3, 2.5))),
        *(
            (
                {"body": value},
                r"gripper.body=.*: expected 'rectangle', 'disc', or a mask of size=\[3, 3\]: 3 lists of 3",
            )
            for value in ("oval", 3, [[1, 1], [1, 1]], [[1, 1, 2]] * 3, [[1, 1, True]] * 3, [["1"] * 3] * 3, None)
        ),
        *(
            ({"body": value, "cup": value}, "gripper.body=.*: expected a 1 in its first and last list, and first and")
            for value in ([[0, 0, 0], [1, 1, 1], [1, 1, 1]], [[0, 1, 1]] * 3, [[1, 1, 0]] * 3)
        ),
        ({"cup": [[0] * 3] * 3}, "gripper.cup=.*: expected a mask with a 1"),
        ({"cup": [[1] * 3] * 3, "cup_size": [1, 1]}, r"gripper.cup_size=\[1, 1\]: expected null, as cup is a mask"),
        *(
            (
                {"cup_size": value},
                r"gripper.cup_size=.*: expected sides that differ from size=\[3, 3\] by an even number",
            )
            for value in ([2, 3], [5, 5])
        ),
        ({"cup_size": 3}, "gripper.cup_size=3: expected 2 whole numbers"),
        (
            {"body": [[1, 1, 1], [1, 0, 0], [1, 0, 0]]},
            r"gripper.cup='rectangle', .*: cell \(1, 1\) of the cup is not in",
        ),
        ({"size": (7, 7), "body": "disc"}, r"gripper.cup=.*: cell \(0, 0\) of the cup is not in body='disc'"),
        *(
            ({"min_seal": value}, f"gripper.min_seal={value}: expected a number > 0 and <= 1")
            for value in (0, 1.1, True)
        ),
    ],
)
def test_impossible_grippers_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Seal(**settings)


def test_a_disc_touches_these_cells():
    """By hand: the corner cell of 7 is 2.5 * sqrt(2) cells from the centre, beyond 3.5; that of 6 is nearer than 3."""

    def disc(*sides):
        return centred("disc", sides, sides)

    assert [sum(map(sum, disc(side, side))) for side in (1, 2, 3, 6, 7)] == [1, 4, 9, 36, 45]
    assert disc(7, 7)[0] == (0, 1, 1, 1, 1, 1, 0)
    assert disc(8, 4) == ((1, 1, 1, 1),) * 8  # (3 / 4)**2 + (1 / 2)**2 < 1
    assert disc(16, 6)[0] == (0, 1, 1, 1, 1, 0)  # (7 / 8)**2 + (2 / 3)**2 > 1 > (7 / 8)**2 + (1 / 3)**2
    assert Contain((5, 4), cup="disc", cup_size=(3, 2)).cup_mask == ((0,) * 4, *[(0, 1, 1, 0)] * 3, (0,) * 4)


def test_boxes_cover_a_mask_once():
    mask = ((1, 1, 0, 1), (1, 1, 0, 1), (0, 1, 1, 1), (1, 0, 0, 0))
    assert boxes(mask) == ((0, 0, 2, 2), (0, 3, 2, 1), (2, 1, 1, 3), (3, 0, 1, 1))
    assert boxes(((1, 1, 1),) * 4) == ((0, 0, 4, 3),)


def test_sides_and_offsets():
    contain, overlap = CellSpec(effector_size=(2, 4)), CellSpec(effector_size=(2, 4), pick_rule="overlap")
    assert (contain.max_side, contain.min_offset, contain.num_offsets) == (4, 0, 4)
    assert (overlap.max_side, overlap.min_offset, overlap.num_offsets) == (5, -4, 8)
    assert CellSpec(longest_side=2, pick_rule="overlap").num_offsets == 4
    assert contain.effectors == ((2, 4, 0, 1, ((0, 0, 2, 4),)), (4, 2, 1, 0, ((0, 0, 4, 2),)))
    assert [reference_cell(side) for side in (1, 2, 3, 4, 5)] == [0, 0, 1, 1, 2]


def test_offsets_follow_from_the_cup():
    """From the lowest to the highest offset at which an item of the longest side may be gripped."""

    def offsets(gripper, longest, rotations=4):
        found = gripper.offsets(longest, rotations)
        return found[0], found[-1], gripper.least_cells

    shape = {"size": (7, 7), "body": "disc", "cup": "disc", "cup_size": (3, 3)}
    assert offsets(Contain(**shape), 4) == (2, 4, 1)  # the item begins under the cup, cells 2 to 4
    assert offsets(Overlap(**shape), 4) == (-1, 4, 1)
    assert offsets(Seal(**shape), 4) == (1, 2, 9)  # it covers cells 2 to 4
    assert offsets(Seal(**shape, min_seal=2 / 3), 4) == (0, 3, 6)  # two of three columns
    assert offsets(Seal(**shape, min_seal=0.67), 4) == (1, 2, 7)
    corner = Seal(cup=[[1, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert offsets(corner, 1) == (0, 2, 1) and offsets(corner, 1, rotations=1) == (0, 0, 1)
    # A square looks the same in all rotations, an H after half a turn, a U in none: so many shapes are distinct.
    bodies = [[1, 1, 1]] * 3, [[1, 1, 1], [0, 1, 0], [1, 1, 1]], [[1, 1, 1], [1, 0, 0], [1, 1, 1]]
    for rotations, counts in ((1, (1, 1, 1)), (2, (1, 2, 2)), (3, (1, 2, 3)), (4, (1, 2, 4))):
        assert tuple(len(Contain(body=body, cup=body).shapes(rotations)) for body in bodies) == counts


@dataclass(frozen=True)
class AnyTwo(Gripper):
    """Grips an item on which two cells of the cup lie."""

    least_cells = 2


def test_a_grip_rule_of_ones_own_is_a_class_with_the_least_cells():
    two, seal = AnyTwo((3, 3)), Seal((3, 3), min_seal=2 / 9)
    assert (two.offsets(4, 4), two.largest_item) == (seal.offsets(4, 4), None)
    near, w, d = torch.arange(-4, 5), torch.tensor([1, 2])[:, None, None], torch.tensor(2)
    for inset in ((0, 0), (1, 0), (0, 1)):
        gripped = [one.is_gripped(near[:, None], near, w, d, inset) for one in (two, seal)]
        assert gripped[0].equal(gripped[1]) and gripped[0].any() == (inset == (0, 0))
    cell = CellSpec(gripper=two)
    assert replace(cell, effector_size=(5, 5)).gripper == AnyTwo((5, 5)) != Overlap((5, 5))
    assert cell.describe() == "bin 5x5x1, tote 6x6x5, gripper AnyTwo 3x3, R=4"
