"""Advantage actor-critic."""

from torchrl.objectives import A2CLoss

from pickplace.algorithms.actor_critic import ActorCritic
from pickplace.common.validate import refuse_if
from pickplace.policies.base import as_actor


class A2C(ActorCritic):
    """A2C (config ``algo=a2c``). GAE normalises the advantages in each batch, because the loss does not."""

    averages = True

    def make_loss(self, **common) -> A2CLoss:
        refuse_if(
            self.normalize_advantage and self.task.batch_frames == 1,
            "algo.normalize_advantage=True: a batch of one frame (env.num_envs x rollout_length) has no variance; "
            "expected more frames, or false.",
        )
        return A2CLoss(as_actor(self.policy), self.critic, **common)
