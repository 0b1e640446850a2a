"""Beam search over the items that are seen."""

from time import perf_counter
from typing import NamedTuple

import torch
from torch import Tensor

from pickplace.common.validate import number, or_null, refuse_if, whole_number
from pickplace.planners.base import MapPlanner
from pickplace.policies.base import EstimatesValue, Policy, ScoresFootprints
from pickplace.rules.bin import admit_coming_items
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Observation
from pickplace.rules.masks import PlacingMaps, first_action_reaching, placing_maps
from pickplace.rules.state import State
from pickplace.rules.step import put_down

CELLS_AT_ONCE = 2**23  # cells of the totes that are judged at a time


class _Plans(NamedTuple):
    """Plans, each a sequence of choices; the plans of a problem are side by side."""

    problem: Tensor  # int64 [P], number of the problem
    first: Tensor  # int64 [P], the first choice; -1: none yet
    placed: Tensor  # int64 [P], the placed volume
    total: Tensor  # float32 [P], the scaled placed volume plus the value of the state after it
    state: State  # of P problems
    awaits: Tensor  # bool [P], whether items that are not seen may lie in the bin, or arrive next

    def rows(self, index: Tensor) -> "_Plans":
        problem, first, placed, total = (part[index] for part in self[:4])
        return _Plans(problem, first, placed, total, self.state.rows(index), self.awaits[index])


class Beam(MapPlanner):
    """Plans the placements of several items that are seen, and plays the first one of the best plan.

    At each depth, every plan is extended by every item that is left, at every place that the policy ranks. The plans
    with the greatest sum of placed volume and value of the state after it are kept (beam search, Lowerre 1976). Plans
    that lead to the same tote and the same items count as one. Items in the preview arrive in their order. Later items
    are not imagined: they are part of the value. If all items that a plan leaves are known to fit nowhere, it is worth
    only the volume that it places. If a single item is seen, it decides like the policy.

    Args:
        cell: the sizes.
        policy: ``afterstate`` or ``afterstate_fcn``.
        width: number of plans that are kept at each depth.
        depth: number of placements of a plan.
        budget: milliseconds after which a decision goes no deeper; None: no limit.
    """

    name = "beam"
    needs = ("policy",)

    def __init__(self, cell: CellSpec, policy: Policy, width: int = 8, depth: int = 4, budget: float | None = None):
        self.width = whole_number("planner.width", width, most=1_000)
        self.depth = whole_number("planner.depth", depth, most=100)
        or_null(number, "planner.budget", budget)
        refuse_if(
            not (isinstance(policy, EstimatesValue) and isinstance(policy, ScoresFootprints)),
            "planner=beam: expected a checkpoint of model=afterstate or afterstate_fcn, whose values it adds up.",
        )
        self.cell, self.policy, self.budget = cell, policy, budget

    @torch.no_grad()
    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        start, number = perf_counter(), torch.arange(len(state.surface), device=state.surface.device)
        # A robot's state and maps have height units of their own; the plans have those of the policy.
        nothing = torch.zeros_like(number)
        plans = _Plans(number, nothing - 1, nothing, nothing.float(), State.from_observation(observation), nothing > 0)
        mask, ended = self.policy.with_cell(cell).ranked(maps), []
        for depth in range(self.depth + 1):
            goes_on = mask.any(1)
            ended.append(self._without_choice(plans.rows(~goes_on)))
            plans, mask = plans.rows(goes_on), mask[goes_on]
            if depth == self.depth or not len(mask) or (depth and self._is_late(start, depth)):
                break
            plans = self._longer(plans, mask)
            is_last = depth + 1 == self.depth or self._is_late(start, depth + 1)
            if is_last and plans.state.coming is None:  # the value includes whether new items fit
                break
            mask = self.policy.ranked(placing_maps(self.cell, plans.state))
        problem, first, _, total = map(torch.cat, zip(*(part[:4] for part in [*ended, plans]), strict=True))
        choice = first[_greatest(problem, total, 1)].clamp(min=0)  # like a policy without a feasible choice
        return first_action_reaching(cell, maps, choice)

    def evaluation_facts(self) -> dict:
        return {"candidates": "all", "mask_at_decision": True}  # like planner=policy

    def _without_choice(self, plans: _Plans) -> _Plans:
        """Return plans that cannot go on. The value of their state is 0 unless an unseen item may still fit."""
        placed = plans.placed * self.policy.value_network().reward_scale
        return plans._replace(total=torch.where(plans.awaits, plans.total, placed))

    def _is_late(self, start: float, depth: int) -> bool:
        """Return whether one more placement, if it takes as long as those before it, would exceed the budget."""
        return self.budget is not None and (perf_counter() - start) * 1000 * (depth + 1) / depth > self.budget

    def _longer(self, plans: _Plans, mask: Tensor) -> _Plans:
        """Return the best plans of each problem with one more placement.

        Args:
            mask: the choices by which each plan may be extended, at least one in all, bool ``[P, choices]``.
        """
        row, choice = mask.nonzero(as_tuple=True)
        at_once = max(1, CELLS_AT_ONCE // (plans.state.surface[0].numel() + self.cell.record_bytes))
        parts = [self._judge(plans, *some) for some in zip(row.split(at_once), choice.split(at_once), strict=True)]
        placed, total, outcome = map(torch.cat, zip(*parts, strict=True))
        different = _first_of_each(outcome)
        kept = different[_greatest(plans.problem[row[different]], total[different], self.width)]
        row, choice = row[kept], choice[kept]
        first = torch.where(plans.first[row] < 0, choice, plans.first[row])
        # The states of all plans would not fit into the memory; those of the kept ones are computed again.
        after, _ = put_down(self.cell, plans.state.rows(row), choice)
        state, awaits = admit_coming_items(self.cell, after)
        return _Plans(plans.problem[row], first, placed[kept], total[kept], state, awaits | plans.awaits[row])

    def _judge(self, plans: _Plans, row: Tensor, choice: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the placed volume, the total and the :func:`_fingerprint` of plans extended by a choice, ``[C]`` each.

        Args:
            row, choice: the plan and the choice, int64 ``[C]``.
        """
        after, volume, value = self.policy.evaluate_choices(plans.state.rows(row), choice)
        placed = plans.placed[row] + volume
        return (
            placed,
            placed * self.policy.value_network().reward_scale + value,
            _fingerprint(plans.problem[row], after),
        )


def _greatest(problem: Tensor, total: Tensor, count: int) -> Tensor:
    """Return the rows with the ``count`` greatest totals of each problem, grouped by problem; among equals the first.

    Args:
        problem: int64 ``[P]``.
        total: ``[P]``.
    """
    order = total.sort(descending=True, stable=True).indices
    order = order[problem[order].sort(stable=True).indices]
    sorted_ = problem[order]
    rank = torch.arange(len(order), device=order.device) - torch.searchsorted(sorted_, sorted_)
    return order[rank < count]


def _first_of_each(value: Tensor) -> Tensor:
    """Return the first row of each distinct value in int64 ``[P]``, in ascending order."""
    values, same = value.unique(return_inverse=True)
    number = torch.arange(len(value), device=value.device)
    return number.new_full(values.shape, len(value)).scatter_reduce(0, same, number, "amin").sort().values


def _fingerprint(problem: Tensor, state: State) -> Tensor:
    """Return a hash of each of ``P`` states, int64 ``[P]``. It is equal for equal problems, totes, loads that they can
    still bear, boxes in them in their order if they are recorded, sets of items in the bin, and items to come. Other
    pairs of states are equal with probability 2**-64."""
    table = state.items.table
    each = _mixed(_weighted(table)) * state.items.exists
    maps = [state.surface] if state.pile is None else [state.surface, state.pile.capacity]
    maps += [] if state.coming is None else [state.coming.table]
    maps += [] if state.boxes is None else [state.boxes]
    parts = [problem, *(_mixed(_weighted(part.flatten(1))) for part in maps), each.sum(1)]
    return _mixed(_weighted(torch.stack(parts, 1)))


def _weighted(numbers: Tensor) -> Tensor:
    """Return the sum of whole numbers ``[..., K]``, each times a weight of its own, modulo 2**64, int64 ``[...]``."""
    place = torch.arange(1, numbers.shape[-1] + 1, device=numbers.device)
    return (numbers * _mixed(place * 0x9E3779B97F4A7C1)).sum(-1)


def _mixed(number: Tensor) -> Tensor:
    """Return hashes of whole numbers, int64: each bit depends on all bits of the number (Stafford's mix, 2011)."""
    for shift, factor in ((30, -0x40A7B892E31B1A47), (27, -0x6B2FB644ECCEEE15), (31, 1)):
        number = (number ^ (number >> shift & (1 << 64 - shift) - 1)) * factor
    return number
