"""``model=afterstate``: the totes that it judges, its network, and TD(lambda) against sums by hand."""

from functools import partial
from statistics import mean
from types import SimpleNamespace

import pytest
import torch
from commands import composed
from dynamic_programming import optimal_occupancy
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf
from problems import SETTINGS, late_state, random_states
from tensordict import TensorDict

from pickplace import PickPlaceEnv
from pickplace.algorithms.td import totes_left, with_targets
from pickplace.config.registry import build
from pickplace.evaluation.play import play
from pickplace.items.distributions import Uniform
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.afterstate import cells
from pickplace.policies.afterstate.cells import CellsValue
from pickplace.policies.afterstate.picture import PictureValue
from pickplace.policies.afterstate.policy import Afterstate, AfterstateFcn
from pickplace.policies.restore import restore_critic, restore_policy
from pickplace.rules.bin import admit_coming_items
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import footprint_index
from pickplace.rules.masks import placing_maps
from pickplace.rules.observation import SeenItems, observe
from pickplace.rules.state import State
from pickplace.rules.step import apply, put_down
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate
from pickplace.training.train import train

SMALL = {
    Afterstate: {"grid": (6, 5, 4), "filters": 4, "hidden": 8},
    AfterstateFcn: {"depth_range": 4, "stem": 4, "filters": 8},
}


def weigh(net, std=3.0):
    """Let a network's value depend on everything that it sees."""
    torch.nn.init.normal_(net.head.weight, std=std)
    torch.nn.init.normal_(net.waiting.sum.weight, std=0.3)


def left_in_bins(state, taken, tipping):
    """Return a table of bins without an item each, in all its poses, and of what comes, by plain Python."""
    rows = []
    for row, number in enumerate(taken.tolist()):
        bin_ = state.items.cuboids[row].tolist()
        coming = [] if state.coming is None else state.coming.cuboids[row].tolist()
        gone = {number // 3 * 3 + pose for pose in range(3)} if tipping else {number}
        kept = [item for place, item in enumerate(bin_) if place not in gone]
        rows.append(kept + [[0] * 5] * len(gone) + coming)
    return torch.tensor(rows)


@pytest.mark.parametrize("kind", SMALL)
@pytest.mark.parametrize("options", SETTINGS)
def test_a_score_is_the_items_volume_and_the_value_of_what_the_step_leaves(kind, options):
    """Up to the volume of the largest item in the bin."""
    torch.manual_seed(0)
    settings = {**options, "masks": ("action", "corner")}
    policy = kind(PickPlaceEnv(**settings).cell, temperature=0.5, compute_dtype="float32", **SMALL[kind])
    weigh(policy.network)
    for env, observation in random_states(4, **settings):
        with torch.no_grad():
            largest = env.state.items.volume.amax(1, keepdim=True)
            choice = policy.logits(observation).argmax(1)
            score = policy.logits(observation).gather(1, choice[:, None])
            left = left_in_bins(env.state, choice // env.cell.num_footprints, env.cell.tipping)
            data = env.step(observation.clone().set("action", policy.to_action(choice, observation)))
            after = data["next"].set("items", left)
            value = policy.network(*(after[key] for key in policy.network.in_keys))
        torch.testing.assert_close(2 * (value + after["reward"] - largest), score)
        batch = data.set(policy.choice_key, choice).unsqueeze(1)
        assert torch.equal(totes_left(batch, policy)["items"][:, 0], left)


@pytest.mark.parametrize("kind", SMALL)
def test_what_waits_is_one_set(kind):
    """The value is the same before and after what is seen has arrived; it depends on what comes, in any number."""
    torch.manual_seed(0)
    settings = {"tote_size": (5, 5, 4), "bin_items": 3, "bin_size": (9, 9, 1), "preview": 2}
    env, observation = late_state(4, items=Uniform((1, 3), (1, 3), (1, 2)), **settings)
    policy = kind(env.cell, compute_dtype="float32", **SMALL[kind])
    weigh(policy.network)
    choice = observation["action_mask"].int().argmax(1)
    left, _ = put_down(env.cell, env.state, policy.to_choice(choice, observation))
    assert left.items.exists.sum(1).min() < 3

    def value(state):
        seen = observe({**env.terms, "items": SeenItems()}, env.cell, state, policy.network.in_keys)
        with torch.no_grad():
            return policy.network(*(seen[key] for key in policy.network.in_keys))[:, 0]

    torch.testing.assert_close(value(admit_coming_items(env.cell, left)[0]), value(left), rtol=1e-5, atol=1e-3)
    fewer = left._replace(coming=left.coming.rows((slice(None), slice(0, 1))))
    assert ((value(fewer) - value(left)).abs() > 1e-2).all()
    assert ((value(left._replace(coming=None)) - value(left)).abs() > 1e-2).all()


@pytest.mark.parametrize("kind", SMALL)
@pytest.mark.parametrize("options", [
    {"tote_size": (4, 3, 3)}, {"tote_size": (4, 4, 2), "rotations": 1},
    {"tote_size": (4, 3, 3), "bin_items": 3, "bin_size": (6, 6, 2)},
])  # fmt: skip
def test_an_action_has_an_even_share_of_its_totes_probability(kind, options):
    """Against the single step: of the feasible actions, those that leave the same tote as a choice of the policy."""
    torch.manual_seed(0)
    settings = {**options, "masks": ("action", "corner"), "num_envs": 3}
    policy = kind(PickPlaceEnv(**settings).cell, compute_dtype="float32", temperature=1.0, **SMALL[kind])
    weigh(policy.network)
    for env, observation in random_states(3, **settings):
        with torch.no_grad():
            found = policy.action_log_probs(observation).exp()
            wanted = policy.logits(observation).softmax(1)
        for row in range(3):
            leads_to: dict[int, list[int]] = {}
            for action in observation["action_mask"][row].nonzero()[:, 0].tolist():
                step = apply(env.cell, env.state.rows([row]), torch.tensor([action]))
                x, y, w, d = step.footprint[0].tolist()
                item, number = env.state.items.rows((row, int(step.taken))), int(step.taken)
                turned = int((w, d) != (item.w, item.d))
                choice = number * env.cell.num_footprints + int(footprint_index(env.cell.tote_size, turned, x, y))
                leads_to.setdefault(choice, []).append(action)
            expected = torch.zeros(env.cell.num_actions)
            for choice, actions in leads_to.items():
                expected[actions] = wanted[row, choice] / len(actions)
            torch.testing.assert_close(found[row], expected)


def network(**settings):
    torch.manual_seed(0)
    small = {"grid": (6, 5, 4), "filters": 4, "hidden": 8, "compute_dtype": "float32"}
    net = PictureValue(**{**small, **settings})
    weigh(net)
    return net


def random_items(count, most=3):
    """Return tables of 0 to 3 items, each with rows of zeros at the end."""
    generator = torch.Generator().manual_seed(3)
    items = torch.randint(1, 4, (count, most, 5), generator=generator)
    return items * (torch.arange(most) < torch.randint(0, most + 1, (count, 1), generator=generator))[..., None]


def random_totes(count, wide, deep, high):
    depth = torch.randint(0, high + 1, (count, wide, deep), generator=torch.Generator().manual_seed(1)).float()
    return depth, torch.full((count, 1), high)


@pytest.mark.parametrize("scale", [1, 3, 10])
def test_a_finer_grid_shows_the_same_tote(scale):
    net, (depth, height), items = network(), random_totes(20, 6, 5, 4), random_items(20)
    finer = scale * depth.repeat_interleave(scale, 1).repeat_interleave(scale, 2)
    with torch.no_grad():
        value = net(depth, height, items)
        torch.testing.assert_close(net(finer, scale * height, scale * items), scale**3 * value)
        assert value.std() > 1 and (value >= 0).all() and (value[:, 0] <= depth.sum((1, 2))).all()


def test_heights_are_told_apart_at_whole_steps_of_the_tote():
    """By plain comparisons of fractions: step k of 4 is passed where height / tote height > k / 4."""
    net, (depth, height) = network(), random_totes(3, 6, 5, 7)
    picture = net._planes(net._picture(depth, height[:, 0]), torch.float32)
    for n, x, y, k in torch.cartesian_prod(*map(torch.arange, (3, 6, 5, 4))).tolist():
        assert picture[n, k, x, y] == (4 * (7 - int(depth[n, x, y])) > 7 * k)
    assert picture[:, 4].all()


def test_edges_are_where_the_surface_is_not_level():
    """By plain comparisons with the cell before; the wall before the first cell is an edge."""
    net, (depth, height) = network(), random_totes(10, 6, 5, 2)
    picture = net._planes(net._picture(depth, height[:, 0]), torch.float32)
    for n, x, y in torch.cartesian_prod(*map(torch.arange, (10, 6, 5))).tolist():
        assert picture[n, 5, x, y] == (x == 0 or depth[n, x, y] != depth[n, x - 1, y])
        assert picture[n, 6, x, y] == (y == 0 or depth[n, x, y] != depth[n, x, y - 1])


@given(
    sides=st.tuples(st.integers(2, 9), st.integers(2, 9)),
    grid=st.tuples(st.integers(2, 7), st.integers(2, 7), st.integers(1, 6)),
    field=st.sampled_from([1, 3, 5]),
    high=st.integers(1, 9),
)
def test_a_value_without_gradients_is_that_of_the_convolution(sides, grid, field, high):
    """Without them a CPU finds the first convolution's terms in a table."""
    net, (depth, height) = network(grid=grid, receptive_field=field), random_totes(5, *sides, high)
    torch.nn.init.normal_(net.around.bias)
    with_gradients = net(depth, height, random_items(5))
    with torch.no_grad():
        torch.testing.assert_close(net(depth, height, random_items(5)), with_gradients)


@pytest.mark.parametrize(
    ("wide", "sides", "views"), [(5, (5, 5), 8), (6, (6, 5), 4), (5, (10, 10), 8), (5, (5, 10), 4)]
)
def test_a_tote_is_learnt_from_every_side(wide, sides, views):
    """A square picture of a tote that is not square is not turned, as the sides of items look different in it."""
    net, (depth, height) = network(grid=(wide, 5, 4)), random_totes(1, *sides, 4)
    expected = {tuple(view.flatten().tolist()) for turned in (depth[0], depth[0].t())[: views // 4]
                for view in (turned, turned.flip(0), turned.flip(1), turned.flip(0, 1))}  # fmt: skip
    seen = [net.random_view(depth, height, 2 * depth) for _ in range(200)]
    assert {tuple(view.flatten().tolist()) for view, _, _ in seen} == expected
    assert all(torch.equal(2 * view, target) and same is height for view, same, target in seen)
    plain = network(grid=(wide, 5, 4), mirrored=False)
    assert all(plain.random_view(depth)[0] is depth for _ in range(20))


def cells_network(**settings):
    torch.manual_seed(0)
    small = {"depth_range": 4, "stem": 4, "filters": 8, "compute_dtype": "float32"}
    net = CellsValue(**{**small, **settings})
    weigh(net, 1.0)
    return net


def random_bearing(depth):
    return (torch.rand(depth.shape, generator=torch.Generator().manual_seed(2)) < 0.8).float()


def test_planes_of_the_cells_by_plain_comparisons():
    net, (depth, _) = cells_network(level=2, halvings=2), random_totes(4, 6, 5, 9)
    bearing = random_bearing(depth)
    planes = net._planes(depth, bearing, torch.float32)
    assert planes.shape == (4, 7, 6, 5)
    for n, x, y in torch.cartesian_prod(*map(torch.arange, (4, 6, 5))).tolist():
        here = float(depth[n, x, y])
        assert planes[n, :4, x, y].tolist() == [min(max(here / 2 - k, 0), 1) for k in range(4)]
        assert planes[n, 4, x, y] == 1 - bearing[n, x, y]
        assert planes[n, 5, x, y] == (here != (float(depth[n, x - 1, y]) if x else 0))
        assert planes[n, 6, x, y] == (here != (float(depth[n, x, y - 1]) if y else 0))


@pytest.mark.parametrize(("patch", "halvings", "layers"), [(1, 1, 2), (1, 2, 0), (2, 1, 1), (3, 0, 1)])
def test_cells_of_any_tote_take_a_share_of_what_is_above_them(patch, halvings, layers, monkeypatch):
    net = cells_network(patch=patch, halvings=halvings, layers=layers, reward_scale=0.5)
    for wide, deep in ((6, 6), (5, 7), (1, 9), (11, 4)):
        (depth, _), items = random_totes(20, wide, deep, 9), random_items(20)
        entries = depth, random_bearing(depth), items
        with torch.no_grad():
            parts = net.parts(*entries)
            share = parts[depth > 0] / (0.5 * depth[depth > 0])
            assert parts.shape == depth.shape and (parts >= 0).all() and 0 < share.min() < share.max() < 1
            value = net(*(entry.unflatten(0, (4, 5)) for entry in entries))
            torch.testing.assert_close(value, parts.sum((1, 2)).view(4, 5, 1))
            monkeypatch.setattr(CellsValue, "cells_at_once", {"cpu": 3 * wide * deep})
            torch.testing.assert_close(net.parts(*entries), parts)


@pytest.mark.parametrize(("wide", "deep"), [(6, 6), (5, 7)])
def test_a_tote_is_worth_the_same_from_every_side(wide, deep):
    """In evaluation mode: the mean of the eight views, whose own values differ."""
    net = cells_network(all_views=True)
    maps = random_totes(3, wide, deep, 9)[0], random_bearing(torch.empty(3, wide, deep))
    flips = [[entry.flip(axes) for entry in maps] for axes in ((), (1,), (2,), (1, 2))]
    items = random_items(3)
    turned = items[..., [1, 0, 3, 2, 4]]  # their sides change with those of the tote
    views = [[*view, items] for view in flips] + [
        [*(entry.transpose(1, 2) for entry in view), turned] for view in flips
    ]
    with torch.no_grad():
        each = torch.stack([net(*view) for view in views])
        assert (each.std(0) > 1e-3).all()
        net.eval()
        for view in views:
            torch.testing.assert_close(net(*view), each.mean(0))
        assert torch.equal(cells_network(mirrored=False, all_views=True).eval()(*maps, items), each[0])


def test_beyond_the_horizon_only_the_volume_counts():
    """A tote that ends deep below its horizon looks like one that ends there; training looks at the whole depth."""
    near, far = cells_network(horizon=3.5, level=2.0, reward_scale=0.5), cells_network(level=2.0, reward_scale=0.5)
    depth = torch.stack([torch.tensor([4.0, 6.0, 8.0, 10.0] * 6)[torch.randperm(24)].view(6, 4) for _ in range(5)])
    others = random_bearing(depth), random_items(5)

    def judged(before, after):
        heights, height = before.amax() - before, before.amax().expand(5)
        return near.judge(SimpleNamespace(tote_height=height, heights=heights), after, *others)

    with torch.no_grad():
        assert torch.equal(judged(depth + 9, depth + 9), far(depth + 9, *others))
        near, far = near.eval(), far.eval()
        assert torch.equal(judged(depth + 7, depth + 7), far(depth + 7, *others))  # twice the horizon
        for levels in (4, 1000):
            deep, beyond = depth + 2 * levels, 0.5 * cells.FILLED_BEYOND * 24 * 2 * levels
            torch.testing.assert_close(judged(deep, deep), far(depth, *others) + beyond)
            torch.testing.assert_close(judged(deep + 1.5, deep + 1.5), far(depth + 1.5, *others) + beyond)
            # Placements that differ in the volume under them are judged by the same part of the tote.
            torch.testing.assert_close(judged(deep, deep - 3), far(depth - 3, *others) + beyond)
        full = depth + 8
        full[:, 3, 3] = 3  # a column whose top is above the lowered tote
        lowered = (full - 8).clamp(min=0)
        beyond = 0.5 * cells.FILLED_BEYOND * (full - lowered).sum((1, 2))[:, None]
        torch.testing.assert_close(judged(depth + 8, full), far(lowered, *others) + beyond)


class Empty(PictureValue):
    """A network whose value is the empty volume, in one part or of each cell, to compute targets by hand."""

    in_keys = ("tote_depth",)

    def chunk_parts(self, depth):
        return depth.sum((1, 2))[:, None]


class EmptyCells(CellsValue):
    in_keys = ("tote_depth",)

    def chunk_parts(self, depth):
        return depth


def steps_of(values, reward, done):
    """Return totes ``[N, T]`` of these values, which steps left."""
    depth = values[..., None, None].expand(*values.shape, 1, 1)
    after = {"tote_depth": depth, "reward": reward[..., None], "done": done[..., None]}
    return TensorDict(after, batch_size=values.shape)


def test_targets_by_hand():
    """Three totes in a row; after the second of the other row the item that arrives has no place."""
    values = torch.tensor([[5.0, 7, 11], [13, 17, 19]])
    reward = torch.tensor([[1.0, 2, 4], [8, 16, 32]])
    done = torch.tensor([[False, False, False], [False, True, False]])
    data = with_targets(steps_of(values, reward, done), Empty(reward_scale=0.1), gamma=0.5, lmbda=0.25)
    second = 0.4 + 0.5 * 11
    first = 0.2 + 0.5 * (0.75 * 7 + 0.25 * second)
    other = 1.6 + 0.5 * (0.75 * 17 + 0.25 * 0)
    assert data["value_target"][:, 0].tolist() == pytest.approx([first, second, other, 0])
    assert data["tote_depth"][:, 0, 0].tolist() == [5, 7, 13, 17]


def test_a_reward_is_earned_by_the_cells_that_the_item_covers():
    """An item of volume 6 comes to lie on two cells of three, after which the tote takes no other; by hand."""
    depth = torch.tensor([[[9.0, 9, 5], [6, 6, 5], [6, 6, 2]]])[..., None]
    after = {"tote_depth": depth, "reward": torch.tensor([[[9.0], [6], [2]]])}
    after["done"] = torch.tensor([[[False], [False], [True]]])
    batch = TensorDict(after, batch_size=(1, 3))
    network = EmptyCells(reward_scale=0.1)
    target = with_targets(batch, network, gamma=0.5, lmbda=0.25)["value_target"][..., 0]
    last = [0.5 * 6, 0.5 * 6, 0.2 + 0.5 * 2]
    first = [0.3 + 0.5 * (0.75 * 6 + 0.25 * last[0])] * 2 + [0.5 * (0.75 * 5 + 0.25 * last[2])]
    torch.testing.assert_close(target, torch.tensor([first, last]))


@pytest.mark.parametrize("length", [2, 16])
@pytest.mark.parametrize("lmbda", [0.0, 0.8, 1.0])
def test_the_true_value_is_where_targets_agree_with_it(lmbda, length):
    """Each item has a place with probability 3/4 and a reward of 1: 3 items follow on average."""
    done = torch.rand(20_000, length, generator=torch.Generator().manual_seed(0)) < 0.25
    data = with_targets(steps_of(torch.full(done.shape, 3.0), torch.ones(done.shape), done), Empty(), 1.0, lmbda)
    assert data["value_target"].mean().item() == pytest.approx(3.0, abs=0.06)


@pytest.mark.parametrize("model", [
    ["model=afterstate", "model.actor.grid=[3,3,1]", "model.actor.filters=16", "model.actor.hidden=32"],
    pytest.param(["model=afterstate_fcn", "model.actor.stem=16", "model.actor.filters=32", "algo.epochs=8"],
                 marks=pytest.mark.slow),
])  # fmt: skip
def test_it_comes_within_1_percent_of_the_optimum(model, tmp_path):
    words = ["experiment=afterstate", *model, "env.tote_size=[3,3,1]", "env.rotations=2"]
    words += ["items=kinds", "env.num_envs=64", "logger=none"]
    words += ["total_frames=16_384", "algo.minibatch_size=128", "algo.lr=3e-3", "reward_scale=0.5"]
    words += ["evaluation.episodes=1"]
    cfg = composed(*words)
    train(cfg, tmp_path)
    state, _ = checkpoint.read(tmp_path / "checkpoints" / "last")
    assert all(torch.equal(state["policy"][f"network.{key}"], value) for key, value in shared(state).items())

    def make_env(first, count):
        sizes = {"tote_size": (3, 3, 1), "rotations": 2, "num_envs": count}
        return PickPlaceEnv(stream="test", first_episode=first, masks=(), **sizes)

    cell = make_env(0, 1).cell
    policy = checkpoint.restore(
        partial(build, "model.actor", cfg.model.actor, cell=cell, mask_infeasible=True), state["policy"], "policy"
    )
    occupancy = play(make_env, PolicyPlanner(cell, policy), 2000, 1000).occupancy
    assert mean(occupancy.tolist()) > 0.99 * optimal_occupancy(3, 3, 2)


def shared(state):
    return {key.removeprefix("module."): value for key, value in state["critic"].items()}


@pytest.mark.parametrize(("words", "refusal"), [
    (["model=afterstate"], "algo='PPO': expected algo=td"),
    (["algo=td"], "algo='td': expected model=afterstate"),
    (["model=afterstate", "algo=td", "warm_start=imitate"], "warm_start.frames=200000: expected 0"),
    (["model=afterstate", "algo=td", "+algo.samples=2"], "algo.samples: there is no key"),
    (["model=afterstate", "algo=td", "rollout_length=1"], "rollout_length=1: expected a whole number >= 2"),
    (["model=afterstate", "algo=td", "warm_start.critic_frames=64"], "warm_start.critic_frames=64: expected 0"),
    (["model=afterstate", "algo=td", "model.mask_infeasible=false"], "model.mask_infeasible=False: expected true"),
    (["model=afterstate", "algo=td", "model.actor.grid=[10,10]"], r"model.actor.grid=\[10, 10\]: expected 3"),
    (["model=afterstate", "algo=td", "model.actor.grid=[10,1,10]"], r"model.actor.grid=\[10, 1, 10\]: expected at le"),
    (["model=afterstate", "algo=td", "model.actor.reward_scale=1"], "model.actor.reward_scale=1: expected reward_s"),
    (["model=afterstate", "algo=td", "model.critic={_target_: pooled}"], "model.critic=.*pooled.*: expected null"),
    (["model=afterstate", "algo=td", "model.actor.temperature=0"], "model.actor.temperature=0: expected a number"),
    (["model=afterstate", "algo=td", "reach=annulus"], "model.actor.mirrored=True: expected false: the robot's reach"),
])  # fmt: skip
def test_settings_that_do_not_fit_are_refused(words, refusal, tmp_path):
    with pytest.raises(ValueError, match=f"^{refusal}"):
        train(composed(*words), tmp_path)


def test_it_serves_other_totes():
    policy = Afterstate(CellSpec(tote_size=(9, 7, 6)), grid=(6, 5, 4), filters=4, hidden=8)
    env = PickPlaceEnv(num_envs=3, tote_size=(9, 7, 6), masks=())
    seen = env.reset()
    maps = placing_maps(policy.cell, State.from_observation(seen))
    assert (env.step(seen.set("action", policy.best_feasible(seen, maps)))["next", "failure"] == 0).all()


def test_shipped_weights_judge_for_a_search_and_begin_a_training(tmp_path):
    state, facts = checkpoint.read(locate("pretrained/gopt_rs"))
    cfg = OmegaConf.create({**facts["config"], "device": "cpu"})
    policy = restore_policy(cfg, CellSpec(tote_size=(10, 10, 10), rotations=2), state["policy"], facts["config"]["env"])
    (depth, height), items = random_totes(3, 10, 10, 10), random_items(3)
    with torch.no_grad():
        critic = restore_critic(cfg, policy, state, facts["config"]["env"])
        found = critic({"tote_depth": depth, "tote_height": height, "items": items})
        assert torch.equal(found, policy.network(depth, height, items) / 0.01)
    words = ["experiment=afterstate", "benchmark=gopt_rs", "warm_start.weights=pretrained/gopt_rs", "algo.lr=0"]
    words += ["env.num_envs=2", "rollout_length=2", "total_frames=4", "evaluation.episodes=1", "logger=none"]
    train(composed(*words), tmp_path)
    trained, _ = checkpoint.read(tmp_path / "checkpoints" / "last")
    assert all(torch.equal(trained["policy"][key], value) for key, value in state["policy"].items())
