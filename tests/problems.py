"""Random problems, in the forms of the package and of the plain-Python oracle; shared by tests of several packages."""

from dataclasses import replace
from itertools import combinations, product
from random import Random
from typing import NamedTuple

import numpy as np
import torch
from hypothesis import strategies as st
from oracle import SUCCESS, Oracle, Rules, cells, shape_cells
from torchrl.envs.utils import step_mdp

from pickplace import CellSpec, Item, PickPlaceEnv, State
from pickplace.items.distributions import Uniform
from pickplace.planners.heuristics import RandomFeasible
from pickplace.rules.cell import CELL_SETTINGS
from pickplace.rules.reach.base import Limits
from pickplace.rules.state import surface_from
from pickplace.rules.support.rules import RULES, Support, read_support

NOT_OF_THE_ORACLE = ("height_unit", "cell_size", "reach", "gripper", "support", "handling", "tipping", "preview")
SIDES, NEVER = st.integers(1, 4), st.just(False)

#: Stability rules and their margins.
SUPPORTS = [
    ("half", 0.0),
    ("more_than_half", 0.0),
    ("full", 0.0),
    ("hull", 0.0),
    ("hull", 0.3),
    ("bearing", 0.0),
    ("bearing", 0.2),
    ("half_or_hull", 0.0),
    ("corners", 0.0),
    ("cdrl", 0.0),
    ("gopt", 0.0),
    (0.0, 0.0),
    (2 / 3, 0.0),
]


class Case(NamedTuple):
    """The state of a problem: height of the tote, heights ``[W_T, D_T]`` in it, 1 where they bear weight, and one or
    more items ``(x, y, w, d, h)`` in the bin."""

    rim: int
    heights: np.ndarray
    bearing: np.ndarray
    item: tuple[int, int, int, int, int]
    others: tuple[tuple[int, int, int, int, int], ...] = ()


def support_of(name: str | float, margin: float) -> Support:
    """Return the package's rule of an entry of :data:`SUPPORTS`."""
    return RULES[name](margin) if name in ("hull", "bearing") else read_support(name)


def state_of(*cases: Case) -> State:
    """Return the state of a batch of cases."""
    heights, bearing = (
        torch.from_numpy(np.stack([getattr(case, key) for case in cases])) for key in ("heights", "bearing")
    )
    items = torch.tensor([case.item for case in cases])
    rims = torch.tensor([case.rim for case in cases])
    return State(surface_from(heights, bearing), rims, Item.from_table(items[:, None]))


def oracle_of(cell: CellSpec, case: Case) -> Oracle:
    """Return the oracle of a case."""
    tables = {} if cell.limits is None else {k: v.tolist() for k, v in vars(cell.limits).items() if v is not None}
    names = (name for name in CELL_SETTINGS if name not in NOT_OF_THE_ORACLE)
    name = next((name for name, kind in RULES.items() if type(cell.support) is kind), None)
    rule, margin = cell.support.least if name is None else name, getattr(cell.support, "margin", 0.0)
    settings = {name: getattr(cell, name) for name in names} | {"support": rule, "support_margin": margin}
    gripper = {"effector_size" if name == "size" else name: value for name, value in vars(cell.gripper).items()}
    gripper = {key: gripper[key] for key in ("effector_size", "body", "cup", "cup_size", "min_seal") if key in gripper}
    rules = Rules(**settings, **gripper, pick_rule=type(cell.gripper).__name__.lower(), **tables)
    others = [(item[2:], item[:2]) for item in case.others]
    heights, bearing = case.heights.tolist(), case.bearing.tolist()
    return Oracle(rules, case.rim, case.item[2:], case.item[:2], heights, bearing=bearing, others=others)


def random_limits(cell: CellSpec, seed: int) -> Limits:
    """Return tables of limits that forbid a part of the picks, places and heights."""
    random = np.random.default_rng(seed)
    places = (cell.rotations, *cell.tote_size[:2])
    lowest = random.integers(-1, 4, places)
    highest = lowest + random.integers(-1, 5, places)  # the range is sometimes empty
    pick_ok = random.random(cell.num_picks) < 0.7
    picks = (random.choice(values, cell.num_picks, p=[0.7, 0.3]) for values in ((0, 2), (4, 1)))
    tables = (pick_ok, lowest, highest, *picks)[: random.choice([3, 5])]  # with or without heights of picks
    return Limits(*map(torch.from_numpy, tables))


def random_effector(random: Random, size: tuple[int, int], kind: str | None = None) -> dict:
    """Return a random body, of the given kind if there is one, a random cup in it, and a random least share."""

    def mask(share, within):
        return [[int(within[x][y] and random.random() < share) for y in range(size[1])] for x in range(size[0])]

    everything = [[1] * size[1]] * size[0]
    kinds = ("rectangle", "disc", "mask")
    body, cup, cup_size = kind or random.choice(kinds), random.choice(kinds), None
    held = shape_cells("rectangle" if body == "mask" else body, size, size)
    inside = [[int((x, y) in held) for y in range(size[1])] for x in range(size[0])]
    if body == "mask":
        inside = mask(random.choice((0.4, 0.8)), everything)
        for x, y in ((0, -1), (-1, 0)) if random.random() < 0.5 else ((0, 0), (-1, -1)):  # each edge needs a 1
            inside[x][y] = 1
        body = inside
    if cup == "mask":
        cup = mask(random.choice((0.3, 0.9)), inside)
        x, y = random.choice([(x, y) for x, y in cells((0, 0), size) if inside[x][y]])
        cup[x][y] = 1
    else:
        sides = [range(2 - side % 2, side + 1, 2) for side in size]
        sizes = [pair for pair in product(*sides) if all(inside[x][y] for x, y in shape_cells(cup, size, pair))]
        if not sizes:
            cup = inside
        elif tuple(size) not in sizes or random.random() < 0.6:
            cup_size = random.choice(sizes)
    return {"body": body, "cup": cup, "cup_size": cup_size, "min_seal": random.choice((1.0, 0.01, 1 / 3, 0.5, 0.7))}


@st.composite
def problems(draw, effector_sides=SIDES, rotations=(1, 2, 3, 4), limited=NEVER, count=1, shaped=NEVER):
    """Return a cell and ``count`` cases in it; ``shaped`` decides whether body and cup may differ from rectangles."""
    effector = draw(effector_sides), draw(effector_sides)
    bin_w, bin_d, tote_w, tote_d = (draw(st.integers(least, most)) for least, most in ((2, 5), (2, 4), (3, 5), (2, 4)))
    shape = random_effector(Random(draw(st.integers(0, 99_999))), effector) if draw(shaped) else {}
    rule = draw(st.sampled_from(["contain", "overlap", "seal"] if shape else ["contain", "overlap"]))
    support = support_of(*draw(st.sampled_from(SUPPORTS)))
    cell = CellSpec(
        (bin_w, bin_d, draw(st.sampled_from([1, 2, 1, 3]))), (tote_w, tote_d, 6), effector_size=effector,
        rotations=draw(st.sampled_from(rotations)), pick_rule=rule, support=support, **shape,
    )  # fmt: skip
    if draw(limited):
        cell = replace(cell, reach=random_limits(cell, draw(st.integers(0, 999))))
    most = [min(pair) if rule == "contain" else pair[0] for pair in zip((bin_w, bin_d), effector, strict=True)]
    cases = []
    for _ in range(count):
        w, d, h = (draw(st.integers(1, side)) for side in (*most, 3))
        item = draw(st.integers(0, bin_w - w)), draw(st.integers(0, bin_d - d)), w, d, h
        rim = draw(st.integers(2, 6))
        levels = [0, *draw(st.lists(st.integers(0, rim), max_size=3))]
        heights = np.random.default_rng(draw(st.integers(0, 999))).choice(levels, size=(tote_w, tote_d))
        weak = draw(st.sampled_from([0.0, 0.3])) * support.marks_bearing
        bearing = (np.random.default_rng(draw(st.integers(0, 999))).random((tote_w, tote_d)) >= weak).astype(int)
        cases.append(Case(rim, heights, np.where(heights == 0, 1, bearing), item))
    return cell, cases


#: Settings of environments of every shape.
SETTINGS = [
    {"num_envs": 4},
    {"num_envs": 8, "rotations": 1},
    {"num_envs": 8, "rotations": 2, "tote_size": (4, 3, 1)},
    {"num_envs": 4, "tote_size": (7, 5, 4), "effector_size": (4, 2), "bin_size": (6, 4, 2), "rotations": 3},
    {"num_envs": 4, "tote_size": (5, 6, 3), "effector_size": (2, 3), "pick_rule": "overlap", "rotations": 2},
    {"num_envs": 4, "tote_size": (5, 5, 4), "items": Uniform((1, 2), (1, 3), (1, 2)), "support": "more_than_half"},
    {"num_envs": 4, "tote_size": (6, 6, 6), "items": Uniform((1, 3), (1, 3), (1, 2)), "support": "bearing"},
    {"num_envs": 4, "body": [[1, 1, 1], [1, 1, 0], [1, 1, 0]], "cup": [[0, 0, 0], [1, 1, 0], [0, 0, 0]],
     "pick_rule": "seal", "min_seal": 0.5},
    {"num_envs": 4, "bin_items": 3, "bin_size": (6, 5, 1), "items": Uniform((1, 3), (1, 3), (1, 2)), "rotations": 2},
    {"num_envs": 4, "preview": 2, "items": Uniform((1, 3), (1, 3), (1, 2)), "rotations": 2, "tote_size": (5, 4, 3)},
    {"num_envs": 4, "preview": 3, "bin_items": 2, "bin_size": (6, 5, 1), "rotations": 2, "tote_size": (5, 5, 4)},
    {"num_envs": 4, "bin_items": 3, "tipping": True, "bin_size": (6, 2, 1), "items": Uniform((1, 2), (1, 2), (1, 2)),
     "effector_size": (1, 1), "pick_rule": "overlap", "rotations": 2, "tote_size": (4, 5, 4)},
]  # fmt: skip


def random_states(steps=8, **settings):
    """Yield environments and their observations along random feasible play, with their exact action masks."""
    env = PickPlaceEnv(**{"num_envs": 16, "seed": 3, **settings})
    planner, observation = RandomFeasible(env.cell, seed=1), env.reset()
    for step in range(steps):
        if step:
            _, observation = env.step_and_maybe_reset(observation.set("action", planner.decide(observation)))
        yield env, observation


def late_state(steps=8, **settings):
    """Return an environment in the middle of random episodes, and its observation."""
    return list(random_states(steps, **settings))[-1]


def results_by_hand(env, observation, row: int) -> dict[int, tuple[int, int, int, int, int, int]]:
    """Return the result of each feasible flat action of a problem, in plain Python: ``{action: (top, y, x, w, d,
    number)}``, where the item lies then, and its number in the bin."""
    first, *others = [tuple(item) for item in env.state.items.cuboids[row].tolist() if item[4]]
    heights, bearing = env.state.heights[row].numpy(), env.state.bearing[row].int().numpy()
    case = Case(int(env.tote_height[row]), heights, bearing, first, tuple(others))
    plain, found = oracle_of(env.cell, case), {}
    for action in observation["action_mask"][row].nonzero()[:, 0].tolist():
        failure, after = plain.try_action(action)
        assert failure == SUCCESS
        # The changed cells are the footprint: the item has a height and lands on top.
        grid = cells((0, 0), env.cell.tote_size[:2])
        changed = [(x, y) for x, y in grid if after[x][y] != plain.heights[x][y]]
        (x, y), (x1, y1) = min(changed), max(changed)
        found[action] = (after[x][y], y, x, x1 - x + 1, y1 - y + 1, plain.taken(action))
    return found


def tie_by_hand(found) -> tuple:
    """Return the order of an entry of :func:`results_by_hand` among equal costs: item, narrower side, x, y."""
    _, y, x, w, d, number = found
    return number, w > d, x, y


@torch.no_grad()
def occupancies(planner, env: PickPlaceEnv) -> torch.Tensor:
    """Return the occupancy that a planner reaches in one episode of each slot, float64 ``[N]``."""
    observation, reached = env.reset(), torch.zeros(env.num_envs, dtype=torch.float64)
    running = torch.arange(env.num_envs)
    while len(running):  # ended episodes go on, but do not count
        action = torch.zeros(env.num_envs, dtype=torch.int64)
        action[running] = planner.decide(observation[running])
        after = env.step(observation.set("action", action))["next"]
        reached[running] = env.exact_occupancy[running]
        running = running[~after["done"][running, 0]]
        observation = step_mdp(observation)
    return reached


def spaces_by_hand(heights):
    """Return the floor and the sides ``(x0, y0, x1, y1)`` of each maximal empty space above heights ``[W][D]``."""
    wide, deep = len(heights), len(heights[0])

    def highest(x0, y0, x1, y1):
        cells = product(range(x0, x1), range(y0, y1))
        return max(heights[x][y] if 0 <= x < wide and 0 <= y < deep else 10**6 for x, y in cells)

    for (x0, x1), (y0, y1) in product(combinations(range(wide + 1), 2), combinations(range(deep + 1), 2)):
        floor = highest(x0, y0, x1, y1)
        grown = (x0 - 1, y0, x1, y1), (x0, y0 - 1, x1, y1), (x0, y0, x1 + 1, y1), (x0, y0, x1, y1 + 1)
        if all(highest(*box) > floor for box in grown):
            yield floor, x0, y0, x1, y1
