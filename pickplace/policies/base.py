"""The abstract policy, and its forms for TorchRL.

A policy chooses among *choices*. A choice is a flat action, or a class of flat actions that the policy treats alike.
The probability of a choice is spread evenly over the flat actions of its class. So PPO's ratio and entropy are those
of the choice.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import ValueOperator
from typing_extensions import Self

from pickplace.common.validate import expect, refuse_above, refuse_if
from pickplace.rules.cell import CellSpec
from pickplace.rules.item import Observation
from pickplace.rules.maps import FAR
from pickplace.rules.masks import PlacingMaps, action_mask
from pickplace.rules.observation import item_keys, standard_terms
from pickplace.rules.state import State

#: Logit of a forbidden choice: far below any score of a network, so its probability is exactly 0 in float32. The rest
#: of float32's range is left for differences from the greatest logit.
MASKED = -1e38

#: Greatest number of parameters of a network; with gradients and Adam's moments each takes 16 bytes.
MAX_PARAMETERS = 110_000_000

#: The entries of the observation that every network reads.
DEPTH_KEYS = ("bin_depth", "tote_depth")

#: Entries of the observation that the networks of ``fcn_grasp`` read.
MAP_KEYS = ("bin_depth", "tote_depth", "tote_bearing")


class Ranking(NamedTuple):
    """A policy's scores of all choices in ``N`` problems, and the best one."""

    action: Tensor  #: flat action of the best choice, int64 [N]
    scores: Tensor  #: a logit for each choice, float32 [N, choices]
    reach: Callable[[Tensor, Tensor], Tensor]  #: from problems and choices, int64 [K] each, to flat actions


class Policy(TensorDictModuleBase, ABC):
    """A distribution over choices, given an observation; as a module it writes ``logits`` ``[N, choices]``.

    Choices are flat actions, unless a policy sets :attr:`choice_key` and overrides the methods that convert them.

    Args:
        cell: the sizes.
        masks: masks that the environment must emit in training: any of ``"action"``, ``"footprint"`` and ``"corner"``.

    Attributes:
        choice_key: name of the choice in the TensorDict.
        masks: the masks among :attr:`in_keys`.
        in_keys: entries of the observation that :meth:`logits` reads.
        map_keys: entries of the observation that its network reads.
        excludes: names the actions to which :meth:`action_log_probs` always gives probability 0; None: there are none.
        any_bin: whether its network scores bins of any size; else those of its cell only.
        least_tote: least number of cells along a side of a tote that an exported network accepts.

    Raises:
        ValueError: see :meth:`check_cell`.
    """

    choice_key: str = "action"
    map_keys: tuple[str, ...] = DEPTH_KEYS
    excludes: str | None = None
    any_bin: bool = True
    least_tote: int = 3  # the rules look at squares of the longest item's side, usually 3
    network: Any

    def __init__(self, cell: CellSpec, masks: Sequence[str] = ()):
        super().__init__()
        self.check_cell(cell)
        self.cell = cell
        self.in_keys, self.out_keys = [*self.map_keys, *(f"{mask}_mask" for mask in masks)], ["logits"]

    @property
    def masks(self) -> tuple[str, ...]:
        return tuple(key.removesuffix("_mask") for key in self.in_keys if key.endswith("_mask"))

    def check_cell(self, cell: CellSpec) -> None:
        """Refuse a cell that the policy does not serve, with a ``ValueError``."""

    @abstractmethod
    def logits(self, observation: Observation) -> Tensor:
        """Return a logit for each choice, float32 ``[N, choices]``."""

    def choice_logits(self, observation: Observation, choices: Tensor) -> Tensor:
        """Return the logits of some choices that a mask allows, ``[N, M]``, up to a constant for each row.

        A policy overrides this if it can compute them without all the other logits.

        Args:
            observation: as for :meth:`logits`.
            choices: int64 ``[N, M]``.
        """
        return self.logits(observation).gather(1, choices)

    def to_action(self, choice: Tensor, observation: Observation) -> Tensor:
        """Return a flat action of each choice's class, ``[N]``: drawn uniformly if exploring, else the lowest one."""
        return choice

    def to_choice(self, action: Tensor, observation: Observation) -> Tensor:
        """Return the choice to which each flat action belongs, int64 ``[N]``; the action must succeed."""
        return action

    @abstractmethod
    def action_log_probs(self, observation: Observation) -> Tensor:
        """Return the distribution over flat actions, ``[N, N_a]``, without any mask."""

    def forward(self, observation: TensorDictBase) -> TensorDictBase:
        return observation.set("logits", self.logits(observation))

    def best_feasible(self, observation: Observation, maps: PlacingMaps) -> Tensor:
        """Return the most probable feasible action, int64 ``[N]``: the best of :meth:`rank`."""
        return self.rank(observation, maps).action

    def rank(self, observation: Observation, maps: PlacingMaps) -> "Ranking":
        """Return the feasible choices with their scores.

        If all feasible choices have probability 0, the most probable action counts as the best one, and fails.

        Args:
            observation: the input of the networks.
            maps: determine which actions are feasible.
        """
        score = self.action_log_probs(observation)
        return rank_actions(torch.where(action_mask(self.cell, maps), score, score - FAR))

    def with_cell(self, cell: CellSpec) -> Self:
        """Return this policy for a cell with other limits or another number of items. It shares the networks.

        Raises:
            ValueError: see :meth:`check_cell`.
        """
        self.check_cell(cell)
        other = copy(self)
        other.cell = cell
        other.in_keys = [*dict.fromkeys([*self.in_keys, *self.item_keys(cell)])]
        return other

    def item_keys(self, cell: CellSpec) -> tuple[str, ...]:
        """Return the entries of the observation that list items and that the policy reads."""
        return item_keys(cell.bin_items)

    def act(self, choice: Tensor, *values: Tensor) -> Tensor:
        """Return :meth:`to_action` of an observation given as the values of :attr:`act_keys`, in that order."""
        return self.to_action(choice, dict(zip(self.act_keys, values, strict=True)))

    @property
    def act_keys(self) -> list[str]:
        """Entries of the observation that :meth:`to_action` may read."""
        return list(dict.fromkeys([*standard_terms(self.cell), *self.in_keys]))

    def learning_bytes(self, samples: int | None = None) -> int:
        """Return the approximate bytes of a frame in a gradient step; with ``fcn_grasp`` 90 kB at the paper's cell.

        Args:
            samples: number of choices in each frame whose logits are computed, beside the taken one; None: all.
        """
        return 1_250 * self.cell.num_choices

    @property
    def acting_bytes(self) -> int:
        """Approximate bytes of a problem when a choice is drawn."""
        return 40 * self.cell.num_choices

    def check_sizes(self) -> list[str]:
        """Check the paper's conditions on sizes in training: eq. 2 on the items, eq. 3 on the bin and the tote.

        Returns:
            A sentence for each condition that is not met; the policy can still be trained.
        """
        field = getattr(getattr(self, "network", None), "receptive_field", None) or 0
        side = self.cell.longest_side or self.cell.max_side
        found = [
            f"env.{key}={list(size)}: expected sides of at least {field} (receptive field {field}, the paper's eq. 3)."
            for key, size in (("bin_size", self.cell.bin_size), ("tote_size", self.cell.tote_size))
            if min(size[:2]) < field
        ]
        if field and side > (most := field / 2 + 1):
            wanted = f"expected at most {most:g} (receptive field {field}, the paper's eq. 2)"
            found.insert(0, f"items: the longest side is {side}, {wanted}.")
        return found


class ActionPolicy(Policy):
    """Chooses among all ``N_a`` flat actions by their scores.

    Args:
        cell: the sizes.
        mask_infeasible: choose among feasible actions only.
    """

    def __init__(self, cell: CellSpec, mask_infeasible: bool = False):
        super().__init__(cell, masks=("action",) if mask_infeasible else ())

    @abstractmethod
    def action_scores(self, observation: Observation, mask: Tensor | None = None) -> Tensor:
        """Return logits ``[N, N_a]``; :data:`MASKED` where a mask, bool ``[N, N_a]``, forbids the action."""

    def logits(self, observation: Observation) -> Tensor:
        return self.action_scores(observation, observation["action_mask"] if self.masks else None)

    def action_log_probs(self, observation: Observation) -> Tensor:
        return self.action_scores(observation).log_softmax(-1)

    def rank(self, observation: Observation, maps: PlacingMaps) -> "Ranking":
        return rank_actions(self.action_scores(observation, action_mask(self.cell, maps)))


@runtime_checkable
class EstimatesValue(Protocol):
    """A policy that is derived from values of states: its network is also the critic, and learns by TD(lambda)."""

    def value_network(self) -> torch.nn.Module:
        """Return the module that maps the entries of the observation in its ``in_keys`` to values ``[..., 1]``.

        ``algo=td`` needs a :class:`~pickplace.policies.afterstate.value.ToteValue`: it learns the parts of the value.
        """

    def items_left(self, observation: Observation, choice: Tensor) -> Tensor:
        """Return the items that are seen after a choice, before others arrive, int64 ``[N, M + p, 5]``."""

    def evaluate_choices(self, before: State, choice: Tensor) -> tuple[State, Tensor, Tensor]:
        """Return the states after choices and before items arrive, the volumes placed, int64 ``[N]``, and the values of
        these states, float32 ``[N]``, in the scale of the network.

        Args:
            before: the states.
            choice: feasible choices, int64 ``[N]``: ``item * num_footprints + footprint``.
        """


@runtime_checkable
class ScoresFootprints(Protocol):
    """A policy that chooses among the footprints that some action reaches, or among a part of them."""

    def ranked(self, maps: PlacingMaps) -> Tensor:
        """Return a mask of the footprints to choose among, bool ``[N, M * Q * W_T * D_T]``; at least one if any is
        feasible."""

    def footprint_logits(self, observation: Observation, mask: Tensor) -> Tensor:
        """Return logits of the footprints, float32 in the shape of the mask; :data:`MASKED` where it is false."""


@runtime_checkable
class ScoresActions(Protocol):
    """A policy whose network scores flat actions one by one."""

    def action_scores(self, observation: Observation, mask: Tensor | None = None) -> Tensor:
        """Return logits, float32 ``[N, N_a]``; :data:`MASKED` where a mask of that shape forbids the action."""


@runtime_checkable
class ScoresAnySize(Protocol):
    """A policy that scores bins and totes of any size, so that its network can be exported.

    Attributes:
        score_index: formula of an index of the scores.
        any_bin: whether bins may have any size; else totes only.
        least_tote: least number of cells along a side of a tote.
    """

    score_index: str
    any_bin: bool
    least_tote: int

    def unmasked_scores(self, observation: Observation) -> Tensor:
        """Return the scores of all actions or footprints, feasible or not, float32 ``[N, scores]``; it reads the
        entries ``in_keys`` except the masks."""


class ChoiceDistribution(Categorical):
    """A categorical distribution over choices, without the checks that dominate a small PPO update."""

    def __init__(self, logits: Tensor):
        super().__init__(logits=logits, validate_args=False)

    @property
    def deterministic_sample(self) -> Tensor:
        return self.logits.argmax(-1)

    def sample(self, sample_shape=()):
        """Sample by the inverse of the distribution function, with one uniform number a row."""
        if sample_shape:
            return super().sample(sample_shape)
        edges = self.probs.double().cumsum(-1)
        uniform = torch.rand(edges.shape[:-1], dtype=torch.float64, device=edges.device) * edges[..., -1]
        return torch.searchsorted(edges, uniform[..., None], right=True)[..., 0].clamp(max=edges.shape[-1] - 1)


def refuse_several_items(policy: Policy, cell: CellSpec) -> None:
    """Refuse a bin with several items: the ``check_cell`` of a policy that does not choose among them."""
    others = "model=afterstate, fcn_grasp with a mask, and fcn4d choose among several items"
    expect(cell.bin_items == 1, "env.bin_items", cell.bin_items, f"1 with {type(policy).__name__}; {others}")


def best_choice(scores: Tensor) -> Tensor:
    """Return the choice with the greatest score, int64 ``[N]``, given scores ``[N, choices]``; errors: see
    :func:`check_finite`."""
    return check_finite(scores).argmax(1)


def rank_actions(scores: Tensor) -> Ranking:
    """Return the ranking of flat actions by their scores, float32 ``[N, N_a]``."""
    return Ranking(best_choice(scores), scores, lambda row, action: action)


def check_finite(scores: Tensor) -> Tensor:
    """Return the scores ``[N, choices]`` if the greatest of each row is finite.

    Raises:
        FloatingPointError: otherwise. The weights and settings of a checkpoint may be finite, and yet overflow.
    """
    refuse_if(
        not scores.amax(1).isfinite().all(),
        "the policy's scores are not finite; expected a checkpoint whose weights, reward_scale and temperature fit "
        "each other.",
        FloatingPointError,
    )
    return scores


def pick_one(candidates: Tensor) -> Tensor:
    """Return an entry >= 0 of each row of int64 ``[N, M]``, -1 if none: drawn when exploring, else the lowest."""
    explores = exploration_type() == ExplorationType.RANDOM
    order = torch.rand(candidates.shape, device=candidates.device) if explores else FAR**2 - candidates
    return candidates.gather(1, torch.where(candidates >= 0, order, -1).argmax(1, keepdim=True))[:, 0]


def refuse_large_network(make: Callable[[], torch.nn.Module], key: str) -> None:
    """Refuse a network with more parameters than :data:`MAX_PARAMETERS`, before memory is allocated.

    A network whose constructor needs the values of tensors is not counted.

    Args:
        make: makes the network.
        key: its place in the config.

    Raises:
        ValueError: naming the key and the number; and what ``make`` raises.
    """
    try:
        with torch.device("meta"):
            network = make()
    except RuntimeError:  # meta tensors have no values
        return
    count = sum(parameter.numel() for parameter in network.parameters())
    refuse_above(f"{key}: the network has", count, "parameters", MAX_PARAMETERS)


def as_critic(critic: torch.nn.Module) -> ValueOperator:
    """Return a value network as a module of TorchRL; it reads the entries of the observation in its ``in_keys``."""
    return ValueOperator(critic, list(getattr(critic, "in_keys", DEPTH_KEYS)))


def as_actor(policy: Policy) -> ProbabilisticTensorDictSequential:
    """Return the policy for TorchRL's losses: observation -> ``logits`` -> a choice and its log-probability."""
    return ProbabilisticTensorDictSequential(
        policy,
        ProbabilisticTensorDictModule(
            in_keys=["logits"],
            out_keys=[policy.choice_key],
            distribution_class=ChoiceDistribution,
            default_interaction_type=ExplorationType.RANDOM,
            return_log_prob=True,
            log_prob_key="log_prob",
        ),
    )


def as_collection_policy(policy: Policy) -> TensorDictSequential:
    """Return the policy for the collector: it writes choice, log-probability and flat action, but no logits."""
    keys = list(dict.fromkeys([policy.choice_key, "log_prob", "action"]))
    return TensorDictSequential(as_actor(policy), act_module(policy), selected_out_keys=keys)


def act_module(policy: Policy) -> TensorDictModule:
    """Return :meth:`Policy.act` as a module: a choice and the observation -> ``action``."""
    return TensorDictModule(policy.act, in_keys=[policy.choice_key, *policy.act_keys], out_keys=["action"])
