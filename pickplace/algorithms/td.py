"""TD(lambda): values of totes, from which the policy is derived."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import ValueOperator
from torchrl.objectives.value.functional import generalized_advantage_estimate

from pickplace.algorithms.base import BatchPosition, Task
from pickplace.algorithms.descent import MinibatchDescent
from pickplace.common.validate import expect, number, whole_number
from pickplace.policies.afterstate.value import ToteValue
from pickplace.policies.base import EstimatesValue, Policy


class TD(MinibatchDescent):
    """Learn the values of the totes that placements leave, by TD(lambda) (config ``algo=td``).

    Args:
        policy: a policy that is derived from these values, and draws placements by them.
        critic: its network, a :class:`~pickplace.policies.afterstate.value.ToteValue`.
        task: facts of the training.
        gamma: discount per step.
        lmbda: lambda of the returns.
        **descent: settings of :class:`~pickplace.algorithms.descent.MinibatchDescent`.
    """

    def __init__(self, policy: Policy, critic: ValueOperator, task: Task, gamma: float, lmbda: float, **descent):
        expect(
            isinstance(policy, EstimatesValue),
            "algo",
            "td",
            "model=afterstate or afterstate_fcn, which follow from the values",
        )
        super().__init__(policy, task, **descent)
        whole_number("rollout_length", task.rollout_length, 2)
        self.network: ToteValue = critic.module
        mirrored = self.network.mirrored and policy.cell.reach is not None
        expect(not mirrored, "model.actor.mirrored", True, "false: the robot's reach tells the tote's sides apart")
        scale = self.network.reward_scale
        expect(scale == task.reward_scale, "model.actor.reward_scale", scale, f"reward_scale={task.reward_scale}")
        self.gamma, self.lmbda = number("algo.gamma", gamma, most=1), number("algo.lmbda", lmbda, most=1)
        self.use_parameters(self.network.parameters())

    def learn(self, batch: TensorDictBase, position: BatchPosition) -> dict[str, float]:
        after = totes_left(batch, self.policy)
        return self.descend(with_targets(after, self.network, self.gamma, self.lmbda), position, self.objective)

    def objective(self, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the mean of the squared errors of the values and of their parts; and diagnostics, such as the share of
        the targets' variance that the values explain."""
        *entries, target = self.network.random_view(*(data[key] for key in (*self.network.in_keys, "value_target")))
        error = (target - self.network.parts(*entries)).flatten(1)
        whole, parts = error.sum(1).square().mean(), error.square().sum(1).mean()
        with torch.no_grad():
            rest, variance = (values.flatten(1).sum(1).var(correction=0) for values in (error, target))
            explained = 1.0 - rest / (variance + torch.finfo(target.dtype).eps)
        return (whole + parts) / 2, {"loss_critic": whole, "explained_variance": explained}


def totes_left(batch: TensorDictBase, policy: Policy) -> TensorDictBase:
    """Return the observations after the steps of a batch ``[N, T]``, without the items that arrived in the bin."""
    flat = batch.reshape(-1)
    left = policy.items_left(flat, flat[policy.choice_key])
    return batch["next"].copy().set("items", left.unflatten(0, batch.shape))


@torch.no_grad()
def with_targets(after: TensorDictBase, network: ToteValue, gamma: float, lmbda: float) -> TensorDictBase:
    """Return totes after placements with TD(lambda) targets as ``value_target``, ``[N * (T - 1)]``.

    A step from one afterstate to the next is the arrival of an item and its placement. Its reward is that of the
    *next* action of the batch. If the item that arrived has no place, the environment has ended the episode already,
    with the action before. Then the step has reward 0.

    Args:
        after: the afterstates ``[N, T]`` with ``T >= 2``; their rewards are not scaled.
        network: the network of the values; each part of a value has a target.
        gamma: discount per step.
        lmbda: lambda of the returns.
    """
    entries = [after[key] for key in network.in_keys]
    value = network.parts(*(entry.flatten(0, 1) for entry in entries)).unflatten(0, after.shape)
    before, later = ([entry[:, part].flatten(0, 1) for entry in entries] for part in (slice(-1), slice(1, None)))
    ended = after["done"][:, :-1]
    reward = torch.where(ended, 0.0, network.reward_scale * after["reward"][:, 1:]).flatten(0, 1)
    credit = network.credit(before, later)
    earned = (credit * reward.view(-1, *[1] * (credit.dim() - 1))).unflatten(0, ended.shape[:2])
    # TorchRL wants the time last but one.
    flat = [values.flatten(2) for values in (value[:, :-1], value[:, 1:], earned)]
    done = ended.expand_as(flat[0])
    advantage, _ = generalized_advantage_estimate(gamma, lmbda, *flat, done, done)
    target = (advantage + flat[0]).view_as(earned)
    return after[:, :-1].select(*network.in_keys).set("value_target", target).reshape(-1)
