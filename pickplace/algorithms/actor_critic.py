"""The common part of PPO and A2C: advantages by GAE, and a loss of TorchRL."""

from abc import abstractmethod

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import ValueOperator
from torchrl.objectives import A2CLoss, ClipPPOLoss
from torchrl.objectives.value import GAE

from pickplace.algorithms.base import BatchPosition, Task
from pickplace.algorithms.descent import MAX_WEIGHT, MinibatchDescent
from pickplace.common.validate import expect, flag, number, refuse_if
from pickplace.policies.base import EstimatesValue, Policy


class ActorCritic(MinibatchDescent):
    """Base class of algorithms that learn a policy from advantages over a critic's values.

    Args:
        policy, task: as in :class:`~pickplace.algorithms.descent.MinibatchDescent`.
        critic: the value network.
        gamma: discount per step.
        lmbda: GAE's lambda.
        entropy_coeff: weight of the entropy bonus in the loss.
        critic_coeff: weight of the critic's loss.
        normalize_advantage: whether advantages have zero mean and unit variance.
        **descent: settings of the base class.
    """

    drawn_keys: tuple[str, ...] = ("log_prob",)  # entries that the acting policy writes and the loss reads
    log_prob_key = "log_prob"  # the entry with the log-probabilities under the policy that collected
    averages = False  # whether GAE normalises advantages in each batch

    def __init__(
        self,
        policy: Policy,
        critic: ValueOperator,
        task: Task,
        gamma: float,
        lmbda: float,
        entropy_coeff: float,
        critic_coeff: float,
        normalize_advantage: bool,
        **descent,
    ):
        super().__init__(policy, task, **descent)
        expect(
            not isinstance(policy, EstimatesValue), "algo", type(self).__name__, "algo=td, of whose values it follows"
        )
        expect(critic is not None, "model.critic", critic, "a network, from whose values the advantages follow")
        self.next_keys = tuple(key for key in critic.in_keys if key.endswith("_mask"))  # GAE values the next state
        known = {f"{mask}_mask" for mask in policy.masks}
        expect(
            known.issuperset(self.next_keys),
            "model.critic: its masks",
            self.next_keys,
            f"among {sorted(known)}, which the policy reads",
        )
        self.critic, self.gamma = critic, number("algo.gamma", gamma, most=1)
        self.normalize_advantage = flag("algo.normalize_advantage", normalize_advantage)
        coefficients = {
            "entropy_coeff": number("algo.entropy_coeff", entropy_coeff, most=MAX_WEIGHT),
            "critic_coeff": number("algo.critic_coeff", critic_coeff, most=MAX_WEIGHT),
        }
        # TorchRL leaves out a part whose initial coefficient is 0. With 1 it is computed, so that it can be logged.
        self.loss = self.make_loss(**dict.fromkeys(coefficients, 1.0), loss_critic_type="l2")
        for key, value in coefficients.items():
            getattr(self.loss, key).fill_(float(value))
        self.loss.set_keys(action=policy.choice_key, sample_log_prob=self.log_prob_key)
        self.advantage = GAE(
            gamma=self.gamma,
            lmbda=number("algo.lmbda", lmbda, most=1),
            value_network=critic,
            average_gae=self.averages and self.normalize_advantage,
            deactivate_vmap=True,
        )
        self.use_parameters(self.loss.parameters())

    @abstractmethod
    def make_loss(self, **common) -> A2CLoss | ClipPPOLoss:
        """Return TorchRL's loss, with the arguments that all losses have in common."""

    def refuse_single_frame(self) -> None:
        """Refuse to normalise the advantages of a batch of one frame; they have no variance."""
        refuse_if(
            self.normalize_advantage and self.task.batch_frames == 1,
            "algo.normalize_advantage=True: a batch of one frame (env.num_envs x rollout_length) has no variance; "
            "expected more frames, or false.",
        )

    def learn(self, batch: TensorDictBase, position: BatchPosition) -> dict[str, float]:
        return self.descend(self.prepare(batch, position), position, self.objective)

    @torch.no_grad()
    def prepare(self, batch: TensorDictBase, position: BatchPosition) -> TensorDictBase:
        """Return the frames ``[B]`` of a batch ``[N, T]``, with advantages and value targets."""
        following = batch["next"]
        following["reward"] = following["reward"] * self.task.reward_scale
        # The environment reports the end of the item stream, an empty bin, as a truncation. But no reward can follow
        # and no action is taken in that state, so the critic would never learn the value with which GAE continues.
        following["terminated"] |= following["bin_depth"].flatten(-2).amax(-1, keepdim=True) == 0
        self.advantage(batch)
        keys = {*self.policy.in_keys, *self.critic.in_keys, *self.drawn_keys, self.policy.choice_key}
        return batch.select(*keys, "advantage", "value_target").reshape(-1)

    def objective(self, data: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """Return TorchRL's loss of a minibatch ``[B]``, and its parts."""
        losses = self.loss(data)
        return losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"], losses
