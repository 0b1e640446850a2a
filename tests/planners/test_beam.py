"""Beam search over the items that are seen: against the policy, and against all plans one by one."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import random_states

from pickplace import CellSpec, PickPlaceEnv
from pickplace.planners.beam import Beam, _fingerprint, _Plans
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.afterstate.policy import Afterstate, AfterstateFcn
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.rules.bin import admit_coming_items
from pickplace.rules.gripper.rules import Overlap
from pickplace.rules.item import Item
from pickplace.rules.masks import placing_maps
from pickplace.rules.observation import check_terms, observe
from pickplace.rules.state import EMPTY, State, surface_from
from pickplace.rules.step import put_down

SEVERAL = {"tote_size": (4, 4, 3), "bin_items": 3, "bin_size": (6, 6, 1), "rotations": 2}
CONVEYOR = {"tote_size": (4, 4, 2), "preview": 3, "rotations": 2, "items": [(2, 2, 1), (3, 1, 1), (1, 2, 1)]}
BOTH = {**CONVEYOR, "preview": 2, "bin_items": 2, "bin_size": (6, 6, 1)}


def untrained(cell, kind=Afterstate):
    torch.manual_seed(0)
    small = {"grid": (4, 4, 3), "filters": 4, "hidden": 8} if kind is Afterstate else {"stem": 4, "filters": 8}
    policy = kind(cell, compute_dtype="float32", **small)
    torch.nn.init.normal_(policy.network.head.weight, std=1)
    torch.nn.init.normal_(policy.network.waiting.sum.weight, std=1)
    return policy


def states(count, **settings):
    yield from random_states(count, masks=("corner",), **settings)


@pytest.mark.parametrize("kind", [Afterstate, AfterstateFcn])
@pytest.mark.parametrize("settings", [{"width": 8, "depth": 1}, {"width": 3, "depth": 4, "budget": 1e-9}])
def test_one_placement_is_what_the_policy_chooses(kind, settings):
    policy = untrained(PickPlaceEnv(**SEVERAL).cell, kind)
    for env, seen in states(6, **SEVERAL):
        assert torch.equal(
            Beam(env.cell, policy, **settings).decide(seen), PolicyPlanner(env.cell, policy).decide(seen)
        )


def test_with_one_item_it_is_the_policy():
    policy = untrained(PickPlaceEnv(tote_size=(4, 4, 3)).cell)
    for env, seen in states(6, tote_size=(4, 4, 3)):
        assert torch.equal(Beam(env.cell, policy).decide(seen), PolicyPlanner(env.cell, policy).decide(seen))


def totals(policy, state, depth):
    """Return the choices from a state ``[1]``, and for each the greatest sum of volume and value over all plans that
    begin with it, by recursion."""
    choices = policy.ranked(placing_maps(policy.cell, state))[0].nonzero()[:, 0]
    if len(choices) == 0 or depth == 0:
        return choices.tolist(), [0.0] * len(choices)
    after, item = put_down(policy.cell, state.repeat(len(choices)), choices)
    after, _ = admit_coming_items(policy.cell, after)
    values = policy.evaluate_choices(state.repeat(len(choices)), choices)[2].tolist()
    if depth > 1 or after.coming is not None:
        later = [totals(policy, after.rows([row]), depth - 1)[1] for row in range(len(choices))]
        # Nothing follows where a full bin fits nowhere.
        ends = [0.0 if full else value for full, value in zip(after.items.exists.all(1).tolist(), values, strict=True)]
        own = zip(values, later, ends, strict=True)
        values = [value if depth == 1 and those else max(those, default=end) for value, those, end in own]
    return choices.tolist(), (policy.network.reward_scale * item.volume + torch.tensor(values)).tolist()


@pytest.mark.parametrize(("settings", "depth", "problems"), [
    (SEVERAL, 2, 8),
    ({**SEVERAL, "gripper": Overlap((1, 1)), "support": "full"}, 2, 8),
    pytest.param({**SEVERAL, "tote_size": (3, 3, 3)}, 3, 1, marks=pytest.mark.slow),
    ({**CONVEYOR, "tote_size": (3, 3, 2)}, 3, 2),
    (BOTH, 2, 1),
])  # fmt: skip
def test_a_wide_beam_finds_the_best_of_all_plans(settings, depth, problems):
    policy, decided = untrained(PickPlaceEnv(**settings).cell), 0
    for env, seen in states(3, **settings):
        beam, state = Beam(env.cell, policy, width=1000, depth=depth), State.from_observation(seen)
        decisions = policy.to_choice(beam.decide(seen), seen).tolist()
        for row, decision in enumerate(decisions):
            with torch.no_grad():
                choices, expected = totals(policy, state.rows([row]), depth)
            if choices:
                assert expected[choices.index(decision)] == pytest.approx(max(expected), abs=1e-4)
                decided += 1
            if decided == problems:
                return
    raise AssertionError("too few problems")


@pytest.mark.parametrize("settings", [SEVERAL, CONVEYOR, BOTH])
def test_problems_do_not_mix(settings):
    """Each problem of a batch is decided as alone, also where others have ended or need no more placements."""
    policy = untrained(PickPlaceEnv(**settings).cell)
    for env, seen in states(3, **settings):
        beam = Beam(env.cell, policy, width=3, depth=3)
        together = policy.to_choice(beam.decide(seen), seen)
        alone = [policy.to_choice(beam.decide(seen[row : row + 1]), seen[row : row + 1]) for row in range(len(seen))]
        assert torch.equal(together, torch.cat(alone))


numbers = st.integers(-(2**31), 2**31 - 1)


@given(st.lists(numbers, min_size=6, max_size=6), st.integers(0, 5), numbers, st.integers(0, 3))
def test_plans_are_the_same_if_tote_and_items_are(surface, place, other, problem):
    """Whatever the order of the items; one other cell, or an item at another place, makes another."""

    def number(surface, items, problem=problem):
        state = State(torch.tensor([surface]).view(1, 2, 3), torch.tensor([3]), Item.from_table(torch.tensor([items])))
        return _fingerprint(torch.tensor([problem]), state).item()

    items, none = [[0, 0, 2, 1, 1], [2, 0, 1, 2, 1]], [[0] * 5]
    found = number(surface, items + none)
    assert found == number(surface, items[::-1] + none)
    assert found != number(surface, items + none, problem + 1)
    assert found != number(surface, [items[0], [2, 1, 1, 2, 1], *none])
    assert found != number(surface, [items[0], *none, *none])
    changed = [*surface]
    changed[place] = other
    assert (found == number(changed, items + none)) == (changed == surface)


def test_plans_are_the_same_if_what_comes_is():
    """In its order."""
    state = State(torch.ones(1, 2, 3).int(), torch.tensor([3]), Item.from_table(torch.tensor([[[0, 0, 2, 1, 1]]])))
    queue = [[0, 0, 1, 1, 1], [1, 0, 2, 1, 1]]
    numbers = [
        _fingerprint(torch.tensor([0]), state._replace(coming=coming)).item()
        for coming in (None, *(Item.from_table(torch.tensor([rows])) for rows in (queue, queue[::-1], queue[:1])))
    ]
    assert len({*numbers}) == 4


@pytest.mark.parametrize(("preview", "depth", "batch", "place"), [
    (1, 2, 1, 4), (1, 1, 1, 4), (0, 2, 1, 0), (1, 1, 2, 0), (1, 2, 2, 0),
])  # fmt: skip
def test_a_plan_that_strands_what_comes_is_worth_what_it_places(preview, depth, batch, place):
    """A row of cells of which one is full. Only what goes to the last cell leaves room for an item of three cells,
    while the policy would keep that cell free at any cost. In a batch, an unseen item comes with it."""
    cell = CellSpec(
        (4, 1, 1), (5, 1, 1), Overlap((1, 1)), rotations=1, support="half", preview=preview, bin_items=batch,
        refill="batch",
    )  # fmt: skip
    policy = untrained(cell)
    policy.network.forward = lambda depth, *_: 1 + 10 * depth[:, 4, 0, None]
    single, long = [0, 0, 1, 1, 1], [0, 0, 3, 1, 1]
    items, coming = (Item.from_table(torch.tensor([rows])) for rows in ([single] + [[0] * 5] * (batch - 1), [long]))
    surface = surface_from(torch.tensor([[[0], [0], [0], [1], [0]]]))
    state = State(surface, torch.tensor([1]), items, coming=coming if preview else None)
    seen = observe(check_terms(None, cell), cell, state)
    assert policy.to_choice(Beam(cell, policy, depth=depth).decide(seen), seen).item() == place


def test_equal_outcomes_are_kept_once():
    """Two items of one size: whichever comes first, the same tote and an item at another place in the bin are left."""
    cell = CellSpec(tote_size=(4, 4, 3), bin_items=2, bin_size=(6, 6, 1), rotations=1, gripper=Overlap((1, 1)))
    policy, empty = untrained(cell), torch.full((1, 4, 4), EMPTY, dtype=torch.int32)
    items = Item.from_table(torch.tensor([[[0, 0, 2, 2, 1], [4, 4, 2, 2, 1]]]))
    state = State(empty, torch.tensor([3]), items)
    nothing = torch.zeros(1, dtype=torch.int64)
    plans = _Plans(nothing, nothing - 1, nothing, nothing.float(), state, nothing > 0)
    sizes = []
    with torch.no_grad():
        for _ in range(2):
            plans = Beam(cell, policy, width=1000)._longer(plans, policy.ranked(placing_maps(cell, plans.state)))
            sizes.append(len(plans.first))
    totes = {tuple(tote.flatten().tolist()) for tote in plans.state.surface}
    assert sizes[0] % 2 == 0 and sizes[1] == len(totes)  # at last both are in the tote, and nothing is in the bin


@pytest.mark.parametrize(("settings", "message"), [
    ({"width": 0}, "planner.width=0: expected a whole number >= 1"),
    ({"depth": 0}, "planner.depth=0: expected"),
    ({"budget": -1}, "planner.budget=-1: expected"),
])  # fmt: skip
def test_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Beam(CellSpec(), untrained(CellSpec()), **settings)


def test_policies_without_values_are_refused():
    with pytest.raises(ValueError, match="planner=beam: expected a checkpoint of model=afterstate"):
        Beam(CellSpec(), FcnGrasp(CellSpec(), filters=8, hidden=8))
