"""Arguments of planners from a config and a checkpoint, and checked calls of planners."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from pickplace.common.errors import sentence
from pickplace.config.registry import find
from pickplace.items.distributions import ItemDistribution
from pickplace.planners.base import BatchPlanner
from pickplace.policies.restore import restore_critic, restore_policy
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Observation
from pickplace.rules.observation import Term


def decide(
    planner: BatchPlanner, cell: CellSpec, observation: Observation, choose: Callable[..., Tensor] | None = None
) -> Tensor:
    """Return a planner's flat actions, int64 ``[N]``.

    Args:
        choose: a function of the observation to call instead of the planner's ``decide``.

    Raises:
        ValueError: for any other result or error, naming the planner's class and what ``decide`` returned or raised.
        FloatingPointError: for a policy whose scores are not finite.
    """
    try:
        action, count = (choose or planner.decide)(observation), len(observation["bin_depth"])
    except (ValueError, FloatingPointError, TimeoutError):  # their messages say enough
        raise
    except Exception as error:
        raise ValueError(f"{type(planner).__name__}.decide failed: {sentence(error)}") from error
    if not isinstance(action, Tensor):
        found = type(action).__name__ + (f" of {action.dtype}" if hasattr(action, "dtype") else "")
    elif action.dtype != torch.int64 or action.shape != (count,):
        found = f"{str(action.dtype).removeprefix('torch.')} of shape {list(action.shape)}"
    elif outside := action[(action < 0) | (action >= cell.num_actions)].tolist():
        found = f"action {outside[0]}"
    else:
        return action
    raise ValueError(
        f"{type(planner).__name__}.decide returned {found}: expected a tensor of flat actions, int64 of shape "
        f"[{count}], from 0 to {cell.num_actions - 1}."
    )


def planner_parts(
    planner: DictConfig,
    cell: CellSpec,
    items: ItemDistribution,
    terms: Mapping[str, Term],
    trained: tuple[DictConfig, dict, dict] | None = None,
) -> dict[str, Any]:
    """Return the arguments that a planner needs beside the settings of its config.

    Args:
        planner: a config of the group ``planner``.
        cell: the sizes.
        items: for a search to imagine.
        terms: of the observation.
        trained: for a planner that follows a policy: the checkpoint's config with any overrides on top, its tensors,
            and the group ``env`` in training; None: there is no checkpoint.

    Raises:
        ValueError: for a planner that needs a checkpoint without one, or with one that does not serve these sizes.
    """
    needs = getattr(find("planner", planner._target_), "needs", ())
    given: dict[str, Any] = {"items": items, "terms": terms}
    parts = {"cell": cell, **{key: given[key] for key in given if key in needs}}
    if "policy" in needs:
        if trained is None:
            raise ValueError(f"checkpoint=null: planner={planner._target_} needs a checkpoint; expected a run folder.")
        cfg, state, env = trained
        parts["policy"] = restore_policy(cfg, cell, state["policy"], env).to(cfg.device)
        if "critic" in needs:
            parts["critic"] = restore_critic(cfg, parts["policy"], state, env)
    return parts
