"""Warm start: a policy imitates a planner before it learns from reward."""

import re
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pickplace.algorithms.base import Algorithm, BatchPosition, Imitable
from pickplace.common.validate import expect, reword_errors
from pickplace.config.allowlist import trusted_config
from pickplace.config.registry import accepted_arguments, build, find
from pickplace.envs.torchrl import PickPlaceEnv
from pickplace.planners.use import decide, planner_parts
from pickplace.policies.base import MASKED, Policy
from pickplace.rules.state import State
from pickplace.rules.step import apply
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate

#: Puts the keys of ``warm_start`` into errors of planners, which begin with ``planner`` or ``checkpoint``.
_named_keys = reword_errors(
    ValueError,
    lambda error: ValueError(
        re.sub(r"^planner\b", "warm_start.teacher", re.sub(r"^checkpoint\b", "warm_start.checkpoint", str(error)))
    ),
)


class WarmStart:
    """The teacher of a policy, and the phases of its training (config group ``warm_start``).

    Args:
        cfg: the config group ``warm_start``.
        policy: the policy that is trained.
        env: an environment of the training, for its sizes, items and terms.
        seed: seed of a teacher that draws.
        trust: modules of the user whose classes the config of the teacher's checkpoint may name.
        trained: frames of the run so far; once imitation is over, there is no teacher.

    Raises:
        ValueError: naming the key, for a teacher that is missing or cannot be made.
    """

    @_named_keys
    def __init__(
        self,
        cfg: DictConfig,
        policy: Policy,
        env: PickPlaceEnv,
        seed: int,
        trust=(),
        trained: int = 0,
    ):
        self.frames, self.critic_frames = cfg.frames, cfg.critic_frames
        self.policy, self.cell, self.seed = policy, env.cell, seed
        made_by = None if cfg.teacher is None else find("warm_start.teacher", cfg.teacher._target_)
        is_used = cfg.frames > 0 and "policy" in getattr(made_by, "needs", ())
        wanted = "null, or warm_start.frames above 0 and a teacher that follows a policy"
        expect(is_used or cfg.checkpoint is None, "warm_start.checkpoint", cfg.checkpoint, wanted)
        if trained >= cfg.frames:
            return
        expect(cfg.teacher is not None, "warm_start.frames", cfg.frames, "0 without a teacher, or warm_start=imitate")
        teacher = None
        if cfg.checkpoint is not None:
            state, facts = checkpoint.read(locate(cfg.checkpoint))
            trained_cfg = trusted_config(facts["config"], trust)
            trained_cfg.device = str(env.device)  # not that of its own training
            teacher = (trained_cfg, state, cast(dict, OmegaConf.to_container(trained_cfg.env, resolve=True)))
        self._draws = "seed" in (accepted_arguments(find("warm_start.teacher", cfg.teacher._target_)) or cfg.teacher)
        self._settings = cast(dict, OmegaConf.to_container(cfg.teacher, resolve=True))
        self._parts = planner_parts(cfg.teacher, env.cell, env.items, env.terms, teacher)
        self._make_teacher(0)  # refuses bad settings before the first batch

    def _make_teacher(self, iteration: int):
        """Make the teacher anew; one that draws gets a seed of its own in each iteration."""
        seed = {"seed": self.seed + iteration} if self._draws else {}
        return build("warm_start.teacher", {**self._settings, **seed}, **self._parts)

    @torch.no_grad()
    @_named_keys
    def ask(self, data: TensorDictBase, iteration: int) -> Tensor:
        """Return the teacher's choices, int64 ``[B]``; -1 where its action fails or this policy cannot choose it.

        Args:
            data: observations ``[B]``.
            iteration: the run's batch number; it seeds a teacher that draws, so that a resumed run is the same.
        """
        action = decide(self._make_teacher(iteration), self.cell, data)
        state = State.from_observation(data)
        wanted = apply(self.cell, state, action)
        choice = torch.where(wanted.failure == 0, self.policy.to_choice(action, data), 0)  # any choice will do
        # A policy with a pick of its own may not reach the same footprint.
        reached = apply(self.cell, state, self.policy.to_action(choice, data).clamp(min=0))
        same = (reached.footprint == wanted.footprint).all(1) & (reached.taken == wanted.taken)
        return torch.where(same & (reached.failure == 0) & (wanted.failure == 0), choice, -1)


class Imitation(Algorithm):
    """An algorithm whose policy imitates a teacher first. Then the critic learns alone. Then both learn as usual.

    The policy itself acts from the first frame on, and the teacher is asked in the states that it reaches (DAgger, Ross
    et al. 2011). So the policy learns how to continue after its own mistakes, and the critic learns the values of this
    policy. Optimizer, minibatches and the critic's loss are those of the inner algorithm.

    Args:
        inner: the algorithm, an :class:`~pickplace.algorithms.base.Imitable`.
        warm_start: the teacher and the phases.
    """

    def __init__(self, inner: Any, warm_start: WarmStart):
        self.inner, self.warm_start, self.next_keys = inner, warm_start, inner.next_keys

    def acting_policy(self) -> TensorDictModuleBase:
        return self.inner.acting_policy()

    def learn(self, batch: TensorDictBase, position: BatchPosition) -> dict[str, float]:
        start = self.warm_start
        if position.frames_before >= start.frames + start.critic_frames:
            return self.inner.learn(batch, position)
        data = self.inner.prepare(batch, position)
        if position.frames_before < start.frames:
            data["taught"] = start.ask(batch.reshape(-1), position.iteration)
        return self.inner.descend(data, position, self.objective)

    def objective(self, data: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """Return the critic's loss, plus the imitation loss if there is an entry ``data["taught"]``."""
        _, losses = self.inner.objective(data)
        total = losses["loss_critic"]
        if "taught" in data:
            losses["loss_imitation"], losses["agreement"] = imitation_loss(self.warm_start.policy, data)
            total = total + losses["loss_imitation"]
        return total, losses

    def state_dict(self) -> dict:
        return self.inner.state_dict()

    def load_state_dict(self, state: Any) -> None:
        self.inner.load_state_dict(state)

    def memory(self, frame: int) -> dict[str, int]:
        policy = self.warm_start.policy  # imitation needs all its logits
        all_logits = self.inner.learning_memory(policy.learning_bytes()) if self.warm_start.frames else {}
        return self.inner.memory(frame) | all_logits


def with_warm_start(algorithm: Algorithm, warm_start: WarmStart) -> Algorithm:
    """Return an algorithm with a warm start, or the algorithm itself if the phases of the warm start have no frames.

    Raises:
        ValueError: for an algorithm whose policy cannot imitate.
    """
    for key in ("frames", "critic_frames"):
        frames, can_imitate = getattr(warm_start, key), isinstance(algorithm, Imitable)
        expect(
            can_imitate or not frames, f"warm_start.{key}", frames, f"0; {type(algorithm).__name__} imitates no teacher"
        )
    return Imitation(algorithm, warm_start) if warm_start.frames + warm_start.critic_frames else algorithm


def imitation_loss(policy: Policy, data: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return the mean cross-entropy against the teacher's choices ``taught``, and the share of these that are the
    policy's most probable choices."""
    taught, logits = data["taught"], policy.logits(data)
    # A policy that leaves out some feasible choices cannot learn them.
    reached = logits.gather(1, taught.clamp(min=0)[:, None])[:, 0] > MASKED / 2
    taught = torch.where(reached, taught, -1)
    known = (taught >= 0).sum().clamp(min=1)
    loss = torch.nn.functional.cross_entropy(logits, taught, ignore_index=-1, reduction="sum")
    return loss / known, (logits.argmax(-1) == taught).sum() / known
