"""The stability rule of PCT's code, against hulls by SciPy and loads that are handed down from the top."""

from collections import Counter
from itertools import pairwise
from random import Random

import pytest
import torch
from scipy.spatial import ConvexHull

from pickplace import PickPlaceEnv, State
from pickplace.envs.saved_state import check_saved_states
from pickplace.items.distributions import Uniform
from pickplace.planners.beam import _fingerprint
from pickplace.planners.mcts import MCTS, _stack, _unstack
from pickplace.robot.planner import Planner
from pickplace.rules.gripper.rules import Contain
from pickplace.rules.masks import action_footprints, action_mask, placing_maps
from pickplace.rules.step import apply
from pickplace.rules.support.pct import _Pile
from pickplace.runs.locate import CheckpointError

GRID = 8


def touching(box, other):
    """The area that two boxes share, as least and greatest x and y, if the first lies on the second; else None."""
    (x, y, z, w, d, _), (u, v, t, a, b, c) = box, other
    area = max(x, u), max(y, v), min(x + w, u + a), min(y + d, v + b)
    return area if z == t + c and area[0] < area[2] and area[1] < area[3] else None


def margins(pile):
    """How far the load of each box above the floor is inside the hull of what carries it, less a tenth; in cells.

    The loads are handed down once, from the topmost box to the lowest. None if that code's hulls depend on rounding.
    """
    loads = {box: [(box[0] + box[3] / 2, box[1] + box[4] / 2, box[3] * box[4] * box[5])] for box in pile}
    found = {}
    for box in sorted(pile, key=lambda box: -box[2]):
        mass = sum(part[2] for part in loads[box])
        x, y = (sum(part[axis] * part[2] for part in loads[box]) / mass for axis in (0, 1))
        below = {other: area for other in pile if (area := touching(box, other))}
        if not below:
            continue
        corners = [(u, v) for a, b, c, d in below.values() for u in (a, c) for v in (b, d)]
        points = [corners[number] for number in ConvexHull(corners).vertices]
        if any(distance_inside(corner, points) == 0 for corner in {*corners} - {*points}):
            return None  # on an edge: whether that code takes it for a corner is up to rounding
        mean = [sum(part) / len(points) for part in zip(*points, strict=True)]
        points = [[p - (p - m) / 10 for p, m in zip(point, mean, strict=True)] for point in points]
        found[box] = distance_inside((x, y), points)
        for other, part in zip(below, shares((x, y), [*below.values()]), strict=True):
            middle = (below[other][0] + below[other][2]) / 2, (below[other][1] + below[other][3]) / 2
            loads[other].append((*((x, y) if part == 1 else middle), mass * part))
    return found


def distance_inside(point, polygon):
    """The distance from a point to the nearest edge of a polygon that runs counter-clockwise; below 0 outside."""
    (x, y), edges = point, pairwise([*polygon, polygon[0]])
    return min(
        ((c - a) * (y - b) - (d - b) * (x - a)) / ((c - a) ** 2 + (d - b) ** 2) ** 0.5 for (a, b), (c, d) in edges
    )


def shares(centre, areas):
    """The part of a load on each contact, of up to two."""
    over = [a < centre[0] < c and b < centre[1] < d for a, b, c, d in areas]
    if len(areas) == 1 or any(over):
        return [float(number == (over.index(True) if any(over) else 0)) for number in range(len(areas))]
    (p, q), (r, s) = (((a + c) / 2, (b + d) / 2) for a, b, c, d in areas)
    along = ((centre[0] - p) * (r - p) + (centre[1] - q) * (s - q)) / ((r - p) ** 2 + (s - q) ** 2)
    return [abs(1 - along), abs(along)]


def paths(pile, box):
    """How many ways lead from a box to the floor."""
    below = [other for other in pile if touching(box, other)]
    return sum(paths(pile, other) for other in below) if below else 1


def random_pile(random, count):
    """Boxes that were put down at random, each where it is stable."""
    pile = []
    for _ in range(count):
        w, d, h = (random.randint(1, 5) for _ in range(3))
        x, y = random.randint(0, GRID - w), random.randint(0, GRID - d)
        tops = [b[2] + b[5] for b in pile if b[0] < x + w and x < b[0] + b[3] and b[1] < y + d and y < b[1] + b[4]]
        box = (x, y, max(tops, default=0), w, d, h)
        if box[2] == 0 or _Pile(pile).bears(box):
            pile.append(box)
    return pile


def test_loads_that_are_handed_down():
    """The last box is stable exactly if all loads are inside; some near an edge are left out, as both round."""
    outcomes, exact = Counter(), 0
    for seed in range(60):
        random = Random(seed)
        pile = random_pile(random, 14)
        for _ in range(40):
            w, d, h = (random.randint(1, 5) for _ in range(3))
            x, y = random.randint(0, GRID - w), random.randint(0, GRID - d)
            z = max((b[2] + b[5] for b in pile if touching((x, y, b[2] + b[5], w, d, h), b)), default=0)
            box = (x, y, z, w, d, h)
            if z == 0 or any(sum(bool(touching(a, b)) for b in [*pile, box]) > 2 for a in [*pile, box]):
                continue  # loads on three and more are shared by least squares
            found = margins([*pile, box])
            if found is None or min(map(abs, found.values())) < 1e-4:
                continue
            stable, inside = _Pile(pile).bears(box), min(found.values()) > 0
            assert stable <= inside
            if all(paths([*pile, box], each) == 1 for each in [*pile, box]):
                assert stable == inside
                exact += 1
            outcomes[stable] += 1
    assert min(outcomes[True], outcomes[False], exact) > 50, (outcomes, exact)


@pytest.mark.parametrize(
    ("pile", "box", "stable"),
    [
        ([(0, 0, 0, 4, 4, 1)], (0, 0, 1, 4, 4, 1), True),
        ([(0, 0, 0, 4, 4, 1)], (2, 0, 1, 4, 4, 1), False),  # its centre is above the edge
        ([(0, 0, 0, 5, 4, 1)], (2, 0, 1, 5, 4, 1), True),  # 4.5 of 2 to 5, made smaller: 2.15 to 4.85
        ([(0, 0, 0, 11, 4, 1)], (0, 0, 1, 21, 4, 1), False),  # 10.5 of 0 to 11, made smaller: 0.55 to 10.45
        ([(0, 0, 0, 4, 4, 1), (2, 0, 1, 3, 4, 3)], (3, 0, 4, 3, 4, 1), True),  # both together at 3.75 of 2.1 to 3.9
        ([(0, 0, 0, 4, 4, 1), (2, 0, 1, 3, 4, 1)], (3, 0, 2, 3, 4, 1), False),  # at 4.0: tips the box below
    ],
)
def test_by_hand(pile, box, stable):
    assert _Pile(pile).bears(box) == stable


def test_high_piles():
    """A tower has no limit; crossed planks have too many paths to the floor to try each."""
    assert _Pile([(0, 0, z, 4, 4, 1) for z in range(700)]).bears((0, 0, 700, 4, 4, 1))
    along, across = [(0, 0, 2, 8), (6, 0, 2, 8)], [(0, 0, 8, 2), (0, 6, 8, 2)]
    layers = [[(x, y, z, w, d, 1) for x, y, w, d in (across, along)[z % 2]] for z in range(12)]
    low, high = (_Pile(box for layer in layers[:count] for box in layer) for count in (6, 12))
    assert low.bears((0, 0, 6, 8, 8, 1)) and low.bears((0, 0, 6, 8, 8, 1))
    assert not high.bears((0, 0, 12, 8, 8, 1))


def test_rounding_as_in_that_code():
    """A load of 15 with its centre at y = 5.1, where the hull ends: it is inside there by the last digit."""
    pile = [
        (3, 5, 0, 4, 2, 2), (1, 0, 0, 4, 2, 5), (6, 1, 0, 4, 4, 3), (7, 5, 0, 2, 5, 5), (9, 0, 3, 1, 5, 1),
        (5, 4, 2, 1, 3, 1), (7, 5, 5, 1, 5, 4), (1, 7, 0, 4, 2, 4),
    ]  # fmt: skip
    assert _Pile(pile).bears((5, 3, 3, 2, 3, 4))


@pytest.fixture
def env():
    cell = {"bin_size": (4, 3, 1), "tote_size": (6, 5, 6), "gripper": Contain((4, 3)), "rotations": 2, "support": "pct"}
    return PickPlaceEnv(Uniform((1, 4), (1, 3), (1, 3)), num_envs=3, seed=4, **cell)


def test_masks_are_what_a_step_accepts(env):
    observation, refused = env.reset(), 0
    for _ in range(5):
        state = State.from_observation(observation)
        assert state.boxes.equal(env.state.boxes)
        mask = action_mask(env.cell, placing_maps(env.cell, state))
        assert mask.equal(observation["action_mask"])
        count = env.cell.num_actions
        failure = apply(env.cell, state.repeat(count), torch.arange(count).repeat(3)).failure.view(3, count)
        assert mask.equal(failure == 0)
        refused += int((failure == 6).sum())
        draw = torch.where(mask, torch.rand(mask.shape, generator=torch.Generator().manual_seed(0)), -1.0)
        step = env.step(observation.set("action", draw.argmax(1)))["next"]
        observation = env.reset(step.set("_reset", step["done"])) if step["done"].any() else step
    assert refused > 100


def test_boxes_of_an_episode(env):
    """Recorded in the order in which they were put down, and gone after a reset."""
    observation = env.reset()
    for number in range(3):
        state = State.from_observation(observation)
        step = apply(env.cell, state, observation["action_mask"].int().argmax(1))
        x, y, w, d = step.footprint.unbind(1)
        observation = env.step(observation.set("action", observation["action_mask"].int().argmax(1)))["next"]
        box = env.state.boxes[:, number]
        assert box.equal(torch.stack([x, y, step.top - step.item.h, w, d, step.item.h], 1))
        assert not env.state.boxes[:, number + 1 :].any()
    env.reset()
    assert not env.state.boxes.any()


def test_a_robot_s_images_do_not_show_the_boxes(env):
    with pytest.raises(ValueError, match=r"^env.support=Pct\(\): "):
        Planner(env.cell, planner="joint_dbl")


def test_a_state_without_a_pile(env):
    with pytest.raises(ValueError, match="^The state has no boxes"):
        placing_maps(env.cell, env.state._replace(boxes=None))


@pytest.mark.parametrize(
    "change",
    [
        lambda boxes: boxes[0, 1, 5].add_(1),  # higher than the surface
        lambda boxes: boxes[0, 0, 3].fill_(0),
        lambda boxes: boxes[0, 0, 0].fill_(-1),
        lambda boxes: boxes[0, 0, 4].fill_(6),  # leaves the tote
        lambda boxes: boxes[0, -1].fill_(1),
        lambda boxes: boxes[:, 1].sub_(torch.tensor([0, 0, 1, 0, 0, -1])),  # in the one below, as high as before
        lambda boxes: boxes.zero_(),
    ],
)
def test_boxes_that_no_episode_leads_to_are_refused(env, change):
    carried = env.reset()
    for _ in range(2):
        action = carried["action_mask"].int().argmax(1)
        _, carried = env.step_and_maybe_reset(carried.set("action", action))
    saved = {"environment": {key: value.clone() for key, value in env.state_dict().items()}, "carried": carried}
    check_saved_states(env, saved)
    change(saved["environment"]["boxes"])
    with pytest.raises(CheckpointError, match="of no use: boxes"):
        check_saved_states(env, saved)


@pytest.mark.parametrize("mask", [True, False])
def test_searches_know_the_boxes(env, mask):
    """After a move of a search, and after its totes were taken apart and put together, they are the environment's."""
    planner, observation = MCTS(env.cell, env.items, simulations=1, mask=mask), env.reset()
    for _ in range(3):
        state, action = State.from_observation(observation), observation["action_mask"].int().argmax(1)
        move = action_footprints(env.cell, state.items).gather(1, action[:, None])[:, 0] if mask else action
        after, _, placed = planner._move(state, move)
        step = env.step(observation.set("action", action))["next"]
        assert placed.all() and after.boxes.equal(env.state.boxes) and after.boxes[..., 5].any()
        assert _stack(_unstack(after), state).boxes.equal(after.boxes)
        assert (
            _fingerprint(torch.arange(3), after) != _fingerprint(torch.arange(3), after._replace(boxes=state.boxes))
        ).all()
        observation = env.reset(step.set("_reset", step["done"])) if step["done"].any() else step
