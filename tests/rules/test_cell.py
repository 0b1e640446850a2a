"""The robot cell: what it refuses (for more values see test_bad_settings), and the settings that configs may name."""

from dataclasses import replace

import pytest
from problems import late_state

from pickplace import CellSpec, PickPlaceEnv
from pickplace.rules.cell import CELL_SETTINGS, cell_from_settings
from pickplace.rules.gripper.rules import Overlap, Seal
from pickplace.rules.reach.annulus import Annulus
from pickplace.rules.support.rules import Hull


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"bin_size": (-5, 5, 1)}, r"bin_size=\(-5, 5, 1\): expected 3 whole numbers >= 1"),
        ({"tote_size": (6, 0, 5)}, r"tote_size=\(6, 0, 5\)"),
        ({"tote_size": (6, 6)}, r"tote_size=\(6, 6\): expected 3"),
        ({"tote_size": (6, 6, 2**20)}, "tote_size=.*and <= 2,000"),
        ({"tote_size": (6, 6.5, 5)}, "tote_size="),
        ({"tote_size": (6, True, 5)}, "tote_size="),
        *(({"rotations": value}, f"rotations={value}: expected 1, 2, 3 or 4") for value in (5, 4.0)),
        ({"pick_rule": "grab"}, "pick_rule='grab': expected 'contain' or 'overlap' or 'seal'"),
        ({"gripper": "seal"}, "gripper='seal': expected a Gripper"),
        *(
            ({"support": value}, f"support={value!r}: expected 'half' or .* 'pct' or a number between 0 and 1")
            for value in (1.5, -0.1, "most", True)
        ),
        *(({"height_unit": value}, f"height_unit={value}: .* between 0.001 and 1000") for value in (1e-4, 2000)),
        ({"longest_side": 0}, "longest_side=0: expected a whole number >= 1"),
        ({"bin_items": 0}, "bin_items=0: expected a whole number >= 1 and <= 100"),
        ({"preview": -1}, "preview=-1: expected a whole number >= 0 and <= 100"),
        ({"preview": 1, "tipping": True, "bin_items": 3}, "preview=1: expected 0 with tipping=true"),
        ({"refill": "all"}, "refill='all': expected 'each' or 'batch'"),
        ({"tote_sizes": (6, 6, 5)}, r"tote_sizes=\(6, 6, 5\): expected one of bin_size, tote_size, .*, height_unit"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        cell_from_settings(settings)


def test_every_setting_reaches_the_cell_of_the_environment():
    given = {
        "bin_size": [4, 6, 2], "tote_size": [5, 7, 6], "gripper": Overlap([2, 4], "disc", "disc", [2, 4]),
        "rotations": 3, "support": Hull(0.3), "height_unit": 0.5, "cell_size": 0.02,
        "reach": Annulus([0, 99], [0, 9], [-9, 0, 0], [2, 0, 0]), "bin_items": 2, "refill": "batch", "preview": 3,
        "handling": True, "tipping": False,
    }  # fmt: skip
    assert tuple(given) == CELL_SETTINGS
    cell = PickPlaceEnv(num_envs=1, **given).cell
    for key, value in given.items():
        assert getattr(cell, key) == (tuple(value) if isinstance(value, list) else value)
    assert cell.longest_side == 2  # of the items
    assert cell.describe() == "bin 4x6x2, tote 5x7x6, gripper Overlap 2x4, R=3"
    assert (cell.num_picks, cell.num_places, cell.num_actions) == (24, 35, 2520)


def test_the_short_form_makes_the_gripper_or_changes_it():
    shape = {"effector_size": (7, 7), "body": "disc", "cup": "disc", "cup_size": (3, 3)}
    seal = Seal((7, 7), "disc", "disc", (3, 3), 0.5)
    cell = CellSpec(pick_rule="seal", min_seal=0.5, **shape)
    assert cell == CellSpec(gripper=seal) and hash(cell) == hash(CellSpec(gripper=seal))
    env = PickPlaceEnv(num_envs=1, pick_rule="overlap", min_seal=0.5, cup_size=(1, 1))  # of no use to overlap
    assert env.cell.gripper == Overlap(cup_size=(1, 1))
    assert CellSpec(gripper=seal, effector_size=(9, 5)).gripper == replace(seal, size=(9, 5))
    assert replace(cell, pick_rule="overlap").gripper == Overlap(*list(vars(seal).values())[:4])
    assert (
        replace(cell, tote_size=(9, 9, 9)).gripper is cell.gripper and replace(cell, gripper=Seal()).gripper == Seal()
    )


def test_counts_of_footprints():
    assert [CellSpec(rotations=rotations).num_footprints for rotations in (1, 2, 3, 4)] == [36, 72, 72, 72]


def test_the_height_unit_changes_no_rule():
    """The rules count units; only what converts heights to lengths multiplies by it."""
    plain, fine = (late_state(height_unit=unit)[1] for unit in (1.0, 0.25))
    assert (plain == fine).all()
