"""An algorithm of your own: REINFORCE with a baseline."""

import torch
import torch.nn.functional as F

from pickplace.algorithms.base import Algorithm, load_optimizer
from pickplace.policies.base import as_actor, as_collection_policy


class Reinforce(Algorithm):
    """One step of the policy gradient on each batch; the critic is the baseline.

    An episode that a batch cuts off is not dropped: its return goes on with what the baseline expects.

    Args:
        policy, critic, task: pickplace passes them.
        lr: Adam's step size.
        gamma: discount per step.
    """

    def __init__(self, policy, critic, task, lr: float, gamma: float):
        if critic is None:
            raise ValueError("model.critic=null: expected a network, whose values are the baseline.")
        self.policy, self.critic, self.task, self.gamma = policy, critic, task, gamma
        self.actor = as_actor(policy)
        self.optimizer = torch.optim.Adam([*policy.parameters(), *critic.parameters()], lr)

    def acting_policy(self):
        """Return the policy as it collects: it draws a choice, and writes that and ``action``."""
        return as_collection_policy(self.policy)

    def learn(self, batch, position):
        """Take one gradient step on a batch ``[N, T]``; return metrics."""
        returns, data = self.returns(batch).flatten(), batch.reshape(-1)
        baseline = self.critic(data)["state_value"][:, 0]
        log_prob = self.actor.get_dist(data).log_prob(data[self.policy.choice_key])
        objective = -(log_prob * (returns - baseline.detach())).mean()
        error = F.mse_loss(baseline, returns)
        self.optimizer.zero_grad()
        (objective + error).backward()
        self.optimizer.step()
        return {"train/loss_objective": objective.item(), "train/loss_critic": error.item()}

    @torch.no_grad()
    def returns(self, batch):
        """Return the discounted return of each frame, float32 ``[N, T]``."""
        reward = self.task.reward_scale * batch["next", "reward"][..., 0]
        done = batch["next", "done"][..., 0]
        following = self.critic(batch["next"][:, -1])["state_value"][:, 0]
        found = torch.empty_like(reward)
        for step in reversed(range(reward.shape[1])):
            following = reward[:, step] + self.gamma * torch.where(done[:, step], 0.0, following)
            found[:, step] = following
        return found

    def state_dict(self):
        """Return what a resumed run needs beside the weights of policy and critic."""
        return {"optimizer": self.optimizer.state_dict()["state"]}

    def load_state_dict(self, state):
        """Continue from a checkpoint; refuse one that does not fit."""
        load_optimizer(self.optimizer, state.get("optimizer") if isinstance(state, dict) else None)

    def memory(self, frame):
        """Return the bytes of a gradient step, by the key that causes them."""
        frames = self.task.batch_frames
        return {f"rollout_length={self.task.rollout_length}": frames * self.policy.learning_bytes()}
