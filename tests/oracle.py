"""A slow implementation of the task's rules in plain Python, cell by cell, to test the package against.

It shares no code with the package, and uses only lists and integers. Grids are lists of columns (`grid[x][y]`),
and a flat action is `(((x_bin * D_B + y_bin) * W_T + x_tote) * D_T + y_tote) * R + r`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from itertools import chain, combinations_with_replacement, product
from math import dist

SUCCESS, PICK_MISS, BIN_COLLISION, TOTE_COLLISION, OVERFLOW, ITEM_COLLISION, UNSTABLE, STUCK, OUT_OF_REACH = range(9)
FORBIDDEN_TURN, OVERLOADED = 9, 10

Pair = tuple[int, int]
Triple = tuple[int, int, int]
Grid = list[list[int]]


@dataclass(frozen=True)
class Rules:
    """The sizes and options that are the same in all episodes."""

    bin_size: Triple = (5, 5, 1)
    tote_size: Triple = (6, 6, 5)
    effector_size: Pair = (3, 3)
    rotations: int = 4
    pick_rule: str = "contain"
    support: str | float = "half"
    support_margin: float = 0.0
    body: str | Grid = "rectangle"  # rectangle, disc or `[W_E][D_E]` of 0 and 1
    cup: str | Grid = "rectangle"
    cup_size: Pair | None = None  # size of a rectangle or disc in the middle; None: as large as the body
    min_seal: float = 1.0
    bin_items: int = 1
    refill: str = "each"
    pick_ok: list[bool] | None = None  # for each pick cell; None: no limits on the robot
    lowest_top: list[Grid] | None = None  # for each rotation and place cell
    highest_top: list[Grid] | None = None
    lowest_pick: list[int] | None = None  # for each pick cell, of the item's height; None: any height
    highest_pick: list[int] | None = None
    turns: tuple[int, ...] | None = None  # rotations that are allowed; None: all
    handling: dict[Triple, tuple[tuple[int, ...], int, int | None]] | None = None  # rotations, mass, greatest load

    @property
    def num_actions(self) -> int:
        (bin_w, bin_d, _), (tote_w, tote_d, _) = self.bin_size, self.tote_size
        return bin_w * bin_d * tote_w * tote_d * self.rotations

    @cached_property
    def cup_cells(self) -> list[Pair]:
        """The cells of the cup, from the effector's minimum corner."""
        return shape_cells(self.cup, self.effector_size, self.cup_size or self.effector_size)

    @cached_property
    def body_cells(self) -> list[list[Pair]]:
        """The cells of the body for each rotation, from the turned effector's minimum corner."""
        size = self.effector_size
        body = shape_cells(self.body, size, size)
        return [[rotate(r, size, cell, (1, 1))[1] for cell in body] for r in range(self.rotations)]

    def split(self, action: int) -> tuple[Pair, Pair, int]:
        """The pick cell, the place cell and the rotation of a flat action."""
        rest, r = divmod(action, self.rotations)
        rest, y_tote = divmod(rest, self.tote_size[1])
        rest, x_tote = divmod(rest, self.tote_size[0])
        return divmod(rest, self.bin_size[1]), (x_tote, y_tote), r

    def join(self, pick: Pair, place: Pair, r: int) -> int:
        """The flat action of a pick cell, a place cell and a rotation."""
        (bin_d, tote_w, tote_d) = self.bin_size[1], self.tote_size[0], self.tote_size[1]
        return (((pick[0] * bin_d + pick[1]) * tote_w + place[0]) * tote_d + place[1]) * self.rotations + r


def rotate(r: int, effector: Pair, offset: Pair, size: Pair) -> tuple[Pair, Pair, Pair]:
    """The table of rotations: effector size, item offset inside it and item size after `r` quarter turns."""
    (effector_w, effector_d), (ox, oy), (w, d) = effector, offset, size
    return [
        ((effector_w, effector_d), (ox, oy), (w, d)),
        ((effector_d, effector_w), (effector_d - oy - d, ox), (d, w)),
        ((effector_w, effector_d), (effector_w - ox - w, effector_d - oy - d), (w, d)),
        ((effector_d, effector_w), (oy, effector_w - ox - w), (d, w)),
    ][r]


def shape_cells(shape: str | Grid, size: Pair, inner: Pair) -> list[Pair]:
    """The cells of a mask, or of a rectangle or disc of `inner` cells in the middle of a rectangle of `size`."""
    if not isinstance(shape, str):
        return [(x, y) for x, y in cells((0, 0), size) if shape[x][y]]
    x0, y0 = ((a - b) // 2 for a, b in zip(size, inner, strict=True))
    return [(x, y) for x, y in cells((x0, y0), inner) if shape == "rectangle" or in_disc((x - x0, y - y0), inner)]


def in_disc(cell: Pair, size: Pair) -> bool:
    """Whether a cell's inside meets the ellipse inscribed in a rectangle: its point nearest the centre decides."""
    total = Fraction(0)
    for at, side in zip(cell, size, strict=True):
        centre = Fraction(side, 2)
        nearest = min(max(centre, Fraction(at)), Fraction(at + 1))
        total += ((nearest - centre) / centre) ** 2
    return total < 1


def corner_for(reference_at: Pair, size: Pair) -> Pair:
    """The minimum corner of an effector of this size whose reference cell is at `reference_at`."""
    return reference_at[0] - (size[0] - 1) // 2, reference_at[1] - (size[1] - 1) // 2


def cells(corner: Pair, size: Pair) -> list[Pair]:
    """Every cell of a rectangle, inside a grid or not."""
    return list(product(range(corner[0], corner[0] + size[0]), range(corner[1], corner[1] + size[1])))


def is_stable(rules: Rules, supporting: list[Pair], size: Pair) -> bool:
    """Whether an item of this size rests stably on these cells, counted from its corner."""
    share = len(supporting) / (size[0] * size[1])
    if not isinstance(rules.support, str):
        return share >= rules.support
    if rules.support in ("hull", "bearing"):
        edges = hull_edges(supporting)
        return bool(edges) and all(cross(a, b, size) > 2 * rules.support_margin * dist(a, b) for a, b in edges)
    if rules.support == "half_or_hull":
        return share > 0.5 or in_hull_of_middles(supporting, size)
    w, d = size
    held = sum(corner in supporting for corner in [(0, 0), (w - 1, 0), (0, d - 1), (w - 1, d - 1)])
    exact = Fraction(len(supporting), w * d)
    if rules.support == "corners":
        return exact >= Fraction(60 if held == 4 else 80 if held == 3 else 95, 100)
    if rules.support == "cdrl":  # of items of up to 40 cells
        return held >= 3 and exact > Fraction(50 if held == 4 else 85, 100)
    if rules.support == "gopt":
        within = in_hull_of_middles(supporting, size) and not on_near_edge(supporting, size)
        return share > 0.5 or (len(supporting) > 1 and within)
    return {"half": share >= 0.5, "more_than_half": share > 0.5, "full": share == 1}[rules.support]


def in_hull_of_middles(supporting: list[Pair], size: Pair) -> bool:
    """Whether the middle of a rectangle is a middle of one of the cells, or on a line or in a triangle of middles."""
    centre, points = size, [(2 * x + 1, 2 * y + 1) for x, y in supporting]
    for a, b, c in combinations_with_replacement(points, 3):
        turns = [cross(p, q, centre) for p, q in ((a, b), (b, c), (c, a))]
        within = all(min(p) <= q <= max(p) for p, q in zip(zip(a, b, c, strict=True), centre, strict=True))
        if within and (min(turns) >= 0 or max(turns) <= 0):
            return True
    return False


def on_near_edge(supporting: list[Pair], size: Pair) -> bool:
    """Whether no cell's middle has a smaller y than the rectangle's, and the cells' middles are not all on a line."""
    points = [(2 * x + 1, 2 * y + 1) for x, y in supporting]
    flat = not any(cross(a, b, c) for a, b, c in combinations_with_replacement(points, 3))
    return min(y for _, y in points) >= size[1] and not flat


def hull_edges(supporting: list[Pair]) -> list[tuple[Pair, Pair]]:
    """The edges of the convex hull of cells, counter-clockwise; in half cells, so that centres are whole."""
    corners = sorted({(2 * (x + a), 2 * (y + b)) for x, y in supporting for a in (0, 1) for b in (0, 1)})
    hull: list[Pair] = []
    for points in (corners, corners[::-1]):
        chain: list[Pair] = []
        for point in points:
            while len(chain) > 1 and cross(chain[-2], chain[-1], point) <= 0:
                chain.pop()
            chain.append(point)
        hull += chain[:-1]
    return list(zip(hull, hull[1:] + hull[:1], strict=True))


def cross(a: Pair, b: Pair, c: Pair) -> int:
    """Twice the area of a triangle, positive if its corners run counter-clockwise."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def inside(cell: Pair, grid: Grid) -> bool:
    return 0 <= cell[0] < len(grid) and 0 <= cell[1] < len(grid[0])


@dataclass(frozen=True)
class Placed:
    """An item in the tote: its corner, its sides, its mass and the greatest load on it; None: any."""

    corner: Triple
    size: Triple
    mass: int
    most: int | None

    def rests_on(self, other: Placed) -> bool:
        """Whether this item's underside and the other's top are level and share an area."""
        ends, others = ([a + b for a, b in zip(box.corner, box.size, strict=True)] for box in (self, other))
        shared = [min(ends[i], others[i]) - max(self.corner[i], other.corner[i]) for i in range(2)]
        return others[2] == self.corner[2] and min(shared) > 0


def piles_below(items: list[Placed]) -> list[set[int]]:
    """For each item, the numbers of all items in the pile below it, down to the floor."""
    found: list[set[int]] = []
    for item in items:  # an item rests only on earlier ones
        on = {other for other in range(len(found)) if item.rests_on(items[other])}
        found.append(on.union(*(found[other] for other in on)))
    return found


def loads(items: list[Placed]) -> list[int]:
    """The load of each item: the mass of every item whose pile includes it."""
    below = piles_below(items)
    return [sum(item.mass for item, on in zip(items, below, strict=True) if n in on) for n in range(len(items))]


@dataclass
class Oracle:
    """One environment: an episode's tote and the item that waits in the bin.

    `item` is `(w, d, h)`, and `position` is the bin cell of its corner. `others` are further items in the bin and their
    positions. `heights` and `bearing`, 1 where a cell bears weight, are `[W_T][D_T]`.
    """

    rules: Rules
    tote_height: int
    item: Triple
    position: Pair
    heights: Grid = field(default_factory=list)
    volume: int = 0
    bearing: Grid = field(default_factory=list)
    others: list[tuple[Triple, Pair]] = field(default_factory=list)
    picks: dict[Pair, tuple[int, int | None]] = field(default_factory=dict)  # results of tried picks, which recur
    placed: list[Placed] = field(default_factory=list)  # with handling

    def __post_init__(self):
        wide, deep, _ = self.rules.tote_size
        self.heights = self.heights or [[0] * deep for _ in range(wide)]
        self.bearing = self.bearing or [[1] * deep for _ in range(wide)]

    def bin_depth(self) -> Grid:
        """Height above the bin's floor, `[W_B][D_B]`."""
        grid = [[0] * self.rules.bin_size[1] for _ in range(self.rules.bin_size[0])]
        for item, position in self.contents:
            for x, y in cells(position, item[:2]):
                grid[x][y] = item[2]
        return grid

    @property
    def contents(self) -> list[tuple[Triple, Pair]]:
        """Every item in the bin, and its corner."""
        return [(self.item, self.position), *self.others]

    def taken(self, action: int) -> int | None:
        """The number of the item that an action takes: the highest that the cup grips; among equals the first."""
        return self.try_pick(self.rules.split(action)[0])[1]

    def try_pick(self, pick: Pair) -> tuple[int, int | None]:
        """The failure code of a pick, and the number of the item that it takes."""
        if pick not in self.picks:
            number = self._gripped(pick)
            self.picks[pick] = PICK_MISS if number is None else self._lift(pick, number), number
        return self.picks[pick]

    def _gripped(self, pick: Pair) -> int | None:
        rules = self.rules
        corner = corner_for(pick, rules.effector_size)
        cup = [(corner[0] + x, corner[1] + y) for x, y in rules.cup_cells]
        best = None
        for number, (item, position) in enumerate(self.contents):
            under = cells(position, item[:2])
            sealed = sum(cell in under for cell in cup)
            gripped = {
                "contain": all(cell in cup for cell in under),
                "overlap": sealed > 0,
                "seal": sealed / len(cup) >= rules.min_seal,
            }
            if gripped[rules.pick_rule] and (best is None or item[2] > self.contents[best][0][2]):
                best = number
        return best

    def _lift(self, pick: Pair, number: int) -> int:
        """The failure code of lifting an item that is gripped."""
        (w, d, h), position = self.contents[number]
        corner, grid, item = corner_for(pick, self.rules.effector_size), self.bin_depth(), cells(position, (w, d))
        for x, y in ((corner[0] + x, corner[1] + y) for x, y in self.rules.body_cells[0]):
            if not inside((x, y), grid):
                if self.rules.bin_size[2] > h:
                    return BIN_COLLISION
            elif (x, y) not in item and grid[x][y] >= h:  # another item that is as high
                return BIN_COLLISION
        return SUCCESS

    def tote_depth(self) -> Grid:
        """Remaining height, `[W_T][D_T]`."""
        return [[self.tote_height - height for height in column] for column in self.heights]

    def occupancy(self) -> float:
        width, depth, _ = self.rules.tote_size
        return self.volume / (width * depth * self.tote_height)

    def try_action(self, action: int) -> tuple[int, Grid | None]:
        """The failure code of an action and, only on success, the heights after it."""
        rules, heights = self.rules, self.heights
        pick, place, r = rules.split(action)
        failure, number = self.try_pick(pick)
        if failure != SUCCESS:
            return failure, None
        (w, d, h), position = self.contents[number]

        effector_corner = corner_for(pick, rules.effector_size)
        offset = position[0] - effector_corner[0], position[1] - effector_corner[1]
        effector_size, offset, size = rotate(r, rules.effector_size, offset, (w, d))
        effector_corner = corner_for(place, effector_size)
        effector = [(effector_corner[0] + x, effector_corner[1] + y) for x, y in rules.body_cells[r]]
        footprint = cells((effector_corner[0] + offset[0], effector_corner[1] + offset[1]), size)
        if not all(inside(cell, heights) for cell in footprint):
            return TOTE_COLLISION, None
        z = max(heights[x][y] for x, y in footprint)
        top = z + h
        if self.tote_height > top and not all(inside(cell, heights) for cell in effector):
            return TOTE_COLLISION, None

        if top > self.tote_height:
            return OVERFLOW, None

        if any(heights[x][y] > top for x, y in effector if inside((x, y), heights)):
            return ITEM_COLLISION, None

        x, y = footprint[0]
        supporting = [(a, b) for a, b in footprint if heights[a][b] == z and self.bearing[a][b]]
        if not is_stable(rules, [(a - x, b - y) for a, b in supporting], size):
            return UNSTABLE, None

        if rules.pick_ok is not None:
            lowest, highest = (table[r][place[0]][place[1]] for table in (rules.lowest_top, rules.highest_top))
            number = pick[0] * rules.bin_size[1] + pick[1]
            if not rules.pick_ok[number] or top < lowest or top > highest:
                return OUT_OF_REACH, None
            if rules.lowest_pick is not None and not rules.lowest_pick[number] <= h <= rules.highest_pick[number]:
                return OUT_OF_REACH, None

        if rules.turns is not None and r not in rules.turns:
            return FORBIDDEN_TURN, None
        if rules.handling is not None:
            if r not in rules.handling[w, d, h][0]:
                return FORBIDDEN_TURN, None
            items = [*self.placed, self.lying(action)]
            if any(item.most is not None and load > item.most for item, load in zip(items, loads(items), strict=True)):
                return OVERLOADED, None

        after = [column[:] for column in heights]
        for x, y in footprint:
            after[x][y] = top
        return SUCCESS, after

    def lying(self, action: int) -> Placed:
        """The item of an action as it would lie in the tote, if its footprint is inside."""
        pick, place, r = self.rules.split(action)
        (w, d, h), position = self.contents[self.try_pick(pick)[1]]
        corner = corner_for(pick, self.rules.effector_size)
        offset = position[0] - corner[0], position[1] - corner[1]
        effector, (dx, dy), size = rotate(r, self.rules.effector_size, offset, (w, d))
        x, y = corner_for(place, effector)
        x, y = x + dx, y + dy
        z = max(self.heights[a][b] for a, b in cells((x, y), size))
        return Placed((x, y, z), (*size, h), *self.rules.handling[w, d, h][1:])

    def bearing_after(self, action: int) -> Grid:
        """1 for each cell that bears weight after a successful action; on an item, only inside its support's hull."""
        after = [column[:] for column in self.bearing]
        if self.rules.support != "bearing":
            return after
        heights = self.try_action(action)[1]
        grid = cells((0, 0), self.rules.tote_size[:2])
        footprint = [(x, y) for x, y in grid if heights[x][y] != self.heights[x][y]]
        z = heights[footprint[0][0]][footprint[0][1]] - self.contents[self.taken(action)][0][2]
        edges = hull_edges([(x, y) for x, y in footprint if self.heights[x][y] == z and self.bearing[x][y]])
        for x, y in footprint:
            corners = [(2 * (x + a), 2 * (y + b)) for a in (0, 1) for b in (0, 1)]
            after[x][y] = int(all(cross(a, b, corner) >= 0 for a, b in edges for corner in corners))
        return after

    def full_mask(self) -> list[bool]:
        """For each of the `N_a` flat actions, whether it would succeed."""
        return [self.try_action(action)[0] == SUCCESS for action in range(self.rules.num_actions)]

    def has_feasible_action(self, try_first=()) -> bool:
        """Whether any action succeeds; `try_first` only saves time."""
        return any(self.try_action(action)[0] == SUCCESS for action in chain(try_first, self.lifting_actions()))

    def lifting_actions(self) -> Iterator[int]:
        """The actions whose pick succeeds."""
        picks = self.rules.bin_size[0] * self.rules.bin_size[1]
        each = self.rules.num_actions // picks
        for number in range(picks):
            if self.try_pick(divmod(number, self.rules.bin_size[1]))[0] == SUCCESS:
                yield from range(number * each, (number + 1) * each)

    def step(
        self, action: int, next_item: Triple, next_position: Pair, try_first=(), others=()
    ) -> tuple[int, bool, int]:
        """Take an action; return reward, terminated and failure code.

        The next item arrives only after a success, and decides whether the episode is stuck. `others` are the other
        items in the bin then.
        """
        failure, after = self.try_action(action)
        if failure != SUCCESS:
            return 0, True, failure
        w, d, h = self.contents[self.taken(action)][0]
        reward = w * d * h
        placed = self.placed if self.rules.handling is None else [*self.placed, self.lying(action)]
        self.bearing = self.bearing_after(action)
        self.heights, self.volume, self.placed = after, self.volume + reward, placed
        self.item, self.position, self.others, self.picks = next_item, next_position, list(others), {}
        stuck = not self.has_feasible_action(try_first)
        return reward, stuck, STUCK if stuck else SUCCESS


def can_always_start(rules: Rules, kinds: list[Triple]) -> bool:
    """Whether each kind has a feasible action on the empty tote, from each bin position and at each tote height."""
    (bin_w, bin_d, _), greatest = rules.bin_size, max(h for _, _, h in kinds)
    if greatest > rules.tote_size[2] or any(w > bin_w or d > bin_d for w, d, _ in kinds):
        return False
    return all(
        Oracle(rules, tote_height, kind, position).has_feasible_action()
        for tote_height in range(greatest, rules.tote_size[2] + 1)
        for kind in kinds
        for position in product(range(bin_w - kind[0] + 1), range(bin_d - kind[1] + 1))
    )
