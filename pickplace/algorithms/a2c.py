"""Advantage actor-critic."""

from torchrl.objectives import A2CLoss

from pickplace.algorithms.actor_critic import ActorCritic
from pickplace.policies.base import as_actor


class A2C(ActorCritic):
    """A2C (config ``algo=a2c``). GAE normalises the advantages in each batch, because the loss does not."""

    averages = True

    def make_loss(self, **common) -> A2CLoss:
        self.refuse_single_frame()
        return A2CLoss(as_actor(self.policy), self.critic, **common)
