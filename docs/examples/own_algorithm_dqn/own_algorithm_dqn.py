"""An algorithm of your own: DQN with TorchRL's loss and replay buffer."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import QValueModule
from torchrl.objectives import DQNLoss, SoftUpdate

from pickplace.algorithms.base import Algorithm, load_optimizer
from pickplace.common.validate import number, whole_number
from pickplace.policies.base import MASKED
from pickplace.runs.checkpoint import matching_state
from pickplace.runs.locate import CheckpointError


class EpsilonGreedy(TensorDictModuleBase):
    """Take the choice of the greatest value, or with probability ``epsilon`` any that the mask allows.

    ``epsilon`` is a buffer, so that it reaches the collector with the weights.
    """

    def __init__(self, policy):
        super().__init__()
        self.policy = policy
        self.register_buffer("epsilon", torch.tensor(1.0))
        self.in_keys, self.out_keys = policy.act_keys, [policy.choice_key, "action"]

    def forward(self, frame):
        """Write the choice and ``action`` into an observation ``[N]``."""
        values = self.policy.logits(frame)
        drawn = torch.where(values > MASKED / 2, torch.rand_like(values), -1.0).argmax(1)
        explores = torch.rand(len(drawn), device=drawn.device) < self.epsilon
        choice = torch.where(explores, drawn, values.argmax(1))
        frame.set(self.policy.choice_key, choice)
        return frame.set("action", self.policy.to_action(choice, frame))


class DQN(Algorithm):
    """Double DQN: the logits of the policy are the values of its choices.

    Args:
        policy, critic, task: pickplace passes them; there must be no critic.
        capacity: frames in the replay buffer.
        minibatch_size: frames of each gradient step.
        updates: gradient steps after each batch.
        lr: Adam's step size.
        gamma: discount per step.
        tau: share of the new weights that enters the target network at each step.
        epsilon: share of random choices in the end.
        decay: share of the budget in which it falls from 1.
    """

    def __init__(self, policy, critic, task, capacity, minibatch_size, updates, lr, gamma, tau, epsilon, decay):
        if critic is not None or not policy.masks:
            raise ValueError("algo: DQN expects model.critic=null, and a model with a mask.")
        self.policy, self.task, self.updates = policy, task, updates
        self.capacity, self.minibatch_size = whole_number("algo.capacity", capacity), minibatch_size
        self.epsilon, self.decay = number("algo.epsilon", epsilon, most=1), number("algo.decay", decay, 1e-6, 1)
        self.next_keys = tuple(f"{mask}_mask" for mask in policy.masks)  # the loss asks which choices come next
        self.acting = EpsilonGreedy(policy)

        key = policy.choice_key
        greedy = QValueModule("categorical", action_value_key="logits", out_keys=[key, "logits", "chosen_action_value"])
        self.loss = DQNLoss(TensorDictSequential(policy, greedy), action_space="categorical", double_dqn=True)
        self.loss.set_keys(action=key, action_value="logits")
        self.loss.make_value_estimator(gamma=gamma)
        self.target = SoftUpdate(self.loss, tau=tau)
        self.optimizer = torch.optim.Adam(policy.parameters(), lr)

        seen = task.observation.select(*policy.in_keys)
        after = {
            **seen,
            "reward": torch.zeros(1, 1),
            **{end: torch.zeros(1, 1).bool() for end in ("done", "terminated")},
        }
        self.frame = TensorDict({**seen, key: torch.zeros(1, dtype=torch.int64), "next": after}, [1])
        self.replay = ReplayBuffer(storage=LazyTensorStorage(capacity), batch_size=minibatch_size)

    def acting_policy(self):
        """Return the policy as it collects."""
        return self.acting

    def learn(self, batch, position):
        """Store a batch ``[N, T]``, and take gradient steps on frames of the buffer; return metrics."""
        left = 1 - position.frames / (self.decay * position.total_frames)
        self.acting.epsilon.fill_(self.epsilon + (1 - self.epsilon) * max(left, 0.0))
        after = batch["next"]
        after["reward"] = self.task.reward_scale * after["reward"]
        after["terminated"] |= ~after[self.next_keys[0]].flatten(2).any(2, keepdim=True)  # no choice, no value
        self.replay.extend(batch.select(*self.frame.keys(include_nested=True, leaves_only=True)).reshape(-1).cpu())
        total = 0.0
        for _ in range(self.updates):
            data = self.replay.sample().to(batch.device)
            loss = self.loss(data)["loss"]
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            self.target.step()
            total += loss.item()
        return {"train/loss": total / self.updates, "train/epsilon": self.acting.epsilon.item()}

    def target_weights(self):
        """Return the tensors of the target network by name; they are its own, not copies."""
        return dict(self.loss.target_value_network_params.data.flatten_keys(".").items())

    def state_dict(self):
        """Return what a resumed run needs beside the weights of the policy."""
        return {
            "optimizer": self.optimizer.state_dict()["state"],
            "target": self.target_weights(),
            "epsilon": self.acting.epsilon,
            "cursor": self.replay.writer.state_dict()["_cursor"],
            "frames": self.replay[:].to_dict() if len(self.replay) else {},
        }

    def load_state_dict(self, state):
        """Continue from a checkpoint; refuse one that does not fit."""
        own = {"target": self.target_weights(), "epsilon": self.acting.epsilon, "cursor": 0}
        found = matching_state(state, own, "algorithm")
        load_optimizer(self.optimizer, state.get("optimizer"))
        for name, tensor in own["target"].items():
            tensor.copy_(found["target"][name])
        self.acting.epsilon.fill_(number("the checkpoint's epsilon", found["epsilon"].item(), most=1))
        if state.get("frames"):
            self._fill(state["frames"], found["cursor"])

    def _fill(self, frames, cursor):
        """Fill the replay buffer with the frames of a checkpoint."""
        choice = frames.get(self.policy.choice_key) if isinstance(frames, dict) else None
        count = len(choice) if isinstance(choice, torch.Tensor) and choice.dim() else 0
        frames = matching_state(frames, self.frame.expand(count).to_dict(), "algorithm")
        choices = self.policy.logits(self.frame).shape[1]
        full = count == self.capacity
        if not (0 < count <= self.capacity and 0 <= cursor < self.capacity and (full or cursor == count)):
            raise CheckpointError(f"The checkpoint's replay buffer has {count} frames and a cursor at {cursor}.")
        if choice.min() < 0 or choice.max() >= choices:
            raise CheckpointError(f"The checkpoint's replay buffer has choices that are not below {choices}.")
        self.replay.extend(TensorDict(frames, [count]))
        self.replay.writer.load_state_dict({"_cursor": cursor})

    def memory(self, frame):
        """Return the bytes of the replay buffer and of a gradient step, by the keys that cause them."""
        return {
            f"algo.capacity={self.capacity}": self.capacity * self.frame.bytes(),
            f"algo.minibatch_size={self.minibatch_size}": 2 * self.minibatch_size * self.policy.learning_bytes(),
        }
