"""Loads: what lies on what, what each item still bears, and everything that must know it.

That masks, step and environment are those of the plain-Python oracle, ``tests/envs/test_env_oracle.py`` checks.
"""

import gymnasium
import pytest
import torch
from problems import SETTINGS, random_states

from pickplace import PickPlaceEnv
from pickplace.envs.saved_state import _is_possible, check_saved_states
from pickplace.items.distributions import Kinds
from pickplace.planners.lookahead import Lookahead
from pickplace.planners.mcts import MCTS
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.rules import pile as rules_of_piles
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import NO_LIMIT, Item
from pickplace.rules.masks import choice_mask, first_action_reaching, placing_maps
from pickplace.rules.observation import HANDLING_TERMS, ToteCapacity, observe, standard_terms
from pickplace.rules.pile import Pile
from pickplace.rules.state import EMPTY, Failure, State
from pickplace.rules.step import apply, put_down
from pickplace.runs.checkpoint import CheckpointError

POINT = {"effector_size": (1, 1), "pick_rule": "overlap", "support": "half", "handling": True, "rotations": 1}
HANDLING = {"grams": [100, 200, 300], "max_load": [0, 450, None], "turns": [None, [0, 2], None]}


def with_handling(settings):
    """Return settings of an environment whose items have handling instructions."""
    items = Kinds([(1, 1, 1), (2, 1, 1), (2, 2, 1)], **HANDLING)
    return {**settings, "items": items, "handling": True, "rotations": max(2, settings.get("rotations", 4))}


def same(one: State, other: State) -> bool:
    return one.surface.equal(other.surface) and all(a.equal(b) for a, b in zip(one.pile, other.pile, strict=True))


def test_a_load_counts_down_to_the_floor_and_beside():
    """A (bears 10) carries B (3) and C (2, bears 3). D (3) on B leaves A 2, so C bears 2 as well."""
    cell = CellSpec(bin_size=(4, 1, 1), tote_size=(4, 1, 9), most_items=6, **POINT)
    state = State(torch.full((1, 4, 1), EMPTY), torch.tensor([9]), Item(*torch.zeros(5, 1, 1).long()))
    state = state._replace(pile=Pile.empty(1, (4, 1), 6))

    def put(w, x, grams, max_load):
        item = Item(*(torch.tensor([[part]]) for part in (0, 0, w, 1, 1, -1, 1, grams, max_load)))
        step = apply(cell, state._replace(items=item), torch.tensor([x]))
        return Failure(int(step.failure)), state._replace(surface=step.surface, pile=step.pile)

    for w, x, grams, max_load, capacity in (
        (4, 0, 50, 10, [10, 10, 10, 10]),
        (1, 0, 3, NO_LIMIT, [7, 7, 7, 7]),
        (1, 2, 2, 3, [5, 5, 3, 5]),
        (1, 0, 3, NO_LIMIT, [2, 2, 2, 2]),
        (1, 3, 2, 0, [0, 0, 0, 0]),
    ):
        failure, state = put(w, x, grams, max_load)
        assert failure == Failure.NONE and state.pile.capacity.flatten().tolist() == capacity
    assert state.pile.below[0].int().tolist() == [
        [1, 0, 0, 0, 0, 0], [1, 1, 0, 0, 0, 0], [1, 0, 1, 0, 0, 0], [1, 1, 0, 1, 0, 0], [1, 0, 0, 0, 1, 0], [0] * 6,
    ]  # fmt: skip
    failure, after = put(1, 2, 1, 0)
    assert failure == Failure.OVERLOADED and same(after, state)
    assert put(1, 2, 0, 0)[0] == Failure.NONE
    assert [put(1, x, 0, 0)[0] for x in range(4)] == [Failure.NONE] * 4


@pytest.mark.parametrize("settings", [SETTINGS[0], SETTINGS[3], SETTINGS[6], SETTINGS[8]])
def test_placing_is_the_same_by_action_and_by_footprint_and_survives_an_observation(settings):
    overloaded = 0
    for env, _ in random_states(**with_handling(settings)):
        cell, state = env.cell, env.state
        seen = State.from_observation(observe(standard_terms(cell), cell, state))
        assert same(seen, state)
        assert all(one.equal(other) for one, other in zip(seen.items[6:], state.items[6:], strict=True))
        maps, free = (placing_maps(cell, each) for each in (state, state._replace(pile=None)))
        mask = choice_mask(cell, maps)
        overloaded += int((choice_mask(cell, free) & ~mask).sum())
        good = mask.any(1).nonzero()[:, 0]
        choice = torch.multinomial(mask[good].float(), 1, generator=torch.Generator().manual_seed(0))[:, 0]
        step = apply(cell, state.rows(good), first_action_reaching(cell, maps.rows(good), choice))
        after, _ = put_down(cell, state.rows(good), choice)
        assert not step.failure.any()
        assert same(after, state.rows(good)._replace(surface=step.surface, pile=step.pile))
        capacity = ToteCapacity(0.4).value(cell, state)
        assert (
            capacity.eq((state.pile.capacity / 1000).clamp(max=0.4)).all()
            and capacity.shape[1:] == env.surface.shape[1:]
        )
    assert overloaded > 20


@pytest.mark.parametrize("settings", [SETTINGS[0], SETTINGS[6]])
def test_capacity_needs_only_the_items_that_are_seen_from_above(settings, monkeypatch):
    """Of each item, counted one by one; also where no floor is seen any more."""
    piles = [env.state.pile for env, _ in random_states(**with_handling(settings))]
    piles.append(piles[0]._replace(labels=piles[0].labels.clamp(min=1)))
    for pile in piles:
        for many in (0, 10_000):
            monkeypatch.setattr(rules_of_piles, "MANY_ITEMS", many)
            for n in range(len(pile.labels)):
                expected = [
                    NO_LIMIT if label == 0 else min([*pile.spare[n][pile.below[n, label - 1]].tolist(), NO_LIMIT])
                    for label in pile.labels[n].flatten().tolist()
                ]
                assert pile.rows([n]).capacity.flatten().tolist() == expected
            assert pile.capacity.equal(torch.cat([pile.rows([n]).capacity for n in range(len(pile.labels))]))


def test_searches_know_the_loads():
    """In a tote of 2 x 1 x 3 two items lie side by side, and none on top."""
    items = Kinds([(1, 1, 1)], grams=[1], max_load=[0])
    env = PickPlaceEnv(items, num_envs=1, bin_size=(1, 1, 1), tote_size=(2, 1, 3), **POINT)
    observation = env.reset()
    for mask in (True, False):
        search = MCTS(env.cell, items, simulations=60, mask=mask)
        volume = search._play_out(env.state.repeat(50))
        assert volume.max() == 2 and (not mask or volume.min() == 2)
        root = search._nodes(env.state)[0]
        search._nodes = lambda *_, root=root, nodes=search._nodes: [root] if not root.edges else nodes(*_)
        search.decide(observation)
        returns = [edge.total / edge.visits for edge in root.edges.values()]
        assert max(returns) <= 2 / 6 + 1e-9 and (not mask or min(returns) == pytest.approx(2 / 6))
    torch.manual_seed(0)
    search = Lookahead(env.cell, FcnGrasp(env.cell, filters=8, hidden=8), items, horizon=None)
    volume = search._returns(State.from_observation(observation), torch.tensor([0]), torch.tensor([1]), 8, None)
    assert volume.tolist() == [[2.0] * 8]


def test_a_tote_without_room_for_another_item_takes_none():
    env = PickPlaceEnv(Kinds([(1, 1, 1)]), num_envs=1, bin_size=(1, 1, 1), tote_size=(2, 1, 3), **POINT)
    env.reset()
    state = env.state._replace(pile=Pile.empty(1, (2, 1), 1))
    after, _ = put_down(env.cell, state, torch.tensor([0]))
    state = state._replace(surface=after.surface, pile=after.pile)
    assert not choice_mask(env.cell, placing_maps(env.cell, state)).any()
    assert int(apply(env.cell, state, torch.tensor([1])).failure) == Failure.OVERLOADED


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda saved: saved["below"][:, 0].logical_not_(), "pile"),
        (lambda saved: saved["spare"].sub_(NO_LIMIT), "pile"),
        (lambda saved: saved["labels"].clamp_(max=0), "pile"),
        (lambda saved: saved["labels"].add_(1), "pile"),
        (lambda saved: saved["item"].select(2, 6).fill_(5), "item"),
    ],
)
def test_a_pile_that_no_episode_leads_to_is_refused(change, words):
    env = PickPlaceEnv(**with_handling({"num_envs": 4}))
    carried = env.reset()
    for _ in range(3):
        action = carried["action_mask"].int().argmax(1)
        _, carried = env.step_and_maybe_reset(carried.set("action", action))
    saved = {"environment": {key: value.clone() for key, value in env.state_dict().items()}, "carried": carried}
    check_saved_states(env, saved)
    change(saved["environment"])
    with pytest.raises(CheckpointError, match=f"of no use: {words}"):
        check_saved_states(env, saved)


@pytest.mark.parametrize(
    "change",
    [
        lambda pile: pile.below[0, 2, 0].fill_(False),  # what is below what is below
        lambda pile: pile.below[0, 0, 1].fill_(True),  # a later item
        lambda pile: pile.below[0, 3, 3].fill_(True),  # one that is not there
        lambda pile: pile.spare[0, 3].fill_(1),
        lambda pile: pile.spare[0, 0].fill_(-1),
        lambda pile: pile.labels[0, 1, 0].fill_(4),
        lambda pile: pile.labels[0, 1, 0].fill_(3),  # on two heights
    ],
)
def test_impossible_piles_by_hand(change):
    """The lowest item of a tower of three takes two cells; there is room for a fourth."""
    below = torch.tensor([[[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 0], [0, 0, 0, 0]]]).bool()
    pile = Pile(torch.tensor([[[3], [1]]]), torch.tensor([[0, 5, NO_LIMIT, 0]]), below)
    steps, heights = torch.tensor([3]), torch.tensor([[[3], [1]]], dtype=torch.int32)
    assert _is_possible(pile, steps, heights).tolist() == [True]
    change(pile)
    assert _is_possible(pile, steps, heights).tolist() == [False]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_load": [1, None]}, r"items.max_load=\[1, None\]: expected 3 whole numbers of grams >= 0, or null"),
        *(
            (
                {"grams": [1, 2, bad]},
                r"items.grams=\[1, 2, .*\]: expected 3 whole numbers from 0 to 10,000,000, ",
            )
            for bad in (-1, 10_000_001)
        ),
        ({"turns": [[0], [], None]}, r"items.turns=\[\[0\], \[\], None\]: expected 3 lists of some of \[0, 1, 2, 3\]"),
    ],
)
def test_bad_instructions_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Kinds([(1, 1, 1), (2, 1, 1), (2, 2, 1)], **settings)


def test_gymnasium_has_the_entries_of_handling():
    items = Kinds([(1, 1, 1), (2, 1, 1), (2, 2, 1)], **HANDLING)
    env = gymnasium.make("pickplace/PickPlace-v0", items=items, handling=True).unwrapped
    observation, info = env.reset(seed=0)
    for _ in range(12):
        assert env.observation_space.contains(observation) and set(HANDLING_TERMS) <= set(observation)
        observation, _, ended, *_, info = env.step(int(info["action_mask"].argmax()))
        if ended:
            break
    assert observation["pile_below"].any()


def test_limits_without_handling_are_refused():
    with pytest.raises(ValueError, match=r"env.handling=false: the items have greatest loads or turns of their own"):
        PickPlaceEnv(Kinds([(1, 1, 1)], max_load=[0]))
    with pytest.raises(ValueError, match=r"item 2x1x1 at x=0, y=0 in the bin has no feasible action"):
        PickPlaceEnv(Kinds([(2, 1, 1)], turns=[[1]]), handling=True, rotations=1)
