"""A planner of one's own: puts the item where its top stays low and near the tote's first corner."""

import torch


class Corner:
    """Minimises ``height_weight * top + x + y`` of the footprint, over everything that is feasible.

    Args:
        rules: the task's sizes; :class:`pickplace.Rules`. Every planner gets them.
        height_weight: what one cell of height counts against one cell of distance.
    """

    name = "corner"  # in tables and in evaluation.json

    def __init__(self, rules, height_weight: float = 10):
        self.rules, self.height_weight = rules, height_weight

    def decide(self, observation):
        """Flat actions, int64 ``[N]``, for the depth maps of ``N`` problems."""
        rules = self.rules
        maps = (observation[key] for key in ("bin_depth", "tote_depth", "tote_height"))
        placements = rules.placements_from_depth(*maps)
        feasible = rules.outcome_mask(placements)  # bool [N, Q, W_T, D_T]: footprints that some action reaches
        tote_w, tote_d, _ = rules.tote_size
        distance = torch.arange(tote_w)[:, None] + torch.arange(tote_d)
        cost = self.height_weight * placements.top + distance.to(placements.top.device)
        outcome = torch.where(feasible, cost, torch.inf).flatten(1).argmin(1)
        # Several (pick, place, rotation) may lead to the same footprint: the one with the lowest flat index.
        actions = rules.actions_reaching(placements, outcome)  # int64 [N, M], -1 where there is none
        return torch.where(actions >= 0, actions, rules.num_actions - 1).amin(1)
