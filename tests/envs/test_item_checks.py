"""The check of items before an environment is made."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import CellSpec
from pickplace.envs import checks
from pickplace.items.distributions import Kinds


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_positions_that_are_alike_are_checked_once(data):
    """An item is refused where and only where it is if all its positions in the bin are checked."""
    draw = data.draw
    bin_size = draw(st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 3)))
    gripper = draw(st.tuples(st.integers(1, 3), st.integers(1, 3)))
    rule = draw(st.sampled_from(["contain", "overlap"]))
    cell = CellSpec(
        bin_size=bin_size, tote_size=(draw(st.integers(2, 6)), draw(st.integers(2, 6)), 3), effector_size=gripper,
        pick_rule=rule, rotations=draw(st.integers(1, 4)),
    )  # fmt: skip
    item = draw(st.tuples(*(st.integers(1, min(3, side)) for side in bin_size[:2]), st.integers(1, 3)))
    items = Kinds([item])

    def verdict(corners):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(checks, "_corners", corners)
            try:
                checks.check_items(cell, items)
            except ValueError as error:
                return str(error)
        return None

    some, all_of_them = verdict(checks._corners), verdict(lambda cell, items, kind: items.corners(kind, cell.bin_size))
    assert (some is None) == (all_of_them is None), (some, all_of_them)
