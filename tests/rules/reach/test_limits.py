"""Tables of limits: what a cell refuses, and those that it computes of its reach."""

from dataclasses import fields, replace

import pytest
import torch

from pickplace import CellSpec
from pickplace.rules.reach.annulus import Annulus
from pickplace.rules.reach.base import Limits


@pytest.mark.parametrize("table", [field.name for field in fields(Limits)])
def test_a_table_of_another_shape_or_type_is_refused(table):
    places = torch.zeros(2, 6, 7, dtype=torch.int32)
    tables = {"pick_ok": torch.ones(20, dtype=torch.bool), "lowest_top": places, "highest_top": places + 5}
    tables |= {"lowest_pick": torch.zeros(20).int(), "highest_pick": torch.ones(20).int()}
    sizes = {"bin_size": (4, 5, 1), "tote_size": (6, 7, 5), "rotations": 2}
    assert CellSpec(**sizes, reach=Limits(**tables)).limits.to("cpu").highest_top.equal(places + 5)
    kind = "bool" if table == "pick_ok" else "integers"
    for bad, words in (
        (tables[table][:-1], r"got .* of shape \[.*\], expected .* of shape \["),
        (tables[table].float(), f"got torch.float32 .*, expected {kind}"),
        (tables[table].int() if kind == "bool" else tables[table].bool(), f"got torch.* of shape .*, expected {kind}"),
    ):
        with pytest.raises(ValueError, match=f"limits.{table}: {words}"):
            CellSpec(**sizes, reach=Limits(**{**tables, table: bad}))


def test_limits_of_a_reach_are_those_of_the_cell_s_sizes():
    reach = Annulus((0, 4.6), (0, 3), (-5, 0, 0), (0, 0, 0))
    cell = CellSpec(reach=reach)
    wider = replace(cell, tote_size=(8, 7, 5), effector_size=(2, 2), height_unit=0.5)
    assert wider.limits.highest_top.shape == (4, 8, 7) and int(wider.limits.highest_top.max()) == 6
    assert replace(cell, reach=None).limits is None and replace(cell, rotations=4).limits is not None
    assert cell == CellSpec(reach=reach) != CellSpec() and hash(cell) == hash(CellSpec(reach=reach))
    tables = replace(cell, reach=cell.limits)
    assert tables.limits is cell.limits and tables != cell and replace(tables, refill="batch").limits is cell.limits
    with pytest.raises(ValueError, match="reach='far': expected a Reach, such as an Annulus, or None"):
        CellSpec(reach="far")
