"""The protocol of planners, and the arguments that they are made with."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from omegaconf import DictConfig
from torch import Tensor

from pickplace.common.validate import one_of
from pickplace.config.errors import sentence
from pickplace.config.registry import find
from pickplace.items.distributions import ItemDistribution
from pickplace.policies.restore import restore_critic, restore_policy
from pickplace.rules.cell import CellSpec
from pickplace.rules.grasps import PICKS, select_pick
from pickplace.rules.item import Observation
from pickplace.rules.masks import PlacingMaps, action_footprints, action_mask, placing_maps
from pickplace.rules.observation import Term
from pickplace.rules.state import State


@runtime_checkable
class BatchPlanner(Protocol):
    """Decides where to pick, where to place and how to turn, for ``N`` problems at once.

    A planner is made as ``Planner(cell, ...)``. A class attribute ``needs`` names further arguments that pickplace
    hands over: ``"items"`` (the item distribution), ``"terms"`` (of the observation), ``"policy"`` and ``"critic"`` (of
    the checkpoint).

    Optional methods: ``evaluation_facts() -> dict`` describes the planner in ``evaluation.json`` (of a policy:
    ``candidates`` and ``mask_at_decision``), ``statistics() -> dict`` adds figures to it after the episodes, and
    ``heat_map(observation) -> [N, W_T, D_T]`` adds a picture to a replay.

    Attributes:
        name: its name in tables and in ``evaluation.json``.
    """

    name: str

    def decide(self, observation: Observation) -> Tensor:
        """Return flat actions, int64 ``[N]``."""
        ...


class MapPlanner(ABC):
    """A planner that chooses among the actions that given maps allow, so that it serves a robot, too.

    Attributes:
        cell: the sizes.
        name: as of :class:`BatchPlanner`.
    """

    name: str
    cell: CellSpec

    @abstractmethod
    def choose(self, cell: CellSpec, state: State, maps: PlacingMaps, observation: Observation) -> Tensor:
        """Return flat actions, int64 ``[N]``, feasible ones where there are any.

        Args:
            cell: the sizes; for a robot heights are counted in another unit, and there may be limits.
            state: heights in that unit.
            maps: what decides which actions succeed.
            observation: what a policy sees, in the height units of its training.
        """

    @torch.no_grad()
    def decide(self, observation: Observation) -> Tensor:
        """Return flat actions, int64 ``[N]``."""
        state = State.from_observation(observation)
        return self.choose(self.cell, state, placing_maps(self.cell, state), observation)


#: Which of the items in the bin a planner considers.
ITEM_RULES = ("any", "first", "nearest")


def check_item_rule(rule: str) -> str:
    """Return the setting ``planner.item`` if it is one of :data:`ITEM_RULES`."""
    return one_of("planner.item", rule, ITEM_RULES)


def restrict_items(rule: str, state: State, mask: Tensor) -> Tensor:
    """Return a mask of choices in which one item of each bin is left, the first by a rule that has any choice.

    Args:
        rule: ``"first"``: in the order of arrival; ``"nearest"``: by the distance of the item's centre from the bin's
            origin; ``"any"``: the mask stays as it is.
        state: has the items.
        mask: bool ``[N, M * C]``, those of an item side by side.
    """
    items = state.items
    count = items.x.shape[1]
    if rule == "any":
        return mask
    mask = mask.unflatten(1, (count, -1))
    order = torch.arange(count, device=mask.device).expand_as(items.x)
    if rule == "nearest":
        distance = (2 * items.x + items.w) ** 2 + (2 * items.y + items.d) ** 2
        order = distance * count + order
    order = torch.where(mask.any(2), order, torch.iinfo(order.dtype).max)
    chosen = order == order.amin(1, keepdim=True)
    return (mask & chosen[:, :, None]).flatten(1)


def pick_first(cell: CellSpec, maps: PlacingMaps, rule: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return a pick that does not look at the tote, and what can be done with it.

    Args:
        maps: of one item in each bin.
        rule: a key of :data:`~pickplace.rules.grasps.PICKS`.

    Returns:
        the pick cell, int64 ``[N]``; and of every place and rotation, ``[N, W_T * D_T * R]``, the item's footprint,
        int64, and whether it succeeds, bool.
    """
    pick = PICKS[rule](cell, maps.item, maps.blocked)
    alone = maps.item.rows((slice(None), None))
    footprint = select_pick(cell, action_footprints(cell, alone, maps.blocked), pick)
    return pick, footprint, select_pick(cell, action_mask(cell, maps), pick)


def decide(
    planner: BatchPlanner, cell: CellSpec, observation: Observation, choose: Callable[..., Tensor] | None = None
) -> Tensor:
    """Return a planner's flat actions, int64 ``[N]``.

    Args:
        choose: a function of the observation to call in place of the planner's ``decide``.

    Raises:
        ValueError: for anything else, naming the planner's class and what its ``decide`` returned or raised.
    """
    try:
        action, count = (choose or planner.decide)(observation), len(observation["bin_depth"])
    except ValueError:
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
    wanted = f"a tensor of flat actions, int64 of shape [{count}], from 0 to {cell.num_actions - 1}"
    raise ValueError(f"{type(planner).__name__}.decide returned {found}: expected {wanted}.")


def planner_parts(
    planner: DictConfig,
    cell: CellSpec,
    items: ItemDistribution,
    terms: Mapping[str, Term],
    trained: tuple[DictConfig, dict, dict] | None = None,
) -> dict[str, Any]:
    """Return the arguments of a config's planner beside its settings.

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
    parts: dict[str, Any] = {"cell": cell}
    parts |= {key: value for key, value in {"items": items, "terms": terms}.items() if key in needs}
    if "policy" in needs:
        if trained is None:
            raise ValueError(f"checkpoint=null: planner={planner._target_} needs a checkpoint; expected a run folder.")
        cfg, state, env = trained
        parts["policy"] = restore_policy(cfg, cell, state["policy"], env).to(cfg.device)
        if "critic" in needs:
            parts["critic"] = restore_critic(cfg, parts["policy"], state, env)
    return parts
