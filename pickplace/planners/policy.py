"""The planner that follows a trained policy."""

from typing import Literal

import torch
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pickplace.common.validate import expect, is_whole, one_of
from pickplace.planners.base import ITEM_RULES, MapPlanner, pick_first, restrict_items
from pickplace.policies.base import Policy, Ranking, ScoresFootprints, best_choice, check_finite, rank_actions
from pickplace.policies.footprints import count_ways, rank_footprints
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import PICKS, join_pick, select_pick
from pickplace.rules.item import Observation
from pickplace.rules.masks import PlacingMaps, action_footprints, action_mask, placing_maps
from pickplace.rules.state import State


class PolicyPlanner(MapPlanner):
    """Tries the policy's most probable actions in a forward simulation and plays the first that succeeds (Sec. III).

    Args:
        cell: the sizes.
        policy: a policy made for this cell.
        candidates: ``K``, number of the most probable flat actions, of all ``N_a`` and without a mask, that are tried.
            If none succeeds, the most probable one is played, and fails. ``"all"`` plays the best feasible one.
        item: rule that selects the items to consider, see :func:`~pickplace.planners.base.restrict_items`.
        pick: ``"any"``; or, for bins with one item, a rule that chooses the pick first, without a look at the tote:
            ``"least_offset"`` or ``"middle"``, as in ``individual_heuristic``. Then only the footprints that this pick
            reaches are considered. If it reaches none, an action is played that fails.
    """

    name = "policy"
    needs = ("policy",)

    def __init__(
        self,
        cell: CellSpec,
        policy: Policy,
        candidates: int | Literal["all"] = "all",
        item: str = "any",
        pick: str = "any",
    ):
        is_count = is_whole(candidates) and int(candidates) >= 1
        expect(is_count or candidates == "all", "planner.candidates", candidates, "'all' or a whole number >= 1")
        self.cell, self.policy, self.candidates = cell, policy, candidates
        self.item = one_of("planner.item", item, ITEM_RULES)
        self.pick = one_of("planner.pick", pick, ("any", *PICKS))
        ranks = isinstance(policy, ScoresFootprints) and candidates == "all"
        model = "a checkpoint of model=afterstate, or of model=fcn_grasp that was trained with a mask"
        for key, value in (("planner.item", item), ("planner.pick", pick)):
            expect(ranks or value == "any", key, value, f"'any', or planner.candidates=all and {model}")
        expect(cell.bin_items == 1 or pick == "any", "planner.pick", pick, f"'any' with env.bin_items={cell.bin_items}")

    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        return self.rank(cell, state, maps, observation).action

    @torch.no_grad()
    def rank(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Ranking:
        """Return the choices that it considers with their scores; arguments as in :meth:`choose`."""
        policy = self.policy.with_cell(cell)
        if self.pick != "any":
            pick, footprint, succeeds = pick_first(cell, maps, self.pick)
            reached = count_ways(cell.num_footprints, footprint, succeeds) > 0
            ranked = policy.ranked(maps) & reached
            mask = torch.where(ranked.any(1, keepdim=True), ranked, reached)
            scores = policy.footprint_logits(observation, mask)

            def reach(row: Tensor, choice: Tensor) -> Tensor:
                leads_to = succeeds[row] & (footprint[row] == choice[:, None])
                return join_pick(cell, pick[row], leads_to.int().argmax(1))

            return Ranking(reach(torch.arange(len(pick), device=pick.device), best_choice(scores)), scores, reach)
        if self.item != "any":
            mask = restrict_items(cell, self.item, state, policy.ranked(maps))
            return rank_footprints(cell, maps, policy.footprint_logits(observation, mask))
        if self.candidates == "all":
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                return policy.rank(observation, maps)
        scores = policy.action_log_probs(observation)
        score, tried = self.tried(check_finite(scores))
        succeeds = action_mask(cell, maps).gather(1, tried) & (score > -torch.inf)
        action = tried.gather(1, succeeds.int().argmax(1, keepdim=True))[:, 0]
        return rank_actions(scores)._replace(action=action)

    def tried(self, scores: Tensor) -> tuple[Tensor, Tensor]:
        """Return the scores of the choices that are tried, best first, and the choices, ``[N, K]`` each."""
        if self.candidates == "all":
            return scores.sort(dim=1, descending=True, stable=True)
        return scores.topk(min(self.candidates, scores.shape[1]), dim=1)

    def evaluation_facts(self) -> dict:
        mask = self.candidates == "all" or self.policy.excludes or False
        return {"candidates": self.candidates, "mask_at_decision": mask}

    @torch.no_grad()
    def heat_map(self, observation: Observation) -> Tensor:
        """Return the policy's greatest probability over picks and rotations for each place cell, ``[N, W_T, D_T]``.

        With ``candidates="all"`` only feasible actions count: with a rule for the item or the pick only those of its
        items, or of that pick.
        """
        cell = self.cell
        score = self.policy.action_log_probs(observation).exp()
        if self.candidates == "all":
            state = State.from_observation(observation)
            maps = placing_maps(cell, state)
            score = torch.where(action_mask(cell, maps), score, 0.0)
            if self.item != "any":
                allowed = restrict_items(cell, self.item, state, self.policy.ranked(maps))
                to = action_footprints(cell, state.items, maps.blocked)
                score = torch.where((to >= 0) & allowed.gather(1, to.clamp(min=0)), score, 0.0)
            if self.pick != "any":
                score = select_pick(cell, score, PICKS[self.pick](cell, maps.item, maps.blocked))
        return score.view(len(score), -1, *cell.tote_size[:2], cell.rotations).amax((1, 4))
