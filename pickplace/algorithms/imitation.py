"""Warm start: a policy imitates a planner before it learns from reward."""

import re
from collections.abc import Mapping
from contextlib import contextmanager
from enum import Enum
from typing import cast

import torch
import torch.nn.functional as F
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor

from pickplace.common.validate import excerpt, whole_number
from pickplace.config.allowlist import trusted_config
from pickplace.config.registry import accepted_arguments, build, find
from pickplace.items.distributions import ItemDistribution
from pickplace.planners.base import BatchPlanner, decide, planner_parts
from pickplace.policies.base import MASKED, Policy
from pickplace.rules.cell import CellSpec
from pickplace.rules.observation import Term
from pickplace.rules.state import State
from pickplace.rules.step import apply
from pickplace.runs import checkpoint


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
        cell: the sizes.
        items: the item distribution, for a teacher that samples items.
        terms: of the observation, by key.
        seed: seed of a teacher that draws.
        trust: modules of the user whose classes the config of the teacher's checkpoint may name.

    Raises:
        ValueError: naming the key, for a bad number or a teacher without its checkpoint.
    """

    def __init__(
        self,
        cfg: DictConfig,
        policy: Policy,
        cell: CellSpec,
        items: ItemDistribution,
        terms: Mapping[str, Term],
        seed: int,
        trust=(),
    ):
        for key in ("frames", "critic_frames"):
            whole_number(f"warm_start.{key}", cfg[key], 0)
        if cfg.frames and cfg.teacher is None:
            raise ValueError(f"warm_start.frames={cfg.frames}: there is no teacher; expected warm_start=imitate.")
        if cfg.teacher is not None and not OmegaConf.is_dict(cfg.teacher):
            given = excerpt(cfg.teacher)
            raise ValueError(f"warm_start.teacher={given}: expected planner@warm_start.teacher=<planner>.")
        self.policy, self.cell, self.seed = policy, cell, seed
        self.teacher, self.frames, self.critic_frames = cfg.teacher, cfg.frames, cfg.critic_frames
        known = accepted_arguments(find("warm_start.teacher", cfg.teacher._target_)) if self.frames else ()
        self._draws = "seed" in (cfg.teacher if known is None else known)
        self._parts = self._teacher_parts(cfg, items, terms, trust) if self.frames else {}
        if self.frames:
            self._make_teacher(seed)  # refuses bad settings before the first batch

    def _teacher_parts(self, cfg: DictConfig, items: ItemDistribution, terms: Mapping[str, Term], trust) -> dict:
        """Return the teacher's arguments beside its settings, such as the policy of its checkpoint."""
        trained = None
        if cfg.checkpoint is not None:
            state, facts = checkpoint.read(checkpoint.locate(str(cfg.checkpoint)))
            trained_cfg = trusted_config(facts["config"], trust)
            trained = (trained_cfg, state, cast(dict, OmegaConf.to_container(trained_cfg.env, resolve=True)))
        try:
            return planner_parts(cfg.teacher, self.cell, items, terms, trained)
        except ValueError as error:
            raise ValueError(f"warm_start.{error}") from error

    def _make_teacher(self, seed: int) -> BatchPlanner:
        """Make the teacher anew; one that draws gets the seed."""
        settings = cast(dict, OmegaConf.to_container(self.teacher, resolve=True))
        with _named_teacher():
            return build("warm_start.teacher", {**settings, **({"seed": seed} if self._draws else {})}, **self._parts)

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
        teacher = self._make_teacher(self.seed + iteration)
        with _named_teacher():
            action = decide(teacher, self.cell, data)
        state = State.from_observation(data)
        wanted = apply(self.cell, state, action)
        choice = self.policy.to_choice(action, data)
        choice = torch.where(wanted.failure == 0, choice, 0)  # any choice will do
        # A policy with a pick of its own may not reach the same footprint.
        action = self.policy.to_action(choice, data).clamp(min=0)
        reached = apply(self.cell, state, action)
        same = (reached.footprint == wanted.footprint).all(1) & (reached.taken == wanted.taken)
        same &= (reached.failure == 0) & (wanted.failure == 0)
        return torch.where(same, choice, -1)


@contextmanager
def _named_teacher():
    """Name a teacher's settings in the errors of planners, which call them ``planner``."""
    try:
        yield
    except ValueError as error:
        raise ValueError(re.sub(r"^planner\b", "warm_start.teacher", str(error))) from error


def imitation_loss(policy: Policy, data: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return the mean cross-entropy against the teacher's choices ``taught``, and the share of these that the policy
    finds most probable."""
    taught, logits = data["taught"], policy.logits(data)
    # A policy that leaves out some of what is feasible cannot learn to choose that.
    reached = logits.gather(1, taught.clamp(min=0)[:, None])[:, 0] > MASKED / 2
    taught = torch.where(reached, taught, -1)
    known = (taught >= 0).sum().clamp(min=1)
    agreed = (logits.argmax(-1) == taught).sum() / known
    return F.cross_entropy(logits, taught, ignore_index=-1, reduction="sum") / known, agreed
