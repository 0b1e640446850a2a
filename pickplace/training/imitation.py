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
from pickplace.runs.allowlist import trusted
from pickplace.runs.registry import build
from pickplace.task.geometry import Rules
from pickplace.task.items import ItemDistribution


class Phase(Enum):
    """The phases of a training: what the policy learns from."""

    IMITATION = "imitation"  # the teacher's choices; the critic learns the policy's values meanwhile
    CRITIC = "critic"  # nothing: only the critic learns, the values of the imitating policy
    REWARD = "reward"


class WarmStart:
    """Imitation of a planner, then training of the critic alone, then reward.

    The policy itself acts from the first frame on, and the teacher is asked in the states that it reaches (DAgger, Ross
    et al. 2011). So the policy learns how to continue after its own mistakes, and the critic learns the values of the
    policy that it will serve.

    Args:
        cfg: the config group ``warm_start``.
        policy: the policy that is trained.
        rules: the task's sizes.
        items: the item distribution, for a teacher that samples items.
        seed: seed of a teacher that draws.
        trust: modules of the user whose classes the config of the teacher's checkpoint may name.

    Raises:
        ValueError: naming the key, for a bad number or a teacher without its checkpoint.
    """

    def __init__(self, cfg: DictConfig, policy: Policy, rules: Rules, items: ItemDistribution, seed: int, trust=()):
        for key in ("frames", "critic_frames"):
            if not isinstance(cfg[key], int) or isinstance(cfg[key], bool) or cfg[key] < 0:
                raise ValueError(f"warm_start.{key}={cfg[key]}: expected a whole number >= 0.")
        if cfg.frames and cfg.teacher is None:
            raise ValueError(f"warm_start.frames={cfg.frames}: there is no teacher; expected warm_start=imitate.")
        self.policy, self.rules, self.seed = policy, rules, seed
        self.teacher, self.frames, self.critic_frames = cfg.teacher, cfg.frames, cfg.critic_frames
        self._parts = self._teacher_parts(cfg, items, trust) if self.frames else {}

    def _teacher_parts(self, cfg: DictConfig, items: ItemDistribution, trust) -> dict:
        """Return the teacher's arguments beside its settings, such as the policy of its checkpoint."""
        trained = None
        if cfg.checkpoint is not None:
            state, facts = checkpoint.read(checkpoint.locate(str(cfg.checkpoint)))
            trained_cfg = trusted(facts["config"], trust)
            trained = (trained_cfg, state, OmegaConf.to_container(trained_cfg.env, resolve=True))
        try:
            return planner_parts(cfg.teacher, self.rules, items, trained)
        except ValueError as error:
            raise ValueError(f"warm_start.{error}") from error

    def phase(self, frames: int) -> Phase:
        """Return the phase of the batch that begins after ``frames`` frames of the run."""
        if frames < self.frames:
            return Phase.IMITATION
        return Phase.CRITIC if frames < self.frames + self.critic_frames else Phase.REWARD

    @torch.no_grad()
    def ask(self, data: TensorDictBase, iteration: int) -> Tensor:
        """Return the teacher's choices, int64 ``[B]``; -1 where its action fails or this policy cannot choose it.

        Args:
            data: observations ``[B]``.
            iteration: the run's batch number; it seeds a teacher that draws, so that a resumed run is the same.
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
    """Return the mean cross-entropy against the teacher's choices ``taught``, and the share of these that the policy
    finds most probable."""
    taught = data["taught"]
    logits = policy(*(data[key] for key in policy.in_keys))
    known = (taught >= 0).sum().clamp(min=1)
    agreed = (logits.argmax(-1) == taught).sum() / known
    return F.cross_entropy(logits, taught, ignore_index=-1, reduction="sum") / known, agreed


def taught_by(cfg: dict) -> str | None:
    """Return the name of the planner that a run with this saved config imitated, or None."""
    start = cfg.get("warm_start") or {}
    return start["teacher"]["_target_"].rpartition(".")[2] if start.get("frames") else None
