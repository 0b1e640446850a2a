"""Tree search: it approaches the exact optimum, it is a tree, and it never looks at the real stream."""

import pytest
import torch

from pickplace import PickPlaceEnv
from pickplace.evaluation.evaluate import play
from pickplace.planners import MCTS
from pickplace.planners.mcts import _Edge, _Node
from pickplace.task.items import Kinds, Recorded

OPTIMUM = 0.9456  # 4x4x1, R=4, see tests/test_optimum.py


def make_env(first, count, **settings):
    return PickPlaceEnv(
        num_envs=count, first_episode=first, stream="validation", masks=(), **{"tote_size": (4, 4, 1), **settings}
    )


def planner(simulations, **settings):
    env = make_env(0, 1)
    return MCTS(env.rules, env.items, simulations, **{"mask": True, "wave": 512, **settings})


def test_more_simulations_come_closer_to_the_optimum():
    few, many = planner(16), planner(300)
    worse, better = (play(make_env, each, 48, 48).occupancy for each in (few, many))
    noise = float(better.std() / 48**0.5)
    assert worse.mean() < better.mean() - 0.02
    assert OPTIMUM - 0.02 - 2 * noise < better.mean() < OPTIMUM + 3 * noise
    assert many.statistics()["mean_tree_depth"] > 1.5 > few.statistics()["mean_tree_depth"] >= 1


@pytest.mark.parametrize("mask", [True, False])
def test_visits_and_returns_add_up(mask):
    env = make_env(0, 1, tote_size=(4, 4, 2))
    search = MCTS(env.rules, env.items, 300, mask=mask, wave=7)
    roots = []
    make = search._nodes
    search._nodes = lambda *args: roots.append(make(*args)) or roots[-1]
    search.decide(env.reset())
    root = roots[0][0]
    assert sum(edge.visits for edge in root.edges.values()) == 300
    stack, seen = [root], 0
    while stack:
        node = stack.pop()
        for edge in node.edges.values():
            seen += 1
            assert 0 <= edge.total <= edge.visits
            assert len(edge.bins) <= edge.visits and (edge.failed <= (edge.total == 0))
            inside = sum(child.visits for bin_ in edge.bins for child in bin_.edges.values())
            assert inside <= edge.visits - len(edge.bins) or edge.failed  # the first visit to a bin plays it out
            stack += edge.bins
    assert seen > 10


def test_without_a_mask_it_tries_what_fails():
    env = make_env(0, 2)
    observation = env.reset()
    search = MCTS(env.rules, env.items, 200, mask=False)
    action = search.decide(observation)
    assert ((action >= 0) & (action < env.rules.num_actions)).all()
    # With far fewer simulations than actions nothing is tried twice: the paper's setting is nearly a random choice.
    assert search.statistics()["mean_tree_depth"] == 1


def test_the_same_seed_is_the_same_search():
    observation = make_env(0, 3).reset()
    actions = [planner(50, seed=seed).decide(observation).tolist() for seed in (1, 1)]
    assert actions[0] == actions[1]


def test_a_recorded_stream_is_not_looked_up(tmp_path):
    table = tmp_path / "items.csv"
    table.write_text("w,d,h\n1,1,1\n2,1,1\n")
    env = make_env(0, 1, items=Recorded(table))
    search = MCTS(env.rules, env.items, 20, mask=True)
    assert isinstance(search.items, Kinds) and search.items.length is None
    search.decide(env.reset())


def test_a_full_tote_has_nothing_to_search():
    env = make_env(0, 1)
    observation = env.reset()
    observation["tote_depth"] = torch.zeros_like(observation["tote_depth"])
    assert planner(20).decide(observation).tolist()[0] in range(env.rules.num_actions)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"simulations": 0}, "planner.simulations=0: expected a whole number >= 1"),
        ({"wave": 1.5}, "planner.wave=1.5"),
        ({"seed": -1}, "planner.seed=-1"),
        ({"exploration": -1}, "planner.exploration=-1: expected a number >= 0"),
        ({"widening": 2}, "planner.widening=2: expected a number >= 0 and <= 1"),
        ({"mask": 1}, "planner.mask=1: expected true or false"),
    ],
)
def test_bad_settings_are_refused(settings, words):
    env = make_env(0, 1)
    with pytest.raises(ValueError, match=words):
        MCTS(env.rules, env.items, **settings)


def test_what_was_tried_is_chosen_by_ucb1():
    env = PickPlaceEnv(num_envs=1, tote_size=(4, 4, 1))
    node = _Node(torch.zeros(4, 4), torch.zeros(5), [])
    node.edges = {n: _Edge(node, n, visits, visits * mean) for n, (visits, mean) in enumerate([(100, 0.6), (25, 0.45)])}
    # sqrt(ln 125 / n) is 0.220 and 0.439
    for weight, best in ((0, 0), (0.6, 0), (0.75, 1)):
        assert MCTS(env.rules, env.items, mask=True, exploration=weight)._choose(node).action == best


def test_the_most_visited_action_is_played():
    """And not one that was lucky once."""
    env = PickPlaceEnv(num_envs=1, tote_size=(4, 4, 1), masks=("outcome",))
    state = env.reset()
    often, lucky = state["outcome_mask"][0].nonzero()[:2, 0].tolist()
    search = MCTS(env.rules, env.items, 1, mask=True)
    root = _Node(env.heights[0], env.item[0], [])
    root.edges = {lucky: _Edge(root, lucky, 2, 1.9), often: _Edge(root, often, 90, 45.0)}
    search._nodes, search._walk_down = lambda *_: [root], lambda _: ([], True)
    placements = env.rules.placements(env.heights, env.tote_height, env.current_item)
    reaching = env.rules.actions_reaching(placements, torch.tensor([often]))[0]
    assert search.decide(state).item() == reaching[reaching >= 0].min()


@pytest.mark.parametrize("mask", [True, False])
def test_a_return_is_what_the_walk_places_and_its_rollout(mask):
    env = PickPlaceEnv(num_envs=1, tote_size=(4, 4, 2), masks=())
    search = MCTS(env.rules, env.items, 200, mask=mask, wave=7)
    roots, nodes = [], search._nodes
    search._nodes = lambda *args: roots.append(nodes(*args)) or roots[-1]
    search._play_out = lambda heights, *_: torch.zeros(len(heights), dtype=torch.float64)
    search.decide(env.reset())
    stack, placed = [roots[0][0]], 0
    while stack:
        for edge in stack.pop().edges.values():
            below = sum(child.total for node in edge.bins for child in node.edges.values())
            assert edge.total == pytest.approx(edge.visits * edge.volume / 32 + below)
            placed += edge.volume > 0
            stack += edge.bins
    assert placed
