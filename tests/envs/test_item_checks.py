"""The check of items before an environment is made."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import CellSpec, Item, PickPlaceEnv
from pickplace.envs import checks
from pickplace.items.distributions import Kinds


class Drawn(Kinds):
    """A distribution of a user with one fault. Only its first kind arrives."""

    def __init__(self, fault, **handling):
        super().__init__([(2, 1, 1), (1, 1, 1)], **handling)
        self.fault, self.calls = fault, 0

    def sample(self, stream, seed, episode, step, bin_size, mix=None):
        self.calls += 1
        zero = torch.zeros_like(episode)
        w = zero + {"size": 3}.get(self.fault, 2)
        more = {"random": self.calls, "batch": len(step), "outside": 1}.get(self.fault, 0)
        return Item((episode + step + more) % 4 + (self.fault == "outside"), zero, w, zero + 1, zero + 1)


@pytest.mark.parametrize(("fault", "handling", "message"), [
    ("batch", {}, "Drawn.sample gave other items for the same seed, episode and step"),
    ("random", {}, "Drawn.sample gave other items for the same seed, episode and step"),
    ("size", {}, "Drawn.sample gave an item of a size that is not in `sizes`"),
    ("outside", {}, r"Drawn.sample gave an item outside the bin of \(5, 5\) cells"),
    ("handling", {"grams": [100, 200], "max_load": [0, 0]}, r"without its `handling`; of_kind\(\) adds it"),
])  # fmt: skip
def test_items_that_a_resume_would_refuse_are_refused_at_the_start(fault, handling, message):
    with pytest.raises(ValueError, match=f"items: .*{message}"):
        PickPlaceEnv(Drawn(fault, **handling), handling=bool(handling))
    PickPlaceEnv(Drawn("none"))


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
