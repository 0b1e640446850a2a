"""Stability rules as objects: their short and long forms, and rules of a user's own on the grid and in metres."""

from dataclasses import dataclass
from random import Random

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import Rules, is_stable
from problems import SUPPORTS, support_of

from pickplace import Box, CellSpec, Planner, Scene
from pickplace.config.registry import REGISTRY, build, node_of
from pickplace.rules.gripper.rules import Contain
from pickplace.rules.maps import FAR
from pickplace.rules.placing import FootprintContact, LargeFootprintContact
from pickplace.rules.state import surface_from
from pickplace.rules.support.rules import RULES, Bearing, Hull, Share, Support, read_support


def test_the_registry_has_every_rule():
    assert list(REGISTRY["env.support"]) == [*RULES, "share"]


@pytest.mark.parametrize(("name", "margin"), SUPPORTS)
def test_a_rule_is_made_again_of_its_setting(name, margin):
    rule = support_of(name, margin)
    assert build("env.support", node_of("env.support", rule)) == rule == read_support(rule)
    assert CellSpec(support=rule) == CellSpec(support=support_of(name, margin)) and hash(rule) == hash(rule)


def test_short_forms():
    assert CellSpec().support == CellSpec(support="bearing").support == Bearing(0.25) != Hull(0.25)
    assert CellSpec(support=0.7).support == Share(0.7)
    assert [read_support(name).marks_bearing for name in RULES] == [name == "bearing" for name in RULES]


@pytest.mark.parametrize(
    ("node", "message"),
    [
        ({"_target_": "hull", "margin": -1}, "support.margin=-1: expected a number between 0 and 100"),
        ({"_target_": "share", "least": 1.5}, "support.least=1.5: expected a number between 0 and 1"),
        ({"_target_": "half", "margin": 0.1}, "env.support.margin: there is no key 'margin'"),
        *(({"_target_": name, "least": 0.3}, "env.support.least: there is no key 'least'") for name in RULES),
        ({"_target_": "hul"}, "env.support._target_=hul: .* did you mean 'hull'"),
    ],
)
def test_bad_settings_are_refused(node, message):
    with pytest.raises(ValueError, match=message):
        build("env.support", node)


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 6), st.integers(0, 10**6))
def test_large_items_touch_what_small_ones_do(side, seed):
    """Every quantity of a contact, with cells that bear no weight."""
    random = torch.Generator().manual_seed(seed)
    cell = CellSpec((side, side, 1), (7, 6, 9), Contain((side, side)), rotations=2, longest_side=side)
    heights, bearing = (torch.randint(0, 2, (5, 7, 6), generator=random) for _ in range(2))
    if seed % 2:
        bearing[heights == 1] = 0  # nothing carries an item there
    surface = surface_from(heights, bearing)
    w, d = (torch.randint(1, side + 1, (2, 1, 1, 5), generator=random) for _ in range(2))
    small, large = FootprintContact(cell, surface, w, d), LargeFootprintContact(cell, surface, w, d)
    inside = small.z < FAR
    for quantity in ("count", "share", "num_supported_corners", "num_level_corners"):
        assert torch.equal(getattr(small, quantity)[inside], getattr(large, quantity)[inside]), quantity
    for name in (name for name, rule in RULES.items() if not rule.sees_boxes):
        assert torch.equal(RULES[name]().stable(small)[inside], RULES[name]().stable(large)[inside]), name


@pytest.mark.parametrize("margin", [0.0, 0.25])
def test_the_hull_under_larger_items_is_that_of_the_oracle(margin):
    """A few supporting cells of footprints up to 7 x 7, whose hulls have edges in many directions."""
    rng, side, count = Random(0), 7, 3_000
    cell = CellSpec((side, side, 1), (side, side, 9), Contain((side, side)), rotations=1, longest_side=side)
    heights, sizes, expected = torch.zeros(count, side, side, dtype=torch.int64), [], []
    for row in range(count):
        w, d = size = rng.randint(3, side), rng.randint(3, side)
        cells = rng.sample([(x, y) for x in range(w) for y in range(d)], rng.randint(2, 4))
        x, y = zip(*cells, strict=True)
        heights[row, x, y] = 1
        sizes.append(size)
        expected.append(is_stable(Rules(support="hull", support_margin=margin), cells, size))
    w, d = torch.tensor(sizes).t().reshape(2, 1, 1, 1, count)
    contact = FootprintContact(cell, surface_from(heights), w, d)
    assert Hull(margin).stable(contact)[0, 0, 0].tolist() == expected and 0.2 < sum(expected) / count < 0.8


@dataclass(frozen=True)
class Anything(Support):
    def stable(self, contact):
        return torch.ones_like(contact.z, dtype=torch.bool)

    def measured(self, patches):
        return torch.ones_like(patches.full)


@dataclass(frozen=True)
class GridOnly(Anything):
    measured = Support.measured


@pytest.mark.parametrize(("rule", "wall", "status"), [
    (Anything(), 0.1, "ok"),  # more than half of the footprint is supported, and its centre
    (GridOnly(), 0.1, "stuck"),  # not everything is: without a rule for it no tote in metres suffices
    (Anything(), 0.05, "stuck"),  # the centre is above nothing
])  # fmt: skip
def test_no_rule_lets_an_item_lean_in_a_measured_tote(rule, wall, status):
    """The only place is partly on a wall in a tote that is as large as the item."""
    cell = CellSpec((3, 3, 1), (3, 3, 6), rotations=1, support=rule)
    remaining = torch.full((30, 30), 0.3)
    remaining[: round(wall * 200)] -= 0.1
    scene = Scene([Box(0.075, 0.075, 0.14, 0.14, 0.05)], remaining, cell_size=0.05, accuracy=0.001, clearance=0.0)
    assert Planner(cell, planner="joint_dbl").plan(scene).status == status
