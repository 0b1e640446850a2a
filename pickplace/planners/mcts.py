"""Monte-Carlo tree search, with which the paper compares."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from pickplace.common.validate import check_bytes, flag, number, whole_number
from pickplace.items.arrival import refill
from pickplace.items.distributions import ItemDistribution, check_seed, search_items
from pickplace.planners.base import MapPlanner, narrow_first
from pickplace.rules.bin import admit_coming_items, remove_item
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Item, Observation
from pickplace.rules.masks import (
    PlacingMaps,
    action_mask,
    choice_mask,
    first_action_reaching,
    placing_maps,
)
from pickplace.rules.pile import Pile
from pickplace.rules.state import State
from pickplace.rules.step import apply, put_down

MAX_NODES = 1_000_000  # of the trees that are searched at once; more problems are searched in groups
GROUP_BYTES = 10**9  # of these trees


#: Surface, table of the items in the bin, pile, table of the items that are seen to come, and boxes, of one problem.
_Tote: TypeAlias = tuple[Tensor, Tensor, Pile | None, Tensor | None, Tensor | None]


@dataclass(eq=False)
class _Node:
    """A tote, and the items in the bin."""

    surface: Tensor  # int32 [W_T, D_T], of the tote
    items: Tensor  # int64 [M, 9], a table
    untried: list[int] | None  # actions in random order, taken from the end; None: all N_a flat actions
    edges: dict[int, "_Edge"] = field(default_factory=dict)
    pile: Pile | None = None  # of the items in the tote, see State
    coming: Tensor | None = None  # int64 [p, 9], a table of those that arrive next, see State
    boxes: Tensor | None = None  # int64 [L, 6], of the items in the tote, see State

    @property
    def tote(self) -> _Tote:
        return self.surface, self.items, self.pile, self.coming, self.boxes


@dataclass(eq=False)
class _Edge:
    """An action at a node, and the bins that were sampled after it."""

    node: _Node
    action: int
    visits: int = 0
    total: float = 0.0  # of the returns
    volume: int = 0  # placed by the action
    left: "_Tote | None" = None  # after the action; None until it is simulated, and if it fails
    failed: bool = False
    bins: list[_Node] = field(default_factory=list)
    is_known: bool = False  # whether all items of the next bin are seen, so that there is only one such bin


class MCTS(MapPlanner):
    """UCT with decision nodes and sampled bin nodes, and uniform rollouts; the most visited action is played.

    Each simulation walks down by UCB1, tries one action that has not been tried, samples the bin that arrives, and
    plays uniformly at random to the end. At most ``visits ** widening`` bins after an action are sampled from the item
    distribution, so that the tree grows deeper than one step. The stream that is played is never used. Items that were
    not taken stay in the bin. Simulations advance together on the environment's rules, ``batch_simulations`` at a
    time; these see each other's visits, but not yet their returns.

    Args:
        cell: the sizes.
        items: the item distribution; for a sequence, recorded or cut, its sizes with equal probability.
        simulations: number of simulations for each decision.
        mask: search among the distinct footprints that some action reaches; False: among all ``N_a`` flat actions,
            as in the paper, in the tree and in the rollouts.
        exploration: weight of UCB1's second term; returns are shares of the tote's volume.
        widening: exponent of the number of bins sampled after an action.
        batch_simulations: number of simulations that advance together, over all problems that are searched at once.
        seed: of the search.
    """

    name = "mcts"
    needs = ("items",)

    def __init__(
        self,
        cell: CellSpec,
        items: ItemDistribution,
        simulations: int = 5000,
        mask: bool = False,
        exploration: float = 0.5,
        widening: float = 0.5,
        batch_simulations: int = 256,
        seed: int = 0,
    ):
        self.cell, self.items, self.mask = cell, search_items(items), flag("planner.mask", mask)
        self.simulations = whole_number("planner.simulations", simulations, most=MAX_NODES)
        self.node_bytes = 1_000 + cell.record_bytes
        check_bytes(f"planner.simulations={simulations}", self.simulations * bool(cell.record_bytes) * self.node_bytes)
        self.batch_simulations = whole_number("planner.batch_simulations", batch_simulations, most=4_096)
        self.exploration = number("planner.exploration", exploration, most=1e6)
        self.widening = number("planner.widening", widening, most=1)
        self.seed = check_seed(seed, "planner.seed")
        self._depths, self._walks = 0, 0
        self.restart()

    def restart(self) -> None:
        self._random, self._sampled = np.random.default_rng(self.seed), 0

    def decide(self, observation: Observation) -> Tensor:
        if self.mask:
            return super().decide(observation)
        return self._search(_on_cpu(observation), None).to(observation["tote_depth"].device)

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        maps = maps.map(Tensor.cpu)
        chosen = self._search(_on_cpu(observation), (choice_mask if self.mask else action_mask)(cell, maps))
        return (first_action_reaching(cell, maps, chosen) if self.mask else chosen).to(observation["tote_depth"].device)

    def _search(self, state: State, mask: Tensor | None) -> Tensor:
        """Return the most visited choice of each problem, int64 ``[N]``; without a mask it is a flat action."""
        at_once = max(1, min(MAX_NODES, GROUP_BYTES // self.node_bytes) // self.simulations)
        if len(state.surface) > at_once:
            parts = torch.arange(len(state.surface)).split(at_once)
            return torch.cat([self._search(state.rows(part), None if mask is None else mask[part]) for part in parts])
        roots = self._nodes(state, mask)
        each = max(1, self.batch_simulations // len(roots))
        for done in range(0, self.simulations, each):
            walks = [
                (problem, *self._walk_down(root))
                for problem, root in enumerate(roots)
                for _ in range(min(each, self.simulations - done))
            ]
            self._simulate(walks, state)
        best = [max(root.edges.values(), key=lambda edge: (edge.visits, edge.total), default=None) for root in roots]
        return torch.tensor([0 if edge is None else edge.action for edge in best])

    def statistics(self) -> dict[str, float]:
        """Return the mean number of actions on a walk down the tree, over all searches so far."""
        return {"mean_tree_depth": self._depths / max(self._walks, 1)}

    def _walk_down(self, root: _Node) -> tuple[list[_Edge], bool]:
        """Walk down from the root and count visits; return the edges, and whether the walk ended without an action.

        Otherwise it ended with an action whose effect, or whose next bin, must be simulated.
        """
        node, path = root, []
        while (edge := self._choose(node)) is not None:
            edge.visits += 1
            path.append(edge)
            if edge.left is None or len(edge.bins) < (1 if edge.is_known else int(edge.visits**self.widening)):
                break
            node = edge.bins[self._random.integers(len(edge.bins))]
        self._walks += 1
        self._depths += len(path)
        return path, edge is None

    def _choose(self, node: _Node) -> _Edge | None:
        """Return the edge of an untried action, if any, else the most promising one by UCB1; None without actions."""
        action = None
        if node.untried:
            action = node.untried.pop()
        elif node.untried is None and len(node.edges) < self.cell.num_actions:
            while (action := int(self._random.integers(self.cell.num_actions))) in node.edges:
                pass
        if action is not None:
            return node.edges.setdefault(action, _Edge(node, action))
        if not node.edges:
            return None
        edges = list(node.edges.values())
        visits, total = (np.array([getattr(edge, name) for edge in edges]) for name in ("visits", "total"))
        bonus = self.exploration * np.sqrt(np.log(visits.sum()) / visits)
        return edges[int((total / visits + bonus).argmax())]

    def _simulate(self, walks: list[tuple[int, list[_Edge], bool]], roots: State) -> None:
        """Carry out the last actions, sample the bins after them, play out, and add the returns to the edges.

        Args:
            walks: the problem's number, and the result of :meth:`_walk_down`.
            roots: the states of the problems, ``[N]``.
        """
        walks = [walk for walk in walks if walk[1]]
        last = [(number, problem, path[-1]) for number, (problem, path, over) in enumerate(walks) if not over]
        if tried := [(problem, edge) for _, problem, edge in last if edge.left is None and not edge.failed]:
            before = _stack([edge.node.tote for _, edge in tried], roots.rows([problem for problem, _ in tried]))
            after, placed, good = self._move(before, torch.tensor([edge.action for _, edge in tried]))
            parts = zip(_unstack(after), placed.volume.tolist(), good.tolist(), strict=True)
            for (_, edge), (left, volume, succeeds) in zip(tried, parts, strict=True):
                edge.failed = not succeeds
                if succeeds:
                    edge.left, edge.volume = left, volume
        returns = torch.zeros(len(walks), dtype=torch.float64)
        if going := [(number, problem, edge) for number, problem, edge in last if edge.left is not None]:
            numbers, problems, edges = map(list, zip(*going, strict=True))
            arrived, known = self._arrive(_stack([edge.left for edge in edges], roots.rows(problems)))
            for edge, node, edge.is_known in zip(edges, self._nodes(arrived), known.tolist(), strict=True):
                if not (edge.is_known and edge.bins):
                    edge.bins.append(node)
            returns[numbers] = self._play_out(arrived)
        for (problem, path, _), volume in zip(walks, returns.tolist(), strict=True):
            for edge in reversed(path):
                volume += edge.volume
                edge.total += volume / float(self.cell.tote_volume(roots.tote_height[problem]))

    def _move(self, state: State, action: Tensor) -> tuple[State, Item, Tensor]:
        """Return the states after the search's actions, the items placed, and which actions succeed, bool ``[N]``."""
        if self.mask:
            return *put_down(self.cell, state, action), torch.ones_like(action, dtype=torch.bool)
        step = apply(self.cell, state, action)
        items = remove_item(self.cell, state.items, step.taken)
        after = state._replace(surface=step.surface, items=items, pile=step.pile, boxes=step.boxes)
        return after, step.item, step.failure == 0

    def _nodes(self, state: State, mask: Tensor | None = None) -> list[_Node]:
        """Return new nodes with the actions to try: those of a mask, or those that the rules allow."""
        if self.mask and mask is None:
            mask = choice_mask(self.cell, placing_maps(self.cell, state))
        untried: Sequence = [None] * len(state.surface)
        if mask is not None:
            number = torch.arange(mask.shape[1]).expand(mask.shape)
            if self.mask:  # of choices
                mask, number = (narrow_first(self.cell, state.items.flatten(), part) for part in (mask, number))
            rows = zip(number.numpy(), mask.numpy(), strict=True)
            untried = [self._random.permutation(row[good]).tolist() for row, good in rows]
        totes = zip(_unstack(state), untried, strict=True)
        return [
            _Node(surface, items, actions, {}, pile, coming, boxes)
            for (surface, items, pile, coming, boxes), actions in totes
        ]

    def _arrive(self, state: State) -> tuple[State, Tensor]:
        """Return the states after items have arrived, and a mask of those in which all items were seen, bool ``[M]``.

        Unseen items come from the item distribution, with one draw for each state.
        """
        state, rows = admit_coming_items(self.cell, state)
        number = torch.arange(self._sampled, self._sampled + len(state.surface))
        self._sampled += len(number)
        seed, first = torch.full_like(number, self.seed), torch.zeros_like(number)
        items, _ = refill(self.cell, self.items, "train", seed, number, first, state.items, rows, state.episode)
        return state._replace(items=items), ~rows

    def _play_out(self, state: State) -> Tensor:
        """Return the volume that uniformly random actions place until the episode ends, float64 ``[M]``."""
        cell, row = self.cell, torch.arange(len(state.surface))
        volume = torch.zeros(len(row), dtype=torch.float64)
        while True:
            if self.mask:
                mask = choice_mask(cell, placing_maps(cell, state))
                draw = torch.from_numpy(self._random.random(mask.shape, dtype=np.float32))
                draw = narrow_first(cell, state.items.flatten(), draw)
                action, going = torch.where(mask, draw, -1.0).argmax(1), mask.view(torch.uint8).amax(1) > 0
                state, placed, _ = self._move(state, action)
            else:
                action = torch.from_numpy(self._random.integers(cell.num_actions, size=len(state.surface)))
                state, placed, going = self._move(state, action)
            row = row[going]
            volume[row] += placed.volume[going].double()
            if len(row) == 0:
                return volume
            state, _ = self._arrive(state.rows(going))


def _on_cpu(observation: Observation) -> State:
    return State.from_observation({key: entry.cpu() for key, entry in observation.items()})


def _unstack(state: State) -> list[_Tote]:
    count = len(state.surface)
    piles = [None] * count if state.pile is None else [state.pile.rows(row) for row in range(count)]
    coming = [None] * count if state.coming is None else state.coming.table
    boxes = [None] * count if state.boxes is None else state.boxes
    return [*zip(state.surface, state.items.table, piles, coming, boxes, strict=True)]


def _stack(parts: Sequence[_Tote], problems: State) -> State:
    """Return the states of problems with other totes and bins: the inverse of :func:`_unstack`."""
    surface, items, piles, tables, placed = zip(*parts, strict=True)
    pile = None if piles[0] is None else Pile(*map(torch.stack, zip(*piles, strict=True)))
    coming = None if tables[0] is None else Item.from_table(torch.stack(tables))
    boxes = None if placed[0] is None else torch.stack(placed)
    bins = Item.from_table(torch.stack(items))
    return problems._replace(surface=torch.stack(surface), items=bins, pile=pile, coming=coming, boxes=boxes)
