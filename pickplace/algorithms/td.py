"""TD(lambda): values of totes, from which the policy follows."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import ValueOperator
from torchrl.objectives.value import GAE

from pickplace.algorithms.base import At, Task
from pickplace.algorithms.descent import MinibatchDescent
from pickplace.common.validate import expect, number, whole_number
from pickplace.policies.base import EstimatesValue, Policy


class TD(MinibatchDescent):
    """Learn the values of the totes that placements leave, by TD(lambda) (config ``algo=td``).

    Args:
        policy: one that follows from these values, and draws placements by them.
        critic: its network.
        task: facts of the training.
        gamma: discount per step.
        lmbda: lambda of the returns.
        **descent: settings of :class:`~pickplace.algorithms.descent.MinibatchDescent`.
    """

    def __init__(self, policy: Policy, critic: ValueOperator, task: Task, gamma: float, lmbda: float, **descent):
        expect(isinstance(policy, EstimatesValue), "algo", "td", "model=afterstate, which follows from the values")
        super().__init__(policy, task, **descent)
        whole_number("rollout_length", task.rollout_length, 2)
        scale = policy.value_network().reward_scale
        expect(scale == task.reward_scale, "model.actor.reward_scale", scale, f"reward_scale={task.reward_scale}")
        self.critic = critic
        self.advantage = GAE(
            gamma=number("algo.gamma", gamma, most=1),
            lmbda=number("algo.lmbda", lmbda, most=1),
            value_network=critic,
            deactivate_vmap=True,
        )
        self.use_parameters(critic.parameters())

    def learn(self, batch: TensorDictBase, at: At) -> dict[str, float]:
        return self.descend(afterstates(batch, self.advantage, self.task.reward_scale), at, self.objective)

    def objective(self, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the mean squared error of the values, and the share of the targets' variance that they explain."""
        target, value = data["value_target"], self.critic(data)["state_value"]
        loss = torch.nn.functional.mse_loss(target, value, reduction="none").mean()
        with torch.no_grad():
            rest, variance = (torch.var(values, correction=0, dim=0) for values in (target - value, target))
            explained = 1.0 - rest / (variance + torch.finfo(target.dtype).eps)
        return loss, {"loss_critic": loss, "explained_variance": explained.mean()}


@torch.no_grad()
def afterstates(batch: TensorDictBase, advantage: GAE, reward_scale: float) -> TensorDictBase:
    """Return the totes that the steps of a batch left, ``[N * (T - 1)]``, with TD(lambda) targets as ``value_target``.

    A step from one afterstate to the next is the arrival of an item and its placement. Its reward is that of the
    *next* action of the batch. Where the item that arrived has no place, the environment has ended the episode already,
    together with the action before: the step to that end has reward 0.

    Args:
        batch: ``[N, T]``, at least two steps; its rewards are not scaled.
        advantage: GAE with a critic that reads terms of the tote alone.
    """
    after, keys = batch["next"], advantage.value_network.in_keys
    ended = after["done"][:, :-1]
    reward = torch.where(ended, 0.0, reward_scale * after["reward"][:, 1:])
    steps = after[:, :-1].select(*keys)
    steps["next"] = after[:, 1:].select(*keys).update({"reward": reward, "done": ended, "terminated": ended.clone()})
    advantage(steps)
    return steps.exclude("next").reshape(-1)
