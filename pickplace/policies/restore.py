"""Policies and critics from checkpoints."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from pickplace.policies.base import Policy, as_critic
from pickplace.runs import checkpoint
from pickplace.runs.registry import build
from pickplace.task.cell import CellSpec
from pickplace.task.state import Observation

SIZES = ("effector_size", "bin_size", "tote_size")


def restore_policy(cfg: DictConfig, cell: CellSpec, state: dict, trained_env: dict) -> Policy:
    """Return the policy of a checkpoint for a cell, whose sizes need not be those of the training.

    Args:
        cfg: the checkpoint's config, with any overrides on top.
        cell: the sizes.
        state: the policy's tensors, ``state["policy"]`` of :func:`pickplace.runs.checkpoint.read`.
        trained_env: the group ``env`` in training; its ``rotations`` must not be exceeded.

    Raises:
        ValueError: for more rotations than were trained, or tensors that do not fit the config or the sizes.
    """
    if cell.rotations > trained_env["rotations"]:
        raise ValueError(
            f"env.rotations={cell.rotations}: the checkpoint was trained with {trained_env['rotations']}; "
            "expected no more."
        )

    def restored(cell: CellSpec) -> Policy:
        make = partial(build, "model.actor", cfg.model.actor, cell=cell, mask_infeasible=cfg.algo.mask_infeasible)
        return checkpoint.restore(make, state, "policy").eval()

    try:
        return restored(cell)
    except checkpoint.CheckpointError as error:
        sizes: dict[str, Any] = {key: tuple(trained_env[key]) for key in SIZES if key in trained_env}
        sizes = {key: size for key, size in sizes.items() if size != getattr(cell, key)}
        if not sizes:
            raise
        restored(replace(cell, limits=None, **sizes))  # if that fails too, the sizes are not the reason
        ours = ", ".join(f"env.{key}={[*getattr(cell, key)]}" for key in sizes)
        theirs = ", ".join(f"{[*size]}" for size in sizes.values())
        raise checkpoint.CheckpointError(
            f"{ours}: the checkpoint was trained with {theirs}, and its policy does not serve every other size."
        ) from error


@dataclass(frozen=True)
class RestoredCritic:
    """A function from observations to values ``[N, 1]``, in cells times height units."""

    network: torch.nn.Module
    in_keys: list[str]
    reward_scale: float

    def __call__(self, observation: Observation) -> Tensor:
        return self.network(*(observation[key] for key in self.in_keys)) / self.reward_scale


def restore_critic(cfg: DictConfig, cell: CellSpec, state: dict, trained_env: dict) -> RestoredCritic | None:
    """Return the critic of a checkpoint.

    Args:
        cfg: the checkpoint's config.
        cell: the sizes.
        state: as :func:`pickplace.runs.checkpoint.read` returns it, with or without ``state["critic"]``.
        trained_env: the group ``env`` in training.

    Returns:
        None where there is no critic, or it does not serve this tote.
    """
    if "critic" not in state:
        return None

    def make():
        return as_critic(build("model.critic", cfg.model.critic, cell=cell))

    with torch.device("meta"):
        any_size = getattr(make().module, "any_size", False)
    if tuple(trained_env["tote_size"][:2]) != cell.tote_size[:2] and not any_size:
        return None
    critic = checkpoint.restore(make, state["critic"], "critic").to(cfg.device).eval()
    return RestoredCritic(critic.module, list(critic.in_keys), cfg.algo.reward_scale)
