"""A variant of PPO: the weight of the entropy falls during the training."""

from pickplace.algorithms.ppo import PPO


class EntropyDecayPPO(PPO):
    """PPO with an entropy coefficient that falls linearly, from ``entropy_coeff`` to ``last_entropy_coeff``.

    Args:
        networks: pickplace passes policy, critic and task.
        last_entropy_coeff: coefficient at ``total_frames``.
        settings: of PPO.
    """

    def __init__(self, *networks, entropy_coeff: float, last_entropy_coeff: float, **settings):
        super().__init__(*networks, entropy_coeff=entropy_coeff, **settings)
        self.ends = entropy_coeff, last_entropy_coeff

    def learn(self, batch, position):
        """Set the coefficient in TorchRL's loss, ``self.loss``, and learn from a batch ``[N, T]`` as PPO does."""
        first, last = self.ends
        coefficient = first + (last - first) * min(position.frames_before / position.total_frames, 1.0)
        self.loss.entropy_coeff.fill_(coefficient)
        return super().learn(batch, position) | {"train/entropy_coeff": coefficient}
