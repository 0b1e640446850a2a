"""Proximal policy optimisation."""

from torchrl.objectives import ClipPPOLoss

from pickplace.algorithms.actor_critic import ActorCritic
from pickplace.common.validate import number
from pickplace.policies.base import as_actor


class PPO(ActorCritic):
    """PPO with a clipped ratio (Schulman et al. 2017; config ``algo=ppo``).

    Args:
        clip_epsilon: PPO's clipping range.
        **settings: of :class:`~pickplace.algorithms.actor_critic.ActorCritic`; advantages are normalised in each
            minibatch.
    """

    def __init__(self, *networks, clip_epsilon: float, **settings):
        self.clip_epsilon = number("algo.clip_epsilon", clip_epsilon, most=1)
        super().__init__(*networks, **settings)

    def make_loss(self, **common) -> ClipPPOLoss:
        return ClipPPOLoss(
            as_actor(self.policy),
            self.critic,
            clip_epsilon=self.clip_epsilon,
            normalize_advantage=self.normalize_advantage,
            **common,
        )
