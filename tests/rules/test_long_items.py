"""Long items on fine grids: what supports them, against SciPy's hulls, the oracle, and a look at every cell."""

from itertools import product
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracle import SUCCESS
from problems import Case, oracle_of, state_of
from scipy.spatial import ConvexHull

from pickplace import CellSpec
from pickplace.rules.gripper.rules import Contain, Overlap
from pickplace.rules.maps import FAR
from pickplace.rules.masks import footprint_mask, num_feasible, placing_maps
from pickplace.rules.placing import FootprintContact, LargeFootprintContact
from pickplace.rules.state import surface_from
from pickplace.rules.step import apply
from pickplace.rules.support import contact as contact_module
from pickplace.rules.support.contact import Contact
from pickplace.rules.support.rules import Bearing, Hull

MARGINS = [0.0, 0.1, 0.25, 0.3, 0.5, 1.0, 1.3, 2.5]


def contact_of(held: torch.Tensor, w: torch.Tensor, d: torch.Tensor) -> Contact:
    """Return the contact of items ``[N]`` with cells of a square, bool ``[S, S, N]``, one of which is held at least."""
    side = len(held)
    step = torch.arange(side)[:, None]
    under = ((step < w)[:, None] & (step < d)).flatten(0, 1)
    return Contact(surface_from(held.flatten(0, 1)), under, torch.ones(held.shape[2], dtype=torch.int32), w, d)


def same_by_arcs(contact: Contact) -> None:
    """Check that patterns and arcs tell the same."""
    for margin in MARGINS:
        expected = contact.is_centre_in_hull(margin)
        with patch.object(contact_module, "PATTERN_SIDE", 0):
            assert torch.equal(contact.is_centre_in_hull(margin), expected), margin


@pytest.mark.parametrize("size", [*product(range(1, 4), repeat=2)])
def test_arcs_tell_what_patterns_do_for_all_short_items(size):
    number = torch.arange(2 ** (size[0] * size[1]))
    held = torch.zeros(3, 3, len(number), dtype=torch.bool)
    held[: size[0], : size[1]] = (number >> torch.arange(size[0] * size[1])[:, None] & 1).view(*size, -1)
    same_by_arcs(contact_of(held, *torch.tensor(size)[:, None].expand(2, len(number))))


@given(st.integers(4, 5), st.sampled_from([0.1, 0.2, 0.5]), st.integers(0, 10**6))
def test_arcs_tell_what_patterns_do(side, share, seed):
    random = torch.Generator().manual_seed(seed)
    held = torch.rand(side, side, 200, generator=random) < share
    same_by_arcs(contact_of(held, *torch.randint(1, side + 1, (2, 200), generator=random)))


@st.composite
def supported(draw, longest=100):
    """Return the size of an item, some of the cells below it, and their hull's equations."""
    w, d = (draw(st.one_of(st.integers(1, 16), st.integers(6, longest))) for _ in range(2))
    cell = st.tuples(st.integers(0, w - 1), st.integers(0, d - 1))
    held = draw(st.lists(cell, min_size=1, max_size=12, unique=True))
    corners = [(x + a, y + b) for x, y in held for a in (0, 1) for b in (0, 1)]
    return (w, d), held, ConvexHull(corners).equations


def one_item(size: tuple[int, int], held: list[tuple[int, int]]) -> Contact:
    cells = torch.zeros(max(size), max(size), 1, dtype=torch.bool)
    cells[tuple(torch.tensor(held).t())] = True
    return contact_of(cells, *torch.tensor(size)[:, None])


@settings(max_examples=300, deadline=None)
@given(supported(), st.sampled_from([*MARGINS, 7.0, 30.0]))
def test_the_centre_of_an_item_of_any_size_is_in_scipys_hull(case, margin):
    size, held, equations = case
    outside = (equations @ [size[0] / 2, size[1] / 2, 1]).max()  # minus the distance to the hull's edge
    assume(abs(outside + margin) > 1e-9 or margin == 0)
    assert one_item(size, held).is_centre_in_hull(margin).tolist() == [bool(outside < -margin - 1e-9)]


@settings(max_examples=60, deadline=None)
@given(supported())
def test_a_margin_is_exceeded_up_to_the_hulls_edge(case):
    size, held, equations = case
    distance = -(equations @ [size[0] / 2, size[1] / 2, 1]).max()
    assume(distance > 1e-3)
    contact = one_item(size, held)
    assert contact.is_centre_in_hull(distance - 1e-7) and not contact.is_centre_in_hull(distance + 1e-7)


@settings(max_examples=80, deadline=None)
@given(supported())
def test_an_item_of_any_size_bears_weight_inside_scipys_hull(case):
    size, held, equations = case
    contact = one_item(size, held)
    corners = np.array([[(x + a, y + b, 1) for a in (0, 1) for b in (0, 1)]
                        for x, y in product(range(max(size)), repeat=2)])  # fmt: skip
    expected = contact.under[:, 0].numpy() & ((corners @ equations.T).max((1, 2)) < 1e-9)
    assert contact.hull_mask()[:, 0].tolist() == expected.tolist()


@settings(max_examples=100, deadline=None)
@given(st.sampled_from([FootprintContact, LargeFootprintContact]), st.integers(1, 7), st.integers(0, 10**6))
def test_rows_of_footprints_are_those_of_their_cells(kind, side, seed):
    random = torch.Generator().manual_seed(seed)
    grid = (4, 600) if seed % 20 == 0 else (7, 6)  # numbers of surface and place that need 64 bits
    cell = CellSpec((side, side, 1), (*grid, 9), Contain((side, side)), 2, longest_side=side)
    heights, bearing = (torch.randint(0, 3, (2, 3, *grid), generator=random)).clamp(0, 2).unbind(0)
    w, d = (torch.randint(1, side + 1, (2, 1, 1, 3), generator=random) for _ in range(2))
    contact = kind(cell, surface_from(heights, bearing > 0), w, d)
    inside = contact.z < FAR
    cells, rows = torch.stack([*contact.cells()]).unflatten(0, (side, side)), [*contact.rows()]
    assert len(rows) == side
    for row, (first, last) in zip(cells, rows, strict=True):
        place = torch.arange(side).view(-1, 1, 1, 1, 1)
        assert torch.equal(first.clamp(max=side)[inside], torch.where(row, place, side).amin(0)[inside].int())
        assert torch.equal(last[inside], torch.where(row, place, -1).amax(0)[inside].int())


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_long_items_are_placed_as_the_oracle_says(data):
    """Every footprint of an item among a few boxes, by the single step and by the mask; and where it bears weight."""
    longest = data.draw(st.integers(6, 12))
    w, d = (data.draw(st.integers(3, longest)) for _ in range(2))
    wide, deep = (longest + data.draw(st.integers(0, 3)) for _ in range(2))
    margin, bears = data.draw(st.sampled_from(MARGINS[:5])), data.draw(st.booleans())
    cell = CellSpec(
        (longest, longest, 1), (wide, deep, 6), Overlap((1, 1)), 2, (Bearing if bears else Hull)(margin),
        longest_side=longest,
    )  # fmt: skip
    heights = np.zeros((wide, deep), dtype=int)
    for _ in range(data.draw(st.integers(1, 5))):
        x, y = (data.draw(st.integers(0, side - 1)) for side in (wide, deep))
        across, along = (data.draw(st.integers(1, longest)) for _ in range(2))
        heights[x : x + across, y : y + along] = data.draw(st.integers(0, 2))
    bearing = np.ones_like(heights)
    if bears:
        share = np.random.default_rng(data.draw(st.integers(0, 999))).random(heights.shape)
        bearing = (share < data.draw(st.sampled_from([0.3, 0.9, 1.0]))) | (heights == 0)
    case = Case(6, heights, bearing.astype(int), (0, 0, w, d, 1))
    state, plain = state_of(case), oracle_of(cell, case)
    mask = footprint_mask(cell, placing_maps(cell, state))[0]
    # The gripper at the item's first cell; turned, at the one that comes first then.
    picks = ((0, 0), (0, d - 1))
    tried = [(plain.rules.join(picks[r], place, r), r, *place)
             for r in range(2) for place in product(range(wide), range(deep))]  # fmt: skip
    step = apply(cell, state.repeat(len(tried)), torch.tensor([action for action, *_ in tried]))
    failures = [plain.try_action(action)[0] for action, *_ in tried]
    assert step.failure.tolist() == failures
    for (_, r, x, y), failure in zip(tried, failures, strict=True):
        assert bool(mask[0 if w == d else r, x, y]) == (failure == SUCCESS)
    placed = [row for row, failure in enumerate(failures) if failure == SUCCESS]
    for row in placed[:: max(1, len(placed) // 10)]:
        assert (step.surface[row] & 1).tolist() == plain.bearing_after(tried[row][0])


def test_a_gripper_of_one_cell_takes_items_of_a_hundred_cells():
    """On an empty tote each cell of the item is a pick, and each footprint inside the tote is a place."""
    cell = CellSpec((100, 100, 1), (110, 105, 9), Overlap((1, 1)), 1, Bearing(), longest_side=100)
    case = Case(9, np.zeros((110, 105), dtype=int), np.ones((110, 105), dtype=int), (0, 10, 100, 90, 1))
    maps = placing_maps(cell, state_of(case))
    assert footprint_mask(cell, maps).sum() == 11 * 16 and num_feasible(cell, maps).tolist() == [100 * 90 * 11 * 16]
