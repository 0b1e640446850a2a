"""The network of ``model=corners``: its inputs against a plain computation, and what they do not depend on."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import problems, state_of

from pickplace import CellSpec
from pickplace.policies.corners.network import PLANES, CornerNet
from pickplace.policies.depth import Contents
from pickplace.rules.observation import STANDARD_TERMS, observe

INSIDE, NEAR = 3, 2


def network(seed=0, **sizes):
    torch.manual_seed(seed)
    return CornerNet(8, 8, INSIDE, NEAR, (4, 3), head_std=1.0, **sizes)


def contents(row, *cases):
    """Return the items, one in each bin."""
    return Contents(state_of(*cases).items, torch.zeros_like(row))


def observed(cell, *cases):
    seen = observe(STANDARD_TERMS, cell, state_of(*cases))
    return seen["bin_depth"], seen["tote_depth"], seen["tote_bearing"]


def plain_points(side):
    """Return the points along a side of an item, by the words of the docstring."""
    beyond = [*range(1, NEAR + 1), NEAR + (side + 1) // 2]
    within = [int((k + 0.5) * side / INSIDE) for k in range(INSIDE)]
    return [-step for step in reversed(beyond)] + within + [side - 1 + step for step in beyond]


def plain_planes(case, parity, x, y):
    """Return what is seen at each point, ``[PLANES][points][points]``."""
    w, d, h = case.item[2:]
    wide, deep = len(case.heights), len(case.heights[0])
    sides = (w, d) if parity == 0 else (d, w)
    under = [case.heights[i][j] for i in range(x, min(x + sides[0], wide)) for j in range(y, min(y + sides[1], deep))]
    rest = max(under)
    planes = [[[0.0] * len(plain_points(d)) for _ in plain_points(w)] for _ in range(PLANES)]
    for a, along in enumerate(plain_points(w)):
        for b, across in enumerate(plain_points(d)):
            i, j = (x + along, y + across) if parity == 0 else (x + across, y + along)
            if not (0 <= i < wide and 0 <= j < deep):
                values = [0, 0, 0, 0, 0, 1]
            else:
                above, bears = (int(case.heights[i][j]) - int(rest)) / h, bool(case.bearing[i][j])
                flags = [above > 1, above == 1, above == 0 and bears, not bears, False]
                values = [min(max(above, -1.5), 1.5), *flags]
            for plane, value in enumerate(values):
                planes[plane][a][b] = float(value)
    return torch.tensor(planes)


@settings(max_examples=60)
@given(problems(count=2), st.data())
def test_the_points_show_the_tote_around_the_item(problem, data):
    cell, cases = problem
    tote_w, tote_d, _ = cell.tote_size
    net, places = network(), []
    for row, case in enumerate(cases):
        for parity in range(cell.parities):
            w, d = case.item[2:4][:: 1 - 2 * parity]
            if w <= tote_w and d <= tote_d:
                x, y = (data.draw(st.integers(0, most)) for most in (tote_w - w, tote_d - d))
                places.append((row, parity, x, y))
    if not places:
        return
    row, parity, x, y = torch.tensor(places).unbind(1)
    found = net.inputs(*observed(cell, *cases), row, (parity * tote_w + x) * tote_d + y, contents(row, *cases))
    for one, (number, *place) in zip(found, places, strict=True):
        planes = one[: PLANES * net.points**2].view(PLANES, net.points, net.points)
        torch.testing.assert_close(planes, plain_planes(cases[number], *place))
    assert found.isfinite().all() and found.abs().max() <= 3


@settings(max_examples=30)
@given(problems(count=3))
def test_a_turned_problem_is_the_same_problem(problem):
    """Turning the tote by exchanging x and y, and the item with it, changes no score."""
    cell, cases = problem
    tote_w, tote_d, _ = cell.tote_size
    turned = CellSpec(cell.bin_size, (tote_d, tote_w, cell.tote_size[2]), cell.gripper)
    flipped = [case._replace(heights=case.heights.T.copy(), bearing=case.bearing.T.copy()) for case in cases]
    for row, case in enumerate(cases):
        w, d = case.item[2:4]
        x, y = max(0, tote_w - w) // 2, max(0, tote_d - d) // 2
        if w > tote_w or d > tote_d:
            continue
        net, one = network(), torch.tensor([row])
        here = net.at(*observed(cell, *cases), one, torch.tensor([x * tote_d + y]), contents(one, *cases))
        there = net.at(
            *observed(turned, *flipped), one, torch.tensor([(tote_d + y) * tote_w + x]), contents(one, *cases)
        )
        torch.testing.assert_close(here, there)


@pytest.mark.parametrize(
    ("settings_", "message"),
    [
        ({"filters": 0}, "model.actor.filters=0: expected a whole number >= 1"),
        ({"inside": 2.5}, "model.actor.inside=2.5: expected a whole number"),
        ({"item_scale": (3,)}, r"model.actor.item_scale=\(3,\): expected \[side, height\]"),
        ({"item_scale": (0, 3)}, "model.actor.item_scale=0: expected a number"),
    ],
)
def test_bad_settings_are_named(settings_, message):
    with pytest.raises(ValueError, match=message):
        CornerNet(**settings_)
