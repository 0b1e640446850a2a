"""Proximal policy optimisation."""

from torch import Tensor
from torch.distributions import Distribution
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
        return ClippedLoss(
            as_actor(self.policy),
            self.critic,
            clip_epsilon=self.clip_epsilon,
            normalize_advantage=self.normalize_advantage,
            **common,
        )


class ClippedLoss(ClipPPOLoss):
    """TorchRL's loss, of distributions that know their entropy."""

    def _get_entropy(self, dist: Distribution, adv_shape) -> Tensor:
        """Return the entropy.

        TorchRL also checks in each step that it is finite, and a GPU must wait for that. Here the gradient step checks
        the whole loss.
        """
        return dist.entropy()[..., None]
