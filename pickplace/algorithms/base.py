"""The interface of algorithms: what a training does with a batch (config group ``algo``)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pickplace.common.graphs import NO_COMPILE, CompileSettings
from pickplace.common.validate import excerpt, refuse_any, refuse_if
from pickplace.rules.observation import Term
from pickplace.runs.checkpoint import matching_state
from pickplace.runs.locate import CheckpointError


class BatchPosition(NamedTuple):
    """The place of a batch in its run.

    Attributes:
        frames_before: frames of the run before the batch.
        frames: frames of the run, the batch included.
        iteration: number of the batch, from 1.
        total_frames: the run's budget in frames.
    """

    frames_before: int
    frames: int
    iteration: int
    total_frames: int


@dataclass(frozen=True)
class Task:
    """Facts of the training that an algorithm is made for, beside its networks.

    Attributes:
        terms: of the observation, by key.
        observation: an observation of zeros, ``[1]``, with the masks of the policy.
        reward_scale: factor by which rewards are to be multiplied.
        num_envs: ``N``, environment slots.
        rollout_length: ``T``, steps of each slot in a batch.
        compile: how the gradient step is compiled.
    """

    terms: Mapping[str, Term]
    observation: TensorDictBase
    reward_scale: float
    num_envs: int
    rollout_length: int
    compile: CompileSettings = NO_COMPILE

    @property
    def batch_frames(self) -> int:
        return self.num_envs * self.rollout_length


class Algorithm(ABC):
    """Base class of algorithms, each made as ``Class(policy, critic, task, **settings)``.

    ``policy`` is a :class:`~pickplace.policies.base.Policy`, ``critic`` a TorchRL ``ValueOperator`` or None, ``task`` a
    :class:`Task`, and the settings are the keys of its config file. The training saves the weights of policy and
    critic; everything else that a resumed run needs is in :meth:`state_dict`.

    Attributes:
        next_keys: masks, such as ``"action_mask"``, that the batch must hold under ``next``, too.
    """

    next_keys: tuple[str, ...] = ()

    @abstractmethod
    def acting_policy(self) -> TensorDictModuleBase:
        """Return the module that collects: it reads an observation ``[N]`` and writes ``action``, and what else
        :meth:`learn` reads.

        Called once; the module's parameters and buffers are sent to the collector before each batch.
        """

    @abstractmethod
    def learn(self, batch: TensorDictBase, position: BatchPosition) -> dict[str, float]:
        """Learn from a batch ``[N, T]``; return metrics, named ``train/...``."""

    def state_dict(self) -> dict:
        """Return the state that a checkpoint stores for a resume: nested dicts of tensors, numbers and texts."""
        return {}

    def load_state_dict(self, state: Any) -> None:
        """Continue from a :meth:`state_dict`, which may come from a stranger's checkpoint.

        Raises:
            CheckpointError: for one that does not fit.
        """
        matching_state(state, self.state_dict(), "algorithm")

    def memory(self, frame: int) -> dict[str, int]:
        """Return the bytes that learning needs at one time, each under the setting that causes them, ``key=value``.

        Args:
            frame: bytes of one collected frame.
        """
        return {}


#: Computes the loss of a minibatch ``[B]``, and its parts and diagnostics by name.
Objective = Callable[[TensorDictBase], tuple[Tensor, Mapping[str, Tensor]]]


@runtime_checkable
class Imitable(Protocol):
    """An algorithm whose policy can imitate a teacher before it learns from reward."""

    def prepare(self, batch: TensorDictBase, position: BatchPosition) -> TensorDictBase:
        """Return the frames ``[B]`` of a batch ``[N, T]`` with all that the loss reads. All random draws
        for the loss are made here."""

    def objective(self, data: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """Return the loss of a minibatch, and its parts; ``loss_critic`` is the critic's."""

    def descend(self, data: TensorDictBase, position: BatchPosition, objective: Objective) -> dict[str, float]:
        """Minimise an objective on frames ``[B]``; return metrics."""

    def learning_memory(self, frame: int) -> dict[str, int]:
        """Return the bytes of a gradient step, by its setting, if each frame takes ``frame`` bytes."""


#: Entries of an optimizer's state that cannot be negative: numbers of steps, and sums or means of squares.
NOT_NEGATIVE = ("step", "exp_avg_sq", "max_exp_avg_sq", "square_avg", "sum")


def load_optimizer(optimizer: torch.optim.Optimizer, state: Any) -> None:
    """Load ``state_dict()["state"]`` of an optimizer from a checkpoint; its settings stay.

    Parameters that had no gradient so far have no state.

    Raises:
        CheckpointError: if it does not fit the parameters, or has impossible values.
    """
    refuse_if(
        not isinstance(state, dict),
        "The checkpoint has no optimizer; expected one that a training wrote.",
        CheckpointError,
    )
    twin = deepcopy(optimizer)  # after a step it has a state for each parameter
    for group in twin.param_groups:
        for parameter in group["params"]:
            parameter.grad = torch.zeros_like(parameter)
    twin.step()
    own = twin.state_dict()["state"]
    refuse_any(
        (key for key in state if key not in own),
        lambda key: f"The checkpoint's optimizer has {excerpt(key)}; expected numbers below {len(own)}.",
        CheckpointError,
    )
    saved = matching_state(state, {number: own[number] for number in state}, "optimizer")
    refuse_any(
        (
            f"{number}|{key}"
            for number, entries in saved.items()
            for key in NOT_NEGATIVE
            if key in entries and (torch.as_tensor(entries[key]) < 0).any()
        ),
        lambda place: f"The checkpoint's optimizer is of no use: {place} is negative.",
        CheckpointError,
    )
    optimizer.load_state_dict({**optimizer.state_dict(), "state": saved})
