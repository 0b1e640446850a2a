"""The most probable choices of a policy, for a plan."""

from dataclasses import dataclass

import torch
from torch import Tensor

from pickplace.planners.base import MapPlanner
from pickplace.planners.policy import PolicyPlanner
from pickplace.policies.base import Policy, ScoresFootprints
from pickplace.robot.problem import Problem
from pickplace.rules.grasps import split_action
from pickplace.rules.item import Observation
from pickplace.rules.masks import action_footprints, action_mask
from pickplace.rules.state import Failure

MAX_ALTERNATIVES = 100_000  # greatest number of choices that a plan may report


@dataclass(frozen=True)
class Alternative:
    """One of the most probable choices, and whether it succeeds in a forward simulation."""

    action: int  #: flat index
    pick_cell: tuple[int, int]
    place_cell: tuple[int, int]
    rotation_degrees: int  #: turn of the end effector's pose in the tote, in quarter turns
    #: of the action, or of the item with its footprint if the policy chooses footprints; without a mask
    probability: float
    rejected: str | None  #: the reason why it would fail; None if it would succeed
    chosen: bool
    item_number: int = 0  #: of the item that it takes, see :attr:`Plan.item_number`; 0 if it grips none


def list_alternatives(
    planner: MapPlanner, problem: Problem, observation: Observation, chosen: Tensor | None, count: int
) -> list[Alternative]:
    """Return the most probable choices, in the order in which its policy prefers them."""
    if count == 0 or not isinstance(planner, PolicyPlanner):
        return []
    cell, candidates = problem.cell, planner.candidates
    policy = planner.policy.with_cell(cell)
    if candidates == "all" and isinstance(policy, ScoresFootprints):
        actions, probability = _probable_footprints(policy, observation, problem, chosen, count)
    else:
        log_probs = policy.action_log_probs(observation)[0]
        tried = cell.num_actions if candidates == "all" else min(candidates, cell.num_actions)
        # The same call as the planner's, so that ties agree.
        actions = _with_chosen(log_probs.topk(tried).indices[:count], chosen)
        probability = log_probs[actions].exp()
    if not len(actions):
        return []
    columns = *split_action(cell, actions), probability, problem.failures(actions), problem.taken_items(actions)
    rows = zip(actions.tolist(), *(column.tolist() for column in columns), strict=True)
    return [
        Alternative(
            action=action,
            pick_cell=(x_bin, y_bin),
            place_cell=(x_tote, y_tote),
            rotation_degrees=90 * rotation,
            probability=share,
            rejected=Failure(code).name.lower() if code else None,
            chosen=chosen is not None and action == int(chosen),
            item_number=number,
        )
        for action, x_bin, y_bin, x_tote, y_tote, rotation, share, code, number in rows
    ]


def _with_chosen(listed: Tensor, chosen: Tensor | None) -> Tensor:
    """Return what is listed, and behind it what is chosen, if it is not listed."""
    return listed if chosen is None or (listed == chosen).any() else torch.cat([listed, chosen])


def _probable_footprints(
    policy: Policy, observation: Observation, problem: Problem, chosen: Tensor | None, count: int
) -> tuple[Tensor, Tensor]:
    """Return an action for each of the most probable footprints, and the footprint's probability.

    Many actions leave the same footprint, and the policy does not tell them apart. The action returned is the
    chosen one, else the first feasible one, else the first one. Of several items in the bin each has its footprints.
    """
    cell = problem.cell
    footprint = action_footprints(cell, problem.state.items, problem.maps.blocked)[0]  # [N_a]
    lands = footprint >= 0
    reachable = torch.zeros(cell.num_choices, dtype=torch.bool, device=footprint.device)
    reachable[footprint[lands]] = True
    if problem.maps.bin_items == 1:
        log_probs = policy.action_log_probs(observation)[0]
        total = log_probs.new_zeros(cell.num_choices)
        total.scatter_add_(0, footprint[lands], log_probs[lands].exp())
    else:  # measured items are on grids of their own: what the policy sees does not tell which picks lift them
        total = torch.where(reachable, policy.unmasked_scores(observation)[0], -torch.inf).softmax(0).nan_to_num(0)
    ranked = torch.where(reachable, total, -1).argsort(descending=True, stable=True)[: int(reachable.sum())][:count]
    preference = action_mask(cell, problem.maps)[0].int()
    if chosen is not None:
        ranked, preference[chosen] = _with_chosen(ranked, footprint[chosen]), 2
    shown = [torch.where(footprint == wanted, preference, -1).argmax() for wanted in ranked]
    return torch.stack(shown) if shown else ranked, total[ranked]
