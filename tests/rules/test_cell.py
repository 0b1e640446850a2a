"""The robot cell: what it refuses (for more values see test_bad_settings), and the settings that configs may name."""

from dataclasses import fields, replace

import pytest
import torch
from problems import late_state

from pickplace import CellSpec, PickPlaceEnv
from pickplace.rules.cell import CELL_SETTINGS, Limits, cell_from_settings, reference_cell
from pickplace.rules.effector import disc_mask
from pickplace.rules.reach import Annulus
from pickplace.rules.support import Hull


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"bin_size": (-5, 5, 1)}, r"bin_size=\(-5, 5, 1\): expected 3 whole numbers >= 1"),
        ({"tote_size": (6, 0, 5)}, r"tote_size=\(6, 0, 5\)"),
        ({"tote_size": (6, 6)}, r"tote_size=\(6, 6\): expected 3"),
        ({"tote_size": (6, 6, 2**20)}, "tote_size=.*and <= 2,000"),
        ({"tote_size": (6, 6.5, 5)}, "tote_size="),
        ({"tote_size": (6, True, 5)}, "tote_size="),
        ({"effector_size": (3, -3)}, r"effector_size=\(3, -3\): expected 2"),
        ({"effector_size": (3, 3, 1)}, r"effector_size=\(3, 3, 1\)"),
        *(({"rotations": value}, f"rotations={value}: expected 1, 2, 3 or 4") for value in (5, 4.0)),
        ({"pick_rule": "grab"}, "pick_rule='grab': expected 'contain' or 'overlap' or 'seal'"),
        *(
            ({"support": value}, f"support={value!r}: expected 'half' or .* 'full' or a number between 0 and 1")
            for value in (1.5, -0.1, "most", True)
        ),
        *(
            (
                {"body": value},
                r"body=.*: expected 'rectangle', 'disc', or a mask of effector_size=\[3, 3\]: 3 lists of 3",
            )
            for value in ("oval", 3, [[1, 1], [1, 1]], [[1, 1, 2]] * 3, [[1, 1, True]] * 3, [["1"] * 3] * 3, None)
        ),
        *(
            ({"body": value, "cup": value}, "body=.*: expected a 1 in its first and last list, and first and last in")
            for value in ([[0, 0, 0], [1, 1, 1], [1, 1, 1]], [[0, 1, 1]] * 3, [[1, 1, 0]] * 3)
        ),
        ({"cup": [[0] * 3] * 3}, "cup=.*: expected a mask with a 1"),
        ({"cup": [[1] * 3] * 3, "cup_size": [1, 1]}, r"cup_size=\[1, 1\]: expected null, as cup is a mask"),
        *(
            (
                {"cup_size": value},
                r"cup_size=.*: expected sides that differ from effector_size=\[3, 3\] by an even number",
            )
            for value in ([2, 3], [5, 5])
        ),
        ({"cup_size": 3}, "cup_size=3: expected 2 whole numbers"),
        (
            {"body": [[1, 1, 1], [1, 0, 0], [1, 0, 0]]},
            r"cup='rectangle', cup_size=None: cell \(1, 1\) of the cup is not in",
        ),
        ({"effector_size": (7, 7), "body": "disc"}, r"cell \(0, 0\) of the cup is not in body='disc'"),
        *(({"min_seal": value}, f"min_seal={value}: expected a number > 0 and <= 1") for value in (0, 1.1, True)),
        *(({"height_unit": value}, f"height_unit={value}: .* between 0.001 and 1000") for value in (1e-4, 2000)),
        ({"longest_side": 0}, "longest_side=0: expected a whole number >= 1"),
        ({"bin_items": 0}, "bin_items=0: expected a whole number >= 1 and <= 100"),
        ({"refill": "all"}, "refill='all': expected 'each' or 'batch'"),
        ({"tote_sizes": (6, 6, 5)}, r"tote_sizes=\(6, 6, 5\): expected one of bin_size, tote_size, .*, height_unit"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        cell_from_settings(settings)


def test_every_setting_reaches_the_cell_of_the_environment():
    given = {
        "bin_size": [4, 6, 2], "tote_size": [5, 7, 6], "effector_size": [2, 4], "rotations": 3, "pick_rule": "overlap",
        "support": Hull(0.3), "height_unit": 0.5, "body": "disc", "cup": "disc",
        "cup_size": [2, 4], "min_seal": 0.5,
        "reach": Annulus([0, 99], [0, 9], [-9, 0, 0], [2, 0, 0]), "bin_items": 2, "refill": "batch",
    }  # fmt: skip
    assert tuple(given) == CELL_SETTINGS
    cell = PickPlaceEnv(num_envs=1, **given).cell
    for key, value in given.items():
        assert getattr(cell, key) == (tuple(value) if isinstance(value, list) else value)
    assert cell.longest_side == 2  # of the items
    assert cell.describe() == "bin 4x6x2, tote 5x7x6, end effector 2x4, R=3"
    assert (cell.num_picks, cell.num_places, cell.num_actions) == (24, 35, 2520)


def test_counts_of_offsets_and_footprints():
    assert [CellSpec(rotations=rotations).num_footprints for rotations in (1, 2, 3, 4)] == [36, 72, 72, 72]
    contain, overlap = CellSpec(effector_size=(2, 4)), CellSpec(effector_size=(2, 4), pick_rule="overlap")
    assert (contain.max_side, contain.min_offset, contain.num_offsets) == (4, 0, 4)
    assert (overlap.max_side, overlap.min_offset, overlap.num_offsets) == (5, -4, 8)
    assert CellSpec(longest_side=2, pick_rule="overlap").num_offsets == 4
    assert contain.effectors == ((2, 4, 0, 1, ((0, 0, 2, 4),)), (4, 2, 1, 0, ((0, 0, 4, 2),)))
    assert [reference_cell(side) for side in (1, 2, 3, 4, 5)] == [0, 0, 1, 1, 2]


def test_a_disc_touches_these_cells():
    """By hand: the corner cell of 7 is 2.5 * sqrt(2) cells from the centre, beyond 3.5; that of 6 is nearer than 3."""
    assert [sum(map(sum, disc_mask(side, side))) for side in (1, 2, 3, 6, 7)] == [1, 4, 9, 36, 45]
    assert disc_mask(7, 7)[0] == (0, 1, 1, 1, 1, 1, 0)
    assert disc_mask(8, 4) == ((1, 1, 1, 1),) * 8  # (3 / 4)**2 + (1 / 2)**2 < 1
    assert disc_mask(16, 6)[0] == (0, 1, 1, 1, 1, 0)  # (7 / 8)**2 + (2 / 3)**2 > 1 > (7 / 8)**2 + (1 / 3)**2


def test_offsets_follow_from_the_cup():
    """From the lowest to the highest offset at which an item of the longest side may be gripped."""

    def offsets(**settings):
        cell = CellSpec(**settings)
        return cell.min_offset, cell.min_offset + cell.num_offsets - 1, cell.least_sealed

    small = {"effector_size": (7, 7), "body": "disc", "cup": "disc", "cup_size": (3, 3), "longest_side": 4}
    assert offsets(**small) == (2, 4, 1)  # the item begins under the cup, cells 2 to 4
    assert offsets(**small, pick_rule="overlap") == (-1, 4, 1)
    assert offsets(**small, pick_rule="seal") == (1, 2, 9)  # it covers cells 2 to 4
    assert offsets(**small, pick_rule="seal", min_seal=2 / 3) == (0, 3, 6)  # two of three columns
    assert offsets(**small, pick_rule="seal", min_seal=0.67) == (1, 2, 7)
    corner = {"cup": [[1, 0, 0], [0, 0, 0], [0, 0, 0]], "longest_side": 1, "pick_rule": "seal"}
    assert offsets(**corner) == (0, 2, 1) and offsets(**corner, rotations=1) == (0, 0, 1)
    # A square looks the same in all rotations, an H after half a turn, a U in none: so many shapes are distinct.
    bodies = [[1, 1, 1]] * 3, [[1, 1, 1], [0, 1, 0], [1, 1, 1]], [[1, 1, 1], [1, 0, 0], [1, 1, 1]]
    for rotations, counts in ((1, (1, 1, 1)), (2, (1, 2, 2)), (3, (1, 2, 3)), (4, (1, 2, 4))):
        cells = [CellSpec(body=body, cup=body, rotations=rotations) for body in bodies]
        assert tuple(len(cell.effectors) for cell in cells) == counts


def test_the_height_unit_changes_no_rule():
    """The rules count units; only what converts heights to lengths multiplies by it."""
    plain, fine = (late_state(height_unit=unit)[1] for unit in (1.0, 0.25))
    assert (plain == fine).all()


@pytest.mark.parametrize("table", [field.name for field in fields(Limits)])
def test_a_table_of_another_shape_or_type_is_refused(table):
    places = torch.zeros(2, 6, 7, dtype=torch.int32)
    tables = {"pick_ok": torch.ones(20, dtype=torch.bool), "lowest_top": places, "highest_top": places + 5}
    tables |= {"lowest_pick": torch.zeros(20).int(), "highest_pick": torch.ones(20).int()}
    sizes = {"bin_size": (4, 5, 1), "tote_size": (6, 7, 5), "rotations": 2}
    assert CellSpec(**sizes, limits=Limits(**tables)).limits.on("cpu").highest_top.equal(places + 5)
    kind = "bool" if table == "pick_ok" else "integers"
    for bad, words in (
        (tables[table][:-1], r"got shape \[.*\], expected \["),
        (tables[table].float(), f"got torch.float32, expected {kind}"),
        (tables[table].int() if kind == "bool" else tables[table].bool(), f"got torch.*, expected {kind}"),
    ):
        with pytest.raises(ValueError, match=f"limits.{table}: {words}"):
            CellSpec(**sizes, limits=Limits(**{**tables, table: bad}))


def test_limits_of_a_reach_are_those_of_the_cell_s_sizes():
    reach = Annulus((0, 4.6), (0, 3), (-5, 0, 0), (0, 0, 0))
    cell = CellSpec(reach=reach)
    wider = replace(cell, tote_size=(8, 7, 5), effector_size=(2, 2), height_unit=0.5)
    assert wider.limits.highest_top.shape == (4, 8, 7) and int(wider.limits.highest_top.max()) == 6
    assert replace(cell, reach=None).limits is None and replace(cell, rotations=4).limits is not None
    assert cell == CellSpec(reach=reach) != CellSpec() and hash(cell) == hash(CellSpec(reach=reach))
    with pytest.raises(ValueError, match=r"limits, reach=Annulus\(.*\): got both, expected one of the two"):
        CellSpec(reach=reach, limits=Limits(*list(vars(cell.limits).values())))
    with pytest.raises(ValueError, match="reach='far': expected a Reach, such as an Annulus, or None"):
        CellSpec(reach="far")
