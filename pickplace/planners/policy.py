"""The planner that follows a trained policy."""

from dataclasses import replace
from functools import partial
from typing import Any, Literal

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ValueOperator

from pickplace.policies.actors import Policy
from pickplace.runs import checkpoint
from pickplace.runs.registry import build
from pickplace.task.geometry import FAR, Rules
from pickplace.task.items import ItemDistribution


class PolicyPlanner:
    """Tries the policy's most probable actions in a forward simulation and plays the first that succeeds.

    Args:
        rules: the task's sizes.
        policy: a policy of :mod:`pickplace.policies.actors` made for these rules.
        candidates: ``K``, how many of the most probable flat actions, over all ``N_a`` and without a mask, are tried;
            if none succeeds the most probable one is played, and fails. ``"all"`` plays the best feasible one.
    """

    name = "policy"

    def __init__(self, rules: Rules, policy: Policy, candidates: int | Literal["all"] = "all"):
        whole = isinstance(candidates, int) and not isinstance(candidates, bool)
        if candidates != "all" and not (whole and candidates >= 1):
            raise ValueError(f"planner.candidates={candidates!r}: expected 'all' or a whole number >= 1.")
        self.rules, self.policy, self.candidates = rules, policy, candidates

    @torch.no_grad()
    def decide(self, observation: TensorDictBase) -> Tensor:
        bin_depth, tote_depth = observation["bin_depth"], observation["tote_depth"]
        tote_height = observation["tote_height"].reshape(-1)
        rules = self.rules
        if self.candidates == "all":
            placements = rules.placements_from_depth(bin_depth, tote_depth, tote_height)
            kind = self.policy.choice_key
            # Outcomes are found without a look at the N_a actions one by one.
            mask = rules.outcome_mask(placements).flatten(1) if kind == "outcome" else rules.action_mask(placements)
            if kind in ("action", "outcome", "footprint"):  # computes what is allowed only
                choice = self.policy(bin_depth, tote_depth, mask).argmax(1)
                if kind == "action":
                    return choice
                with set_exploration_type(ExplorationType.DETERMINISTIC):
                    return self.policy.to_action(choice, bin_depth, tote_depth, tote_height).clamp(min=0)
            score = self.policy.action_log_probs(bin_depth, tote_depth)
            # If none is feasible of those that a policy with a pick of its own chooses among: its most probable one.
            return torch.where(mask, score, score - FAR).argmax(1)
        count = min(self.candidates, rules.num_actions)
        score, tried = self.policy.action_log_probs(bin_depth, tote_depth).topk(count, dim=1)  # [N, K]
        heights = (tote_height[:, None, None] - tote_depth).int()
        item = rules.read_item(bin_depth)

        def repeat(x: Tensor) -> Tensor:
            return x.repeat_interleave(count, 0)

        step = rules.apply(repeat(heights), repeat(tote_height), type(item)(*map(repeat, item)), tried.flatten())
        succeeds = (step.failure.view_as(tried) == 0) & (score > -torch.inf)
        first = succeeds.int().argmax(1, keepdim=True)  # 0, the most probable, if none
        return tried.gather(1, first)[:, 0]

    @torch.no_grad()
    def heat_map(self, observation: TensorDictBase) -> Tensor:
        """The policy's greatest probability over picks and rotations for each place cell, ``[N, W_T, D_T]``.

        With ``candidates="all"`` of what is feasible only, as it chooses then.
        """
        rules, bin_depth, tote_depth = self.rules, observation["bin_depth"], observation["tote_depth"]
        score = self.policy.action_log_probs(bin_depth, tote_depth).exp()
        if self.candidates == "all":
            placements = rules.placements_from_depth(bin_depth, tote_depth, observation["tote_height"])
            score = torch.where(rules.action_mask(placements), score, 0.0)
        return score.view(len(score), rules.num_picks, *rules.tote_size[:2], rules.rotations).amax((1, 4))


#: Planners that follow a checkpoint's policy, by their short names.
NEEDS_POLICY = ("policy", "lookahead")

#: Planners that imagine items.
NEEDS_ITEMS = ("lookahead", "mcts")


def planner_parts(planner: DictConfig, rules: Rules, items: ItemDistribution, trained: tuple | None = None) -> dict:
    """What the planner of a config is made of beside its settings, as arguments.

    Args:
        planner: a config of the group ``planner``.
        rules: the task's sizes.
        items: for a search to imagine.
        trained: for a planner that follows a policy: the checkpoint's config with any overrides on top, its tensors,
            and the ``env`` that it was trained in; None: there is no checkpoint.

    Raises:
        ValueError: for a planner that needs a checkpoint without one, or with one that does not serve these sizes.
    """
    parts: dict[str, Any] = {"rules": rules}
    if planner._target_ in NEEDS_ITEMS:
        parts["items"] = items
    if planner._target_ in NEEDS_POLICY:
        if trained is None:
            raise ValueError(f"checkpoint=null: planner={planner._target_} needs a checkpoint; expected a run folder.")
        cfg, state, env = trained
        parts["policy"] = restore_policy(cfg, rules, state["policy"], env).to(cfg.device)
        if planner._target_ == "lookahead":
            parts["critic"] = restore_critic(cfg, rules, state, env["tote_size"])
    return parts


def restore_policy(cfg: DictConfig, rules: Rules, state: dict, trained: dict) -> Policy:
    """The policy of a checkpoint, for these rules; the sizes need not be those that it was trained with.

    Args:
        cfg: the checkpoint's config, with any overrides on top.
        rules: the task's sizes.
        state: the policy's tensors, ``state["policy"]`` of :func:`pickplace.runs.checkpoint.read`.
        trained: the group ``env`` in training; its ``rotations`` must not be exceeded.

    Raises:
        ValueError: for more rotations than were trained, or tensors that do not fit the config or the sizes.
    """
    if rules.rotations > trained["rotations"]:
        raise ValueError(
            f"env.rotations={rules.rotations}: the checkpoint was trained with {trained['rotations']}; "
            "expected no more."
        )

    def restored(rules: Rules) -> Policy:
        make = partial(build, "model.actor", cfg.model.actor, rules=rules, mask_infeasible=cfg.algo.mask_infeasible)
        return checkpoint.restore(make, state, "policy").eval()

    try:
        return restored(rules)
    except checkpoint.CheckpointError as error:
        sizes: dict[str, Any] = {
            key: tuple(trained[key]) for key in ("effector_size", "bin_size", "tote_size") if key in trained
        }
        sizes = {key: size for key, size in sizes.items() if size != getattr(rules, key)}
        if not sizes:
            raise
        restored(replace(rules, **sizes))  # if that fails too, it is not for the sizes
        ours = ", ".join(f"env.{key}={[*getattr(rules, key)]}" for key in sizes)
        theirs = ", ".join(f"{[*size]}" for size in sizes.values())
        raise checkpoint.CheckpointError(
            f"{ours}: the checkpoint was trained with {theirs}, and its policy does not serve every other size."
        ) from error


def restore_critic(cfg: DictConfig, rules: Rules, state: dict, trained_tote: list[int]):
    """The critic of a checkpoint as a function to values in cells, or None if it does not serve this tote.

    Args:
        cfg: the checkpoint's config.
        rules: the task's sizes.
        state: as of :func:`pickplace.runs.checkpoint.read`, with or without ``state["critic"]``.
        trained_tote: ``tote_size`` in training.
    """
    if "critic" not in state:
        return None

    def make():
        return ValueOperator(build("model.critic", cfg.model.critic, rules=rules), ["bin_depth", "tote_depth"])

    with torch.device("meta"):
        any_size = getattr(make().module, "any_size", False)
    if tuple(trained_tote[:2]) != rules.tote_size[:2] and not any_size:
        return None
    critic = checkpoint.restore(make, state["critic"], "critic").module.to(cfg.device).eval()
    return lambda bin_depth, tote_depth: critic(bin_depth, tote_depth) / cfg.algo.reward_scale
