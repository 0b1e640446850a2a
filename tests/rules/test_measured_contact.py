"""What carries an item on a measured surface, if it is set down off its place: against polygons and many shifts."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pickplace import CellSpec
from pickplace.rules.item import Item
from pickplace.rules.measured import MeasuredTote, _contact, measured_maps
from pickplace.rules.support.rules import RULES

PER_CELL, TOP = 4, 100
ANGLES = np.linspace(0, 2 * np.pi, 180, endpoint=False)
DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)])


def surface(seed: int, footprint: tuple[int, int]) -> np.ndarray:
    """Patches that are as high as the highest, or the floor: some rectangles, or all but some."""
    draw = np.random.default_rng(seed)
    shape = np.multiply(footprint, PER_CELL)
    high = np.full(shape, draw.random() < 0.3)
    for _ in range(draw.integers(1, 4)):
        x0, y0 = (draw.integers(0, side) for side in shape)
        x1, y1 = x0 + draw.integers(1, shape[0] + 1), y0 + draw.integers(1, shape[1] + 1)
        high[x0:x1, y0:y1] = draw.random() < 0.8
    return high


def contact_of(high: np.ndarray, footprint, sides, error: float):
    cell = CellSpec(tote_size=(*footprint, 5))
    heights = torch.from_numpy(high * TOP).int()
    tote = MeasuredTote(heights, heights, torch.ones(footprint, dtype=torch.bool), 500, 500, 0, error)
    return _contact(cell, tote, footprint, sides, torch.tensor([[TOP]]))


def pieces(high: np.ndarray, low: np.ndarray, far: np.ndarray) -> np.ndarray:
    """The parts of high patches in a rectangle: minimum and maximum corner, ``[n, 2, 2]``; lengths in patches."""
    corner = np.argwhere(high)
    parts = np.stack([np.maximum(corner, low), np.minimum(corner + 1, far)], 1)
    return parts[(parts[:, 1] - parts[:, 0] > 1e-9).all(1)]


def is_inside(point: np.ndarray, parts: np.ndarray) -> bool:
    """Whether the hull of rectangles holds a point."""
    corners = parts[:, [[0, 0], [0, 1], [1, 0], [1, 1]], [0, 1]].reshape(-1, 2)
    return len(corners) > 0 and bool((((corners - point) @ DIRECTIONS).max(0) > -1e-6).all())


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10**6), st.tuples(st.integers(1, 3), st.integers(1, 3)), st.floats(0.3, 1), st.floats(0.3, 1),
    st.sampled_from([0.0, 0.1, 0.25]),
)  # fmt: skip
def test_what_carries_an_item_does_so_wherever_it_is_set_down(seed, footprint, x, y, error):
    sides = x * (footprint[0] - 2 * error), y * (footprint[1] - 2 * error)
    high = surface(seed, footprint)
    contact = contact_of(high, footprint, sides, error)
    stable = contact.is_centre_in_hull() | contact.full
    share, held = float(contact.share), contact.hull_mask()
    middle, half = np.multiply(footprint, PER_CELL) / 2, np.array(sides) * PER_CELL / 2
    begin = np.ceil(middle - half - 1e-6).astype(int)
    shape = [part.shape[1] for part in contact.uncovered]
    marked = np.argwhere(held.view(shape).numpy()) + begin
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    for shift in [np.zeros(2)] + [
        error * PER_CELL * reach * np.array([np.cos(turn + angle), np.sin(turn + angle)])
        for angle in np.arange(8) * np.pi / 4
        for reach in (0.5, 0.999)
    ]:
        low, far = middle + shift - half, middle + shift + half
        parts = pieces(high, low, far)
        assert not stable or is_inside(middle + shift, parts)
        assert np.prod(parts[:, 1] - parts[:, 0], axis=1).sum() / np.prod(2 * half) >= share - 1e-6
        for patch in marked:
            corner, end = np.maximum(patch, low), np.minimum(patch + 1, far)
            if (corner < end - 1e-9).all():  # the part of the patch on which the item lies
                for point in (corner, end, (corner[0], end[1]), (end[0], corner[1])):
                    assert is_inside(np.array(point), parts)


@pytest.mark.parametrize("rule", RULES)
@settings(max_examples=40, deadline=None)
@given(st.floats(0.9, 3), st.floats(0.9, 3), st.sampled_from([4, 5, 8]), st.sampled_from([0.0, 0.1, 0.25]))
def test_floors_and_tops_of_its_own_size_carry_an_item(rule, w, d, count, error):
    """The item is longer than 4 patches and 4 errors; the top is that of one of the same size at the same place."""
    sides = w, d = max(w, 4 / count + 4 * error), max(d, 4 / count + 4 * error)
    w, d = (int(np.ceil(side + 2 * error - 1e-9)) for side in sides)
    cell = CellSpec(tote_size=(w, d, 9), support=rule, effector_size=(w, d) if min(w, d) > 1 else (5, 5), rotations=1)
    item = Item(*(torch.tensor([part]) for part in (0, 0, w, d, 50)))
    flat = np.zeros((w * count, d * count), dtype=np.int32)
    under = np.zeros_like(flat)
    begin, end = (
        [(size + sign * side) / 2 * count for size, side in zip((w, d), sides, strict=True)] for sign in (-1, 1)
    )
    under[tuple(slice(int(np.ceil(a - 1e-6)), int(np.floor(b + 1e-6))) for a, b in zip(begin, end, strict=True))] = TOP
    for low in (flat, under):
        high = np.where(low.any(), TOP, 0) * np.ones_like(flat)
        tote = MeasuredTote(
            torch.from_numpy(high).int(), torch.from_numpy(low), torch.ones(w, d, dtype=torch.bool), 900, 900, 1, error
        )
        assert measured_maps(cell, tote, item, sides).stable[0, 0, 0]


def test_contact_that_a_shift_leaves_does_not_count():
    """Two strips under the ends of an item, which keep it up, or do so only where it is exactly in its place."""
    stable = {}
    for strip in (1, 2):
        high = np.zeros((16, 16), dtype=bool)
        high[:strip], high[-strip:] = True, True
        for error in (0.0, 0.25):
            contact = contact_of(high, (4, 4), (4, 4), error)
            stable[strip, error] = bool(contact.is_centre_in_hull())
    assert stable == {(1, 0.0): True, (2, 0.0): True, (1, 0.25): False, (2, 0.25): True}


@pytest.mark.parametrize(
    ("reach", "error", "stable"), [(1, 0.0, False), (2, 0.0, True), (2, 0.25, False), (3, 0.25, True)]
)
def test_the_centre_keeps_the_error_and_a_patch_from_the_edge(reach, error, stable):
    """A table ends so many patches behind the item's centre; 1.5 of them may be covered in part, and 1 is the error."""
    high = np.zeros((16, 16), dtype=bool)
    high[: 8 + reach] = True
    assert bool(contact_of(high, (4, 4), (3.5, 3.5), error).is_centre_in_hull()) == stable
