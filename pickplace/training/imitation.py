"""Warm start: a policy imitates a planner before it learns from reward."""

from enum import Enum

import torch
import torch.nn.functional as F
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor

from pickplace.planners.policy import planner_parts
from pickplace.policies.actors import Policy
from pickplace.runs import checkpoint
from pickplace.runs.allowlist import trusted_config
from pickplace.runs.registry import build
from pickplace.task.geometry import Rules
from pickplace.task.items import ItemDistribution


class Phase(Enum):
    """What a policy learns from."""

    IMITATION = "imitation"  # the teacher's choices; the critic learns the values of the policy meanwhile
    CRITIC = "critic"  # nothing: the critic learns the values of the policy as imitation left it
    REWARD = "reward"


class WarmStart:
    """Imitation of a planner, then the critic alone, then reward.

    The policy itself acts from the first frame on and its teacher is asked in the states that come up (DAgger, Ross et
    al. 2011), so that it learns what to do where its own mistakes lead, and the critic learns the values of the policy
    that it will serve.

    Args:
        cfg: the config group ``warm_start``.
        policy: a policy of :mod:`pickplace.policies.actors`.
        rules: the task's sizes.
        items: for a teacher that imagines some.
        seed: of a teacher that draws.
        trust: modules beside pickplace's own whose classes the config of a teacher's checkpoint may make.

    Raises:
        ValueError: naming the key, for numbers that make no sense and for a teacher that lacks its checkpoint.
    """

    def __init__(self, cfg: DictConfig, policy: Policy, rules: Rules, items: ItemDistribution, seed: int, trust=()):
        for key in ("frames", "critic_frames"):
            if not isinstance(cfg[key], int) or isinstance(cfg[key], bool) or cfg[key] < 0:
                raise ValueError(f"warm_start.{key}={cfg[key]}: expected a whole number >= 0.")
        if cfg.frames and cfg.teacher is None:
            raise ValueError(f"warm_start.frames={cfg.frames}: nobody to imitate; expected warm_start=<planner>.")
        self.policy, self.rules, self.seed = policy, rules, seed
        self.teacher, self.frames, self.critic_frames = cfg.teacher, cfg.frames, cfg.critic_frames
        self._parts: dict = {}  # of the teacher
        if self.frames:
            trained = None
            if cfg.checkpoint is not None:
                state, saved = checkpoint.read(checkpoint.locate(str(cfg.checkpoint)))
                theirs = trusted_config(saved["config"], trust)
                trained = (theirs, state, OmegaConf.to_container(theirs.env, resolve=True))
            try:
                self._parts = planner_parts(cfg.teacher, rules, items, trained)
            except ValueError as error:
                raise ValueError(f"warm_start.{error}") from error

    def phase(self, frames: int) -> Phase:
        """What the batch after ``frames`` frames of the run is for."""
        if frames < self.frames:
            return Phase.IMITATION
        return Phase.CRITIC if frames < self.frames + self.critic_frames else Phase.REWARD

    @torch.no_grad()
    def ask(self, data: TensorDictBase, iteration: int) -> Tensor:
        """The teacher's choices, int64 ``[B]``; -1 where what it wants fails, or cannot be done by this policy.

        Args:
            data: observations ``[B]``.
            iteration: of the run. A teacher that draws begins anew with each, so that a resumed run is the same.
        """
        draws = {"seed": self.seed + iteration} if "seed" in self.teacher else {}
        teacher = build("warm_start.teacher", self.teacher, **self._parts, **draws)
        action = teacher.decide(data)
        bin_depth, tote_depth, tote_height = data["bin_depth"], data["tote_depth"], data["tote_height"][:, 0]
        heights = (tote_height[:, None, None] - tote_depth).int()
        item = self.rules.read_item(bin_depth)
        wanted = self.rules.apply(heights, tote_height, item, action)
        choice = self.policy.to_choice(action, bin_depth, tote_depth, tote_height)
        choice = torch.where(wanted.failure == 0, choice, 0)  # any that there is
        # A policy with a pick of its own may not reach the same footprint.
        action = self.policy.to_action(choice, bin_depth, tote_depth, tote_height).clamp(min=0)
        reached = self.rules.apply(heights, tote_height, item, action)
        same = (reached.footprint == wanted.footprint).all(1) & (reached.failure == 0) & (wanted.failure == 0)
        return torch.where(same, choice, -1)


def imitation_loss(policy: Policy, data: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Mean cross-entropy against the teacher's ``taught`` choices, and the share of them that is the likeliest."""
    taught = data["taught"]
    logits = policy(*(data[key] for key in policy.in_keys))
    known = (taught >= 0).sum().clamp(min=1)
    agreed = (logits.argmax(-1) == taught).sum() / known
    return F.cross_entropy(logits, taught, ignore_index=-1, reduction="sum") / known, agreed
